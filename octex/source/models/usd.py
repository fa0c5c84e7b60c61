"""USD stages, .usd, .usda, .usdc and .usdz: meshes, their transforms, and UsdPreviewSurface materials.

OpenUSD (the extra ``usd``) composes the stage. It is read in metres with y up, as glTF has it. Meshes are
taken as they are modelled: polygons of a subdivision surface are its cage, at the earliest time sampled.
"""

from __future__ import annotations

import json
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from octex.arrays import Array, Float64s, Int32s, Int64s
from octex.errors import MissingExtraError, ModelError, ModelWarning
from octex.files import is_absolute
from octex.source.corners import Corners, Polygons
from octex.source.models.polygons import cut_polygons, triangulate
from octex.source.models.reading import Description, Options, Part, assembled, frames_below, slot_coordinates
from octex.source.models.usd_materials import Materials
from octex.source.surface import Surface, flip_v

#: How a primvar's values are spread; as in UsdGeom's tokens.
_SPREADS = ("constant", "uniform", "vertex", "varying", "faceVarying")


def load_usd(path: Path, options: Options) -> Surface:
    """Read the meshes of a USD stage that are shown, with what ``options`` asks for of their materials.

    ``uv`` is ``st``, or what the first image is read at, where all meshes have it. ``provenance`` holds the
    digests of the images. Point instancers and shapes that are no meshes are left out, materials other than
    UsdPreviewSurface are white, and where coordinates are missing images are read at (0, 0), as the
    specification says, with ModelWarning. Raises ModelError, ImageError, or MissingExtraError without
    usd-core.
    """
    try:
        from pxr import Tf, Usd, UsdUtils
    except ImportError:
        raise MissingExtraError.needed(f"{path.name}: to read USD", "usd-core", "usd") from None
    quiet = UsdUtils.CoalescingDiagnosticDelegate()  # keeps off the screen what OpenUSD prints while it lives
    try:
        stage = Usd.Stage.Open(str(path.absolute()))
        # It may be given away to name others' files.
        for layer in stage.GetUsedLayers():
            for each in filter(is_absolute, layer.GetCompositionAssetDependencies()):
                raise ModelError(
                    f"{path.name} refers to {each}; absolute paths are not followed; name it from its folder"
                )
        faults = dict.fromkeys(" ".join(str(fault).split()) for fault in stage.GetCompositionErrors())
        if faults:
            more = f" … and {len(faults) - 1} more like that" if len(faults) > 1 else ""
            text = f"{path.name} is not whole: {next(iter(faults))[:200]}{more}"
            warnings.warn(text, ModelWarning, stacklevel=2)
        return _Scene(stage, path.name, options).surface()
    except Tf.ErrorException:
        raise ModelError(f"{path.name} is damaged, or no USD stage; export it again") from None
    finally:
        del quiet


class _Scene:
    """Collects the meshes of a stage into one surface."""

    def __init__(self, stage: Any, name: str, options: Options) -> None:
        from pxr import Usd, UsdGeom

        self._stage, self._name, self._options = stage, name, options
        self._time = Usd.TimeCode.EarliestTime()
        self._places = UsdGeom.XformCache(self._time)
        self._materials = Materials(name, options)
        # Meshes without coordinates that are asked for, by the coordinates' name.
        self._lacking: dict[str, dict[str, None]] = {}

    def surface(self) -> Surface:
        """Return all that is shown."""
        prims = [(prim, *self._materials_of(prim)) for prim in self._shown()]
        has_frames = self._options.normals or any(
            each.material.normal_slot is not None for _, _, known in prims for each in known.values()
        )
        parts = [part for prim in prims if len((part := self._part(*prim, has_frames=has_frames)).triangles)]
        for name, meshes in self._lacking.items():
            more = f" and {len(meshes) - 1} more" if len(meshes) > 1 else ""
            text = f"{self._name}: {next(iter(meshes))}{more} lack the primvar {name}"
            warnings.warn(f"{text}: images are read at (0, 0) there", ModelWarning, stacklevel=2)
        if not parts:
            raise ModelError(f"{self._name} has no triangles; octex needs a surface, not points or curves")
        files = self._materials.files
        return assembled(
            parts, [each.material for each in self._materials.known], self._options, self._name,
            provenance={"files": json.dumps(files, sort_keys=True)} if files else {},
        )  # fmt: skip

    def _shown(self) -> list[Any]:
        """Return the meshes that are visible and meant for renders."""
        from pxr import Usd, UsdGeom

        meshes = []
        others: Counter[str] = Counter()
        every = iter(Usd.PrimRange(self._stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
        for prim in every:
            if prim.IsA(UsdGeom.PointInstancer):
                every.PruneChildren()
                text = f"{self._name}: {prim.GetPath()} is a point instancer, which octex leaves out"
                warnings.warn(text, ModelWarning, stacklevel=2)
            elif prim.IsA(UsdGeom.Gprim):
                seen = UsdGeom.Imageable(prim)
                is_hidden = seen.ComputeVisibility(self._time) == UsdGeom.Tokens.invisible
                if is_hidden or seen.ComputePurpose() not in (
                    UsdGeom.Tokens.default_,
                    UsdGeom.Tokens.render,
                ):
                    continue
                if prim.IsA(UsdGeom.Mesh):
                    meshes.append(prim)
                else:
                    others[prim.GetTypeName()] += 1
        if others:
            listing = ", ".join(f"{count} {kind}" for kind, count in others.items())
            text = f"{self._name}: of its shapes octex reads meshes, and leaves out {listing}; export meshes"
            warnings.warn(text, ModelWarning, stacklevel=2)
        return meshes

    def _placed(self, prim: Any) -> Float64s:
        """Return the matrix (4, 4) that takes a mesh to the world, in metres with y up."""
        from pxr import UsdGeom

        placed = np.array(self._places.GetLocalToWorldTransform(prim)).T
        if UsdGeom.GetStageUpAxis(self._stage) == UsdGeom.Tokens.z:
            placed = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]]) @ placed
        # Some programs write single precision, which UsdGeom's own function refuses.
        placed[:3] *= float(self._stage.GetMetadata("metersPerUnit"))
        return np.asarray(placed, np.float64)

    def _materials_of(self, prim: Any) -> tuple[dict[int, Int64s], dict[int, Description]]:
        """Return the faces of a mesh that materials other than its own are for, and all of its materials.

        These are by number; the mesh's own comes first.
        """
        from pxr import UsdGeom, UsdShade

        api = UsdShade.MaterialBindingAPI(prim)
        both = bool(UsdGeom.Mesh(prim).GetDoubleSidedAttr().Get(self._time))
        own = self._materials.number(api.ComputeBoundMaterial()[0], both)
        faces: dict[int, Int64s] = {own: np.empty(0, np.int64)}
        for subset in api.GetMaterialBindSubsets():
            material, _ = UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()
            number = self._materials.number(material, both)
            chosen = np.array(subset.GetIndicesAttr().Get(self._time) or [], np.int64)
            faces[number] = np.concatenate([faces.get(number, chosen[:0]), chosen])
        return faces, {number: self._materials.known[number] for number in faces}

    def _part(
        self, prim: Any, faces: dict[int, Int64s], known: dict[int, Description], *, has_frames: bool
    ) -> Part:
        from pxr import UsdGeom

        mesh, what = UsdGeom.Mesh(prim), f"{self._name}: {prim.GetPath()}"
        positions = _rows(mesh.GetPointsAttr().Get(self._time), 3).astype(np.float64)
        sizes = _rows(mesh.GetFaceVertexCountsAttr().Get(self._time)).astype(np.int64)
        corners = _rows(mesh.GetFaceVertexIndicesAttr().Get(self._time)).astype(np.int64)
        if not np.isfinite(positions).all():
            raise ModelError(f"{what} has points that are not finite; repair the model")
        if sizes.min(initial=0) < 0 or sizes.sum() != len(corners):
            raise ModelError(
                f"{what}: its faces have {sizes.sum()} corners, its list {len(corners)}; export it again"
            )
        _check_below(corners, len(positions), f"{what} uses a point")
        cut, owners = triangulate(positions, corners, sizes)
        polygons = cut_polygons(cut, owners, sizes)
        is_shown = ~np.isin(owners, _rows(mesh.GetHoleIndicesAttr().Get(self._time)).astype(np.int64))
        cut, owners = cut[is_shown], owners[is_shown]
        polygons = polygons and Polygons(*(each[is_shown] for each in polygons))
        if len(np.unique(owners)) == len(owners):
            polygons = None
        if mesh.GetOrientationAttr().Get(self._time) == UsdGeom.Tokens.leftHanded:
            cut, polygons = cut[:, ::-1], polygons and polygons._replace(corners=polygons.corners[:, ::-1])
        primvars = _Primvars(prim, self._time, what, corners, sizes, cut)
        triangles = corners[cut].astype(np.int32)
        numbers = np.full(len(sizes), next(iter(known)), np.int32)
        for number, chosen in faces.items():
            _check_below(chosen, len(sizes), f"{what} binds a material to a face")
            numbers[chosen] = number
        part = Part(positions, triangles, numbers[owners], polygons=polygons, matrix=self._placed(prim))
        if not self._options.materials:
            return part._replace(materials=np.zeros(len(triangles), np.int32))
        nowhere = Corners(np.zeros((1, 2), np.float32), np.zeros_like(triangles))

        def read(name: str) -> Corners:
            read = primvars.corners(name, 2)
            if read is None:
                self._lacking.setdefault(name, {})[str(prim.GetPath())] = None
            return read or nowhere

        coordinates = slot_coordinates(known, part.materials, read)
        normals = primvars.normals() if has_frames else None
        uv = primvars.corners(next((slot.name for each in known.values() for slot in each.slots), "st"), 2)
        return part._replace(
            colors=self._colors(part.materials, known, primvars),
            coordinates=coordinates,
            uv=uv and uv._replace(values=flip_v(uv.values)),
            frames=frames_below(known, part.materials, positions, triangles, normals, coordinates, nowhere)
            if has_frames
            else None,
            is_smooth=normals is not None,
        )

    def _colors(self, numbers: Int32s, known: dict[int, Description], primvars: _Primvars) -> Corners | None:
        """Return displayColor and displayOpacity where a material reads them; white elsewhere."""
        lanes = [primvars.corners("displayColor", 3), primvars.corners("displayOpacity", 1)]
        values = np.ones((len(numbers), 3, 4), np.float32)
        for columns, corners, reads in zip(
            (slice(3), slice(3, 4)), lanes, ("reads_color", "reads_opacity"), strict=True
        ):
            reading = [number for number, each in known.items() if getattr(each, reads)]
            chosen = np.isin(numbers, reading)
            if corners is not None and chosen.any():
                values[chosen, :, columns] = corners.values[corners.rows[chosen]]
        if (values == 1.0).all():
            return None
        distinct, rows = np.unique(values.reshape(-1, 4), axis=0, return_inverse=True)
        return Corners(distinct, rows.reshape(-1, 3).astype(np.int32))


class _Primvars:
    """What is bound to a mesh by name, at the corners of its triangles."""

    def __init__(
        self, prim: Any, time: Any, what: str, corners: Int64s, sizes: Int64s, triangles: Int64s
    ) -> None:
        from pxr import UsdGeom

        self.what = what
        self._mesh, self._api, self._time = UsdGeom.Mesh(prim), UsdGeom.PrimvarsAPI(prim), time
        self._rows = {
            "constant": np.zeros(triangles.shape, np.int64),
            "uniform": np.repeat(np.arange(len(sizes)), sizes)[triangles],
            "vertex": corners[triangles],
            "faceVarying": triangles,
        }
        self._rows["varying"] = self._rows["vertex"]

    def corners(self, name: str, width: int) -> Corners | None:
        """Return a primvar with so many components, inherited ones too; None if there is none."""
        primvar = self._api.FindPrimvarWithInheritance(name)
        if not primvar or not primvar.HasValue():
            return None
        values = primvar.Get(self._time)
        indices = primvar.GetIndices(self._time) if primvar.IsIndexed() else None
        return self._spread(name, values, width, primvar.GetInterpolation(), indices)

    def normals(self) -> Corners | None:
        """Return the normals, of which those that are a primvar come first."""
        primvar = self.corners("normals", 3)
        values = self._mesh.GetNormalsAttr().Get(self._time)
        if primvar is not None or values is None or not len(values):
            return primvar
        return self._spread("normals", values, 3, self._mesh.GetNormalsInterpolation(), None)

    def _spread(self, name: str, values: Any, width: int, spread: str, indices: Any) -> Corners:
        array = np.asarray(values)
        if array.ndim < 2 and array.size % width == 0:  # one for all, or numbers alone
            array = array.reshape(-1, width)
        if array.ndim != 2 or array.shape[1] != width or array.dtype.kind not in "fiu":
            raise ModelError(f"{self.what}: its primvar {name} has not {width} numbers each; export it again")
        if spread not in _SPREADS:
            raise ModelError(f"{self.what}: its primvar {name} is spread by {spread!r}; export it again")
        rows = self._rows[spread]
        if indices is not None:
            listed = np.asarray(indices, np.int64)
            _check_below(rows, len(listed), f"{self.what}: its primvar {name} lacks an index; it uses")
            rows = listed[rows]
        _check_below(rows, len(array), f"{self.what}: its primvar {name} uses a value")
        return Corners(array.astype(np.float32), rows.astype(np.int32))


def _rows(values: Any, width: int | None = None) -> Array:
    """Return an attribute's array (n,) or (n, width), empty if it is not there."""
    if values is None:
        return np.empty((0,) if width is None else (0, width), np.float32)
    return np.asarray(values)


def _check_below(numbers: Int64s, count: int, what: str) -> None:
    if numbers.size and not 0 <= numbers.min() <= numbers.max() < count:
        worst = numbers.min() if numbers.min() < 0 else numbers.max()
        raise ModelError(f"{what} {worst}, but there are {count}; export the model again")
