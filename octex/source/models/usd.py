"""USD stages, .usd, .usda, .usdc and .usdz: meshes, their transforms, and UsdPreviewSurface materials.

OpenUSD (the extra ``usd``) composes the stage. It is read in metres with y up, as glTF has it. Meshes are
taken as they are modelled: polygons of a subdivision surface are its cage, at the earliest time sampled.
"""

from __future__ import annotations

import json
import warnings
from collections import Counter
from collections.abc import Mapping
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Array, Float64s, Int32s, Int64s
from octex.errors import MissingExtraError, ModelError, ModelWarning
from octex.files import is_absolute
from octex.source.corners import Corners, Frames, Polygons
from octex.source.materials import MaterialSource
from octex.source.models.options import Options
from octex.source.models.polygons import cut_polygons, triangulate
from octex.source.models.usd_materials import Bound, Materials, Slot
from octex.source.surface import Surface, flip_v
from octex.source.tangents import corner_frames, transformed

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
        _refuse_absolute(stage, path.name)
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


def _refuse_absolute(stage: Any, name: str) -> None:
    """Refuse a stage that is composed of files at absolute places: it may be given away to name others'."""
    for layer in stage.GetUsedLayers():
        for each in layer.GetCompositionAssetDependencies():
            if is_absolute(each):
                raise ModelError(
                    f"{name} refers to {each}; absolute paths are not followed; name it from its folder"
                )


class _Shape(NamedTuple):
    """A mesh in its own space, and what is bound to its corners."""

    positions: Float64s
    triangles: Int32s
    materials: Int32s  # (m,)   the number of each triangle's
    colors: Corners | None
    coordinates: list[Corners]
    uv: Corners | None
    frames: Frames | None
    is_smooth: bool
    polygons: Polygons


class _Scene:
    """Collects the meshes of a stage into one surface."""

    def __init__(self, stage: Any, name: str, options: Options) -> None:
        from pxr import Usd, UsdGeom

        self._stage, self._name, self._options = stage, name, options
        self._time = Usd.TimeCode.EarliestTime()
        self._places = UsdGeom.XformCache(self._time)
        self._materials = Materials(name, options)
        self._lacking: dict[str, list[str]] = {}  # meshes without coordinates that are asked for, by name

    def surface(self) -> Surface:
        """Return all that is shown."""
        prims = self._shown()
        materials = {prim.GetPath(): self._bound(prim) for prim in prims}
        mapped = any(
            bound.material.normal_slot is not None
            for _, every in materials.values()
            for bound in every.values()
        )
        shapes = [
            (self._placed(prim), shape)
            for prim in prims
            if len((shape := self._shape(prim, *materials[prim.GetPath()], mapped)).triangles)
        ]
        for name, meshes in self._lacking.items():
            more = f" and {len(meshes) - 1} more" if len(meshes) > 1 else ""
            text = f"{self._name}: {meshes[0]}{more} lack the primvar {name}: images are read at (0, 0) there"
            warnings.warn(text, ModelWarning, stacklevel=2)
        if not shapes:
            raise ModelError(f"{self._name} has no triangles; octex needs a surface, not points or curves")
        has_normals = mapped or (self._options.normals and any(each.is_smooth for _, each in shapes))
        positions, triangles, frames, polygons = [], [], [], []
        first = number = 0
        for matrix, shape in shapes:
            linear = matrix[:3, :3]
            # A mirroring transform turns triangles inside out.
            order = slice(None, None, -1 if np.linalg.det(linear) < 0 else 1)
            with np.errstate(over="ignore", invalid="ignore"):  # the surface refuses what is not finite
                positions.append(shape.positions @ linear.T + matrix[:3, 3])
            triangles.append(shape.triangles[:, order] + np.int32(first))
            first += len(shape.positions)
            polygons.append(
                Polygons(shape.polygons.numbers + np.int32(number), shape.polygons.corners[:, order])
            )
            number += int(shape.polygons.numbers.max()) + 1
            if shape.frames is not None:
                turned = transformed(shape.frames, linear)
                frames.append(Frames(*(each._replace(rows=each.rows[:, order]) for each in turned)))

        def joined(parts: list[Corners | None], default: float) -> Corners | None:
            """Join what is bound to corners of all meshes; those without it get the default."""
            if all(part is None for part in parts):
                return None
            width = next(part.values.shape[1] for part in parts if part is not None)
            every = []
            for part, (matrix, shape) in zip(parts, shapes, strict=True):
                if part is None:
                    none = np.full((1, width), default, np.float32)
                    part = Corners(none, np.zeros(shape.triangles.shape, np.int32))
                elif np.linalg.det(matrix[:3, :3]) < 0:
                    part = part._replace(rows=part.rows[:, ::-1])
                every.append(part)
            return Corners.joined(every)

        vertices, faces = np.concatenate(positions), np.concatenate(triangles)
        made = None
        if has_normals:
            made = Frames(
                Corners.joined([each.normals for each in frames]),
                Corners.joined([each.tangents for each in frames]),
            )
        slots = zip_longest(*(shape.coordinates for _, shape in shapes))
        coordinates = [joined(list(slot), 0.0) for slot in slots]
        source = MaterialSource(
            self._materials.every, np.concatenate([shape.materials for _, shape in shapes]), vertices, faces,
            colors=joined([shape.colors for _, shape in shapes], 1.0),
            coordinates=[each for each in coordinates if each is not None], frames=made, name=self._name,
            filter=self._options.filter, channels=self._options.channels,
        )  # fmt: skip
        uvs = [shape.uv for _, shape in shapes]
        whole = Polygons(*(np.concatenate(parts) for parts in zip(*polygons, strict=True)))
        files = self._materials.files
        return Surface(
            vertices, faces, source,
            uv=None if any(each is None for each in uvs) else joined(uvs, 0.0),
            frames=made if any(shape.is_smooth for _, shape in shapes) else None,
            polygons=None if len(np.unique(whole.numbers)) == len(faces) else whole, name=self._name,
            provenance={"files": json.dumps(files, sort_keys=True)} if files else {},
        )  # fmt: skip

    def _shown(self) -> list[Any]:
        """Return the meshes that are visible and meant for renders."""
        from pxr import Usd, UsdGeom

        found = []
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
                    found.append(prim)
                else:
                    others[prim.GetTypeName()] += 1
        if others:
            listing = ", ".join(f"{count} {kind}" for kind, count in others.items())
            text = f"{self._name}: of its shapes octex reads meshes, and leaves out {listing}; export meshes"
            warnings.warn(text, ModelWarning, stacklevel=2)
        return found

    def _placed(self, prim: Any) -> Float64s:
        """Return the matrix (4, 4) that takes a mesh to the world, in metres with y up."""
        from pxr import UsdGeom

        placed = np.array(self._places.GetLocalToWorldTransform(prim)).T
        if UsdGeom.GetStageUpAxis(self._stage) == UsdGeom.Tokens.z:
            placed = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]]) @ placed
        # Some programs write single precision, which UsdGeom's own function refuses.
        placed[:3] *= float(self._stage.GetMetadata("metersPerUnit"))
        return np.asarray(placed, np.float64)

    def _bound(self, prim: Any) -> tuple[dict[int, Int64s], dict[int, Bound]]:
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
        return faces, {number: self._materials.bound[number] for number in faces}

    def _shape(
        self, prim: Any, faces: dict[int, Int64s], materials: Mapping[int, Bound], is_mapped: bool
    ) -> _Shape:
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
        cut, polygons = triangulate(positions, corners, sizes)
        kept = _cut_polygons(cut, polygons, sizes)
        holes = _rows(mesh.GetHoleIndicesAttr().Get(self._time)).astype(np.int64)
        is_shown = ~np.isin(polygons, holes)
        cut, polygons, kept = (
            cut[is_shown],
            polygons[is_shown],
            kept.of(np.flatnonzero(is_shown).astype(np.int32)),
        )
        if mesh.GetOrientationAttr().Get(self._time) == UsdGeom.Tokens.leftHanded:
            cut, kept = cut[:, ::-1], kept._replace(corners=kept.corners[:, ::-1])
        primvars = _Primvars(prim, self._time, what, corners, sizes, cut)
        triangles = corners[cut].astype(np.int32)
        own = next(iter(materials))
        numbers = np.full(len(sizes), own, np.int32)
        for number, chosen in faces.items():
            _check_below(chosen, len(sizes), f"{what} binds a material to a face")
            numbers[chosen] = number
        numbers = numbers[polygons]
        if not self._options.materials:
            white = np.zeros(len(triangles), np.int32)
            return _Shape(positions, triangles, white, None, [], None, None, False, kept)
        normals = primvars.normals() if is_mapped or self._options.normals else None
        coordinates = [
            self._slot(slot, numbers, materials, primvars)
            for slot in range(max(len(each.slots) for each in materials.values()))
        ]
        frames = None
        if is_mapped or self._options.normals:
            slots = np.full(len(self._materials.every), -1)
            for number, bound in materials.items():
                slot = bound.material.normal_slot
                slots[number] = -1 if slot is None else slot
            none = Corners(np.zeros((1, 2), np.float32), np.zeros((len(numbers), 3), np.int32))
            mapped = Corners.chosen([*coordinates, none], slots[numbers]) if is_mapped else None
            frames = corner_frames(positions, triangles, normals, None, mapped)
        first = next((slot.name for bound in materials.values() for slot in bound.slots), "st")
        uv = primvars.corners(first, 2)
        return _Shape(
            positions, triangles, numbers, self._colors(numbers, materials, primvars), coordinates,
            None if uv is None else uv._replace(values=flip_v(uv.values)), frames, normals is not None, kept,
        )  # fmt: skip

    def _slot(
        self, slot: int, numbers: Int32s, materials: Mapping[int, Bound], primvars: _Primvars
    ) -> Corners:
        """Bind the coordinates of a slot: each triangle's as its material reads them."""
        values, rows, first = [np.zeros((1, 2), np.float32)], np.zeros((len(numbers), 3), np.int32), 1
        for number, bound in materials.items():
            chosen = numbers == number
            if slot >= len(bound.slots) or not chosen.any():
                continue
            asked: Slot = bound.slots[slot]
            found = primvars.corners(asked.name, 2)
            if found is None:
                self._lacking.setdefault(asked.name, []).append(primvars.place)
                found = Corners(np.zeros((1, 2), np.float32), np.zeros_like(rows))
            values.append(flip_v(asked.applied(found.values)))
            rows[chosen] = found.rows[chosen] + np.int32(first)
            first += len(found.values)
        return Corners(np.concatenate(values), rows)

    def _colors(self, numbers: Int32s, materials: Mapping[int, Bound], primvars: _Primvars) -> Corners | None:
        """Return displayColor and displayOpacity where a material reads them; white elsewhere."""
        lanes = [primvars.corners("displayColor", 3), primvars.corners("displayOpacity", 1)]
        values = np.ones((len(numbers), 3, 4), np.float32)
        for columns, found, reads in zip(
            (slice(3), slice(3, 4)), lanes, ("reads_color", "reads_opacity"), strict=True
        ):
            reading = [number for number, bound in materials.items() if getattr(bound, reads)]
            chosen = np.isin(numbers, reading)
            if found is not None and chosen.any():
                values[chosen, :, columns] = found.values[found.rows[chosen]]
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

        self.what, self.place = what, str(prim.GetPath())
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
        found = self.corners("normals", 3)
        values = self._mesh.GetNormalsAttr().Get(self._time)
        if found is not None or values is None or not len(values):
            return found
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


def _cut_polygons(cut: Int64s, polygons: Int64s, sizes: Int64s) -> Polygons:
    made = cut_polygons(cut, polygons, sizes)
    return Polygons.of_triangles(len(cut)) if made is None else made
