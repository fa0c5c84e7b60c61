"""USD stages, .usd, .usda, .usdc and .usdz: meshes, shapes, transforms, and UsdPreviewSurface materials.

OpenUSD (the extra ``usd``) composes the stage. It is read in metres with y up, as in glTF, at the earliest
time sampled. A subdivision surface is read as its cage. An image's colour space is that of its channel,
unless the file names the other one.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Tf, Usd, UsdGeom, UsdShade, UsdUtils

from octex.arrays import Array, Float64s, Int32s, Int64s
from octex.errors import ModelError, damaged
from octex.files import is_absolute
from octex.source.corners import Corners
from octex.source.mesh import check_below
from octex.source.models.reading import (
    LoadedMaterial,
    Options,
    PlacedMesh,
    assembled,
    cut_polygons,
    slot_coordinates,
    triangulate,
    warn,
    with_frames,
)
from octex.source.models.usd_materials import Materials, bound_material
from octex.source.models.usd_shapes import shape_polygons
from octex.source.surface import Surface, flip_v

#: Most meshes that point instancers may place: nested instancers multiply.
_PLACEMENTS = 2**20
#: As in Hydra: prims that are defined, also prototypes below an "over", which hides them elsewhere.
_DRAWN = Usd.TraverseInstanceProxies(
    Usd.PrimIsActive & Usd.PrimHasDefiningSpecifier & Usd.PrimIsLoaded & ~Usd.PrimIsAbstract
)
#: The interpolations of primvars (UsdGeom's tokens).
_SPREADS = ("constant", "uniform", "vertex", "varying", "faceVarying")


def load_usd(path: Path, options: Options) -> Surface:
    """Read the visible meshes and shapes of a USD stage, with their materials.

    Curves, points and materials other than UsdPreviewSurface are left out, with ModelWarning; without
    coordinates images are read at (0, 0). ``uv`` is the first set of coordinates that is read, or ``st``.
    """
    quiet = UsdUtils.CoalescingDiagnosticDelegate()  # while it lives, OpenUSD prints nothing
    try:
        stage = Usd.Stage.Open(str(path.absolute()))
        # A file from elsewhere must not make octex read other files.
        for layer in stage.GetUsedLayers():
            for file in filter(is_absolute, layer.GetCompositionAssetDependencies()):
                raise ModelError(
                    f"{path.name} refers to {file}; absolute paths are not followed; name it from its folder"
                )
        faults = dict.fromkeys(" ".join(str(fault).split()) for fault in stage.GetCompositionErrors())
        others = [fault for fault in faults if ".mtlx@" not in fault]
        if len(others) < len(faults):
            warn(f"{path.name} has MaterialX files, which are not read; use UsdPreviewSurface")
        if others:
            more = f" … and {len(others) - 1} more like that" if len(others) > 1 else ""
            warn(f"{path.name} is not whole: {others[0][:200]}{more}")
        return _Scene(stage, path.name, options).surface()
    except Tf.ErrorException as error:
        # The first line that tells more than that the file cannot be opened.
        match = re.search(r" : '(?!Failed to open)(.+?)'?$", str(error), re.MULTILINE)
        reason = f" ({match[1].replace(str(path.absolute()), path.name)[:200]})" if match else ""
        raise damaged(f"{path.name} is damaged, or is not a USD stage{reason}") from None
    finally:
        del quiet


class _Scene:
    """Collects the meshes of a stage into one surface."""

    def __init__(self, stage: Any, name: str, options: Options) -> None:
        self._stage, self._name, self._options = stage, name, options
        self._time = Usd.TimeCode.EarliestTime()
        self._transforms = UsdGeom.XformCache(self._time)
        self._materials = Materials(name, options)
        self._instances_left = _PLACEMENTS
        # Meshes without a set of coordinates that is read, by the set's name.
        self._missing: dict[str, dict[str, None]] = {}

    def surface(self) -> Surface:
        """Return all visible meshes and shapes as one surface."""
        visible = self._visible()
        materials = {prim: self._materials_of(prim) for prim, _ in visible}
        has_frames = self._options.normals or any(
            each.material.normal_slot is not None
            for _, loaded in materials.values()
            for each in loaded.values()
        )
        part_of = {prim: self._part(prim, *each, has_frames) for prim, each in materials.items()}
        parts = [part_of[p]._replace(matrix=matrix) for p, matrix in visible if len(part_of[p].triangles)]
        for name, meshes in self._missing.items():
            more = f" and {len(meshes) - 1} more" if len(meshes) > 1 else ""
            what = f"{self._name}: {next(iter(meshes))}{more} lack the primvar {name}"
            warn(f"{what}: images are read at (0, 0) there")
        if not parts:
            raise ModelError(f"{self._name} has no triangles; octex needs a surface, not points or curves")
        files = self._materials.files
        return assembled(
            parts, [each.material for each in self._materials.loaded], self._options, self._name,
            provenance={"files": json.dumps(files, sort_keys=True)} if files else {},
        )  # fmt: skip

    def _visible(self) -> list[tuple[Any, Float64s]]:
        """List the visible meshes and shapes, each with its matrix (4, 4) to a world in metres with y up."""
        world = np.eye(4)
        if UsdGeom.GetStageUpAxis(self._stage) == UsdGeom.Tokens.z:
            world = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
        # UsdGeom's function refuses single precision, which several programs write.
        world[:3] *= float(self._stage.GetMetadata("metersPerUnit"))
        left_out: Counter[str] = Counter()
        visible = list(self._below(self._stage.GetPseudoRoot(), world, left_out))
        if left_out:
            listing = ", ".join(f"{count} {kind}" for kind, count in left_out.items())
            warn(f"{self._name}: octex reads meshes and solids, and leaves out {listing}; export meshes")
        return visible

    def _below(
        self, root: Any, outer: Float64s, left_out: Counter[str], above: tuple[Any, ...] = ()
    ) -> Iterator[tuple[Any, Float64s]]:
        """Yield the visible meshes below a prim, placed by ``outer``; ``above`` are its instancers.

        ``left_out`` counts the prims of other types.
        """
        prims = iter(Usd.PrimRange(root, _DRAWN))
        for prim in prims:
            is_instancer = prim.IsA(UsdGeom.PointInstancer)
            if is_instancer:
                prims.PruneChildren()
            elif not prim.IsA(UsdGeom.Gprim):
                continue
            imageable = UsdGeom.Imageable(prim)
            purposes = UsdGeom.Tokens.default_, UsdGeom.Tokens.render
            is_hidden = imageable.ComputeVisibility(self._time) == UsdGeom.Tokens.invisible
            if is_hidden or imageable.ComputePurpose() not in purposes:
                continue
            if root.IsPseudoRoot():
                relative = self._transforms.GetLocalToWorldTransform(prim)
            else:
                relative = self._transforms.ComputeRelativeTransform(prim, root)[0]
            matrix = outer @ np.array(relative, np.float64).T
            if is_instancer:
                if prim in above:
                    raise damaged(f"{self._name}: {prim.GetPath()} contains itself")
                yield from self._instances(prim, matrix, left_out, (*above, prim))
            elif prim.IsA(UsdGeom.Mesh) or shape_polygons(prim, self._time) is not None:
                yield prim, matrix
            else:
                left_out[prim.GetTypeName()] += 1

    def _instances(
        self, prim: Any, outer: Float64s, left_out: Counter[str], above: tuple[Any, ...]
    ) -> Iterator[tuple[Any, Float64s]]:
        """Yield the meshes of each instance of a point instancer, placed by ``outer``."""
        api = UsdGeom.PointInstancer
        instancer = api(prim)
        samples = (
            instancer.GetPositionsAttr().GetTimeSamples() or instancer.GetOrientationsAttr().GetTimeSamples()
        )
        # The earliest time is −∞, where velocities would move instances.
        now = Usd.TimeCode(samples[0]) if samples else self._time
        roots = [self._stage.GetPrimAtPath(path) for path in instancer.GetPrototypesRel().GetTargets()]
        prototypes = _rows(instancer.GetProtoIndicesAttr().Get(now)).astype(np.int64)
        check_below(prototypes, len(roots), f"{self._name}: {prim.GetPath()} uses a prototype")
        matrices = instancer.ComputeInstanceTransformsAtTime(now, now, api.IncludeProtoXform, api.IgnoreMask)
        if len(matrices) != len(prototypes):
            raise damaged(
                f"{self._name}: {prim.GetPath()} has {len(prototypes)} instances, places {len(matrices)}"
            )
        mask = instancer.ComputeMaskAtTime(now) or [True] * len(prototypes)
        meshes = [list(self._below(root, np.eye(4), left_out, above)) if root else [] for root in roots]
        for prototype, matrix, is_visible in zip(prototypes.tolist(), matrices, mask, strict=True):
            placement = outer @ np.array(matrix, np.float64).T
            for mesh, inner in meshes[prototype] if is_visible else ():
                self._instances_left -= 1
                if self._instances_left < 0:
                    raise ModelError(f"{self._name}: {prim.GetPath()} has too many instances; export fewer")
                yield mesh, placement @ inner

    def _materials_of(self, prim: Any) -> tuple[dict[int, Int64s], dict[int, LoadedMaterial]]:
        """Return the faces of a mesh by material number, and the materials, the mesh's first."""
        api = UsdShade.MaterialBindingAPI(prim)
        both = bool(UsdGeom.Gprim(prim).GetDoubleSidedAttr().Get(self._time))
        opacity = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayOpacity").Get(self._time)
        fades = opacity is not None and bool((np.asarray(opacity) < 1.0).any())
        default = self._materials.number(bound_material(api), both, fades)
        faces: dict[int, Int64s] = {default: np.empty(0, np.int64)}
        for subset in api.GetMaterialBindSubsets():
            material = bound_material(UsdShade.MaterialBindingAPI(subset.GetPrim()))
            number = self._materials.number(material, both, fades)
            of_subset = np.array(subset.GetIndicesAttr().Get(self._time) or [], np.int64)
            faces[number] = np.concatenate([faces.get(number, of_subset[:0]), of_subset])
        return faces, {number: self._materials.loaded[number] for number in faces}

    def _part(
        self, prim: Any, faces: dict[int, Int64s], materials: dict[int, LoadedMaterial], has_frames: bool
    ) -> PlacedMesh:
        what, holes = f"{self._name}: {prim.GetPath()}", np.empty(0, np.int64)
        shape = shape_polygons(prim, self._time)
        if shape is not None:
            positions, sizes, corners = shape
        else:
            mesh = UsdGeom.Mesh(prim)
            positions = _rows(mesh.GetPointsAttr().Get(self._time), 3).astype(np.float64)
            sizes = _rows(mesh.GetFaceVertexCountsAttr().Get(self._time)).astype(np.int64)
            corners = _rows(mesh.GetFaceVertexIndicesAttr().Get(self._time)).astype(np.int64)
            holes = _rows(mesh.GetHoleIndicesAttr().Get(self._time)).astype(np.int64)
        if not self._options.finite and not np.isfinite(positions).all():
            raise ModelError(
                f"{what} has points that are not finite; repair the model (--repair leaves them out)"
            )
        if sizes.min(initial=0) < 0 or sizes.sum() != len(corners):
            raise damaged(f"{what}: its faces have {sizes.sum()} corners, its list {len(corners)}")
        check_below(corners, len(positions), f"{what} uses a point")
        cut, owners = triangulate(positions, corners, sizes)
        is_solid = ~np.isin(owners, holes)
        cut, owners = cut[is_solid], owners[is_solid]
        has_polygons = len(np.unique(owners)) < len(owners)
        polygons = cut_polygons(cut, owners, sizes) if has_polygons else None
        if UsdGeom.Gprim(prim).GetOrientationAttr().Get(self._time) == UsdGeom.Tokens.leftHanded:
            cut, polygons = cut[:, ::-1], polygons and polygons._replace(corners=polygons.corners[:, ::-1])
        primvars = _Primvars(prim, self._time, what, corners, sizes, cut)
        triangles = corners[cut].astype(np.int32)
        numbers = np.full(len(sizes), next(iter(materials)), np.int32)
        for number, of_material in faces.items():
            check_below(of_material, len(sizes), f"{what} binds a material to a face")
            numbers[of_material] = number
        part = PlacedMesh(positions, triangles, numbers[owners], polygons=polygons)
        if not self._options.materials:
            return part._replace(materials=np.zeros(len(triangles), np.int32))
        at_zero = Corners(np.zeros((1, 2), np.float32), np.zeros_like(triangles))

        def read(name: str) -> Corners:
            coordinates = primvars.corners(name, 2)
            if coordinates is None:
                self._missing.setdefault(name, {})[str(prim.GetPath())] = None
            return coordinates or at_zero

        coordinates = slot_coordinates(materials, part.materials, read)
        first = next((slot.name for each in materials.values() for slot in each.slots), "st")
        uv = primvars.corners(first, 2)
        part = part._replace(
            colors=_display_colors(part.materials, materials, primvars),
            coordinates=coordinates,
            uv=uv and uv._replace(values=flip_v(uv.values)),
        )
        return with_frames(part, materials, primvars.normals(), at_zero) if has_frames else part


def _display_colors(
    numbers: Int32s, materials: dict[int, LoadedMaterial], primvars: _Primvars
) -> Corners | None:
    """Return displayColor and displayOpacity for materials that read them; white for others."""
    values = np.ones((len(numbers), 3, 4), np.float32)
    colors, opacities = primvars.corners("displayColor", 3), primvars.corners("displayOpacity", 1)
    for columns, corners, field in (
        (slice(3), colors, "reads_color"),
        (slice(3, 4), opacities, "reads_opacity"),
    ):
        reads = np.isin(numbers, [number for number, each in materials.items() if getattr(each, field)])
        if corners is not None and reads.any():
            values[reads, :, columns] = corners.values[corners.rows[reads]]
    if (values == 1.0).all():
        return None
    distinct, rows = np.unique(values.reshape(-1, 4), axis=0, return_inverse=True)
    return Corners(distinct, rows.reshape(-1, 3).astype(np.int32))


class _Primvars:
    """The primvars of a mesh, at the corners of its triangles."""

    def __init__(
        self, prim: Any, time: Any, what: str, corners: Int64s, sizes: Int64s, triangles: Int64s
    ) -> None:
        self.what = what
        self._mesh, self._api, self._time = UsdGeom.PointBased(prim), UsdGeom.PrimvarsAPI(prim), time
        self._rows = {
            "constant": np.zeros(triangles.shape, np.int64),
            "uniform": np.repeat(np.arange(len(sizes)), sizes)[triangles],
            "vertex": corners[triangles],
            "faceVarying": triangles,
        }
        self._rows["varying"] = self._rows["vertex"]

    def corners(self, name: str, width: int) -> Corners | None:
        """Return a primvar of ``width`` components, which may be inherited; None if it is missing."""
        primvar = self._api.FindPrimvarWithInheritance(name)
        if not primvar or not primvar.HasValue():
            return None
        values = primvar.Get(self._time)
        indices = primvar.GetIndices(self._time) if primvar.IsIndexed() else None
        return self._spread(name, values, width, primvar.GetInterpolation(), indices)

    def normals(self) -> Corners | None:
        """Return the normals; a primvar overrides the mesh's attribute."""
        primvar = self.corners("normals", 3)
        if not self._mesh:  # a shape
            return primvar
        values = self._mesh.GetNormalsAttr().Get(self._time)
        if primvar is not None or values is None or not len(values):
            return primvar
        return self._spread("normals", values, 3, self._mesh.GetNormalsInterpolation(), None)

    def _spread(self, name: str, values: Any, width: int, spread: str, indices: Any) -> Corners:
        array = np.asarray(values)
        if array.ndim < 2 and array.size % width == 0:  # one for all, or numbers alone
            array = array.reshape(-1, width)
        if array.ndim != 2 or array.shape[1] != width or array.dtype.kind not in "fiu":
            raise damaged(f"{self.what}: its primvar {name} has not {width} numbers each")
        if spread not in _SPREADS:
            raise damaged(f"{self.what}: its primvar {name} is spread by {spread!r}")
        rows = self._rows[spread]
        if indices is not None and len(indices):  # some programs write an empty list
            check_below(rows, len(indices), f"{self.what}: its primvar {name} lacks an index; it uses")
            rows = np.asarray(indices, np.int64)[rows]
        check_below(rows, len(array), f"{self.what}: its primvar {name} uses a value")
        return Corners(array.astype(np.float32), rows.astype(np.int32))


def _rows(values: Any, width: int | None = None) -> Array:
    if values is None:
        return np.empty((0,) if width is None else (0, width), np.float32)
    return np.asarray(values)
