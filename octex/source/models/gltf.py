"""glTF 2.0 and GLB models: meshes, the scene's transforms and instances, and what materials bind to corners.

trimesh is not asked: beside what its accessors lose (see ``gltf_file``), it skips triangle fans and drops
samplers, texture transforms and all texture coordinates but the first.
"""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np

from octex.arrays import Array, Float64s, Floats, Int64s
from octex.errors import ModelError, ModelWarning
from octex.source.corners import Corners
from octex.source.models.gltf_file import Document, Json, as_object, local_matrix, scene_nodes
from octex.source.models.gltf_materials import read_materials
from octex.source.models.gltf_motion import Placed, Primitive, motion_of, pose_of
from octex.source.models.reading import Description, Options, Part, assembled
from octex.source.motion import Motion
from octex.source.surface import Surface
from octex.source.tangents import corner_frames

_TRIANGLES, _TRIANGLE_STRIP, _TRIANGLE_FAN = 4, 5, 6


def load_gltf(path: Path, options: Options) -> Surface:
    """Read the scene of a .gltf or .glb file; meshes that no node of it shows are left out.

    Its materials are read as ``gltf_materials`` says, those of primitives in use, as far as ``options`` wants
    their channels. ``uv`` of the surface is TEXCOORD_0, where all primitives with textures have it.
    ``provenance`` holds what the file says of its origin, and the digests of the files that it refers to.

    Rest positions are the mesh as it is modelled, without morph targets and skins. With ``options.pose``
    these and the nodes move the positions, as ``gltf_motion`` says.
    Raises ModelError or ImageError, and ArgumentError for a pose that the file lacks.
    """
    document = Document(path)
    document.refuse_extensions()
    return _Scene(document, options).surface()


def load_gltf_motion(path: Path, rate: float) -> Motion | None:
    """Return the animations of a .gltf or .glb file, None if it has none: see ``gltf_motion``."""
    document = Document(path)
    document.refuse_extensions()
    return _Scene(document, Options(materials=False)).motion(rate)


class _Scene:
    """Collects the primitives of all nodes into one surface."""

    def __init__(self, document: Document, options: Options) -> None:
        self._document = document
        self._options = options
        self._meshes: dict[int, list[Primitive]] = {}

    def surface(self) -> Surface:
        document, options = self._document, self._options
        shown = self._shown()
        if not shown:
            raise ModelError(f"{document.name} has no triangles; octex needs a surface, not points or lines")
        known = read_materials(document, (each.primitive.material for each in shown), options)
        numbers = {number: place for place, number in enumerate(known)}
        is_mapped = any(each.material.normal_slot is not None for each in known.values())
        is_smooth = any("NORMAL" in each.primitive.attributes for each in shown)
        has_frames = is_mapped or (options.normals and is_smooth)
        parts: dict[str, Part] = {}
        for primitive in (each.primitive for each in shown):
            if primitive.name not in parts:
                part = self._part(primitive, known[primitive.material], has_frames)
                number = np.full(len(primitive.triangles), numbers[primitive.material], np.int32)
                parts[primitive.name] = part._replace(materials=number)
        posed = None
        if options.pose is not None:
            pose = pose_of(document, options.pose)
            posed = np.concatenate([pose.positions(each) for each in shown])
        return assembled(
            [parts[each.primitive.name]._replace(matrix=each.matrix) for each in shown],
            [each.material for each in known.values()],
            options,
            document.name,
            provenance=self._provenance(),
            posed=posed,
        )

    def motion(self, rate: float) -> Motion | None:
        """Return how all vertices move, so many frames a second; None without animations."""
        return motion_of(self._document, self._shown(), rate)

    def _shown(self) -> list[Placed]:
        """List the primitives that have triangles, as the nodes of the scene show them, depth first."""
        return [
            Placed(number, copy, matrix @ copy, primitive)
            for number, node, matrix in scene_nodes(self._document)
            if "mesh" in node
            for copy in self._copies(node)
            for primitive in self._mesh(node["mesh"])
            if len(primitive.triangles)
        ]

    def _provenance(self) -> dict[str, str]:
        """Return what the file says of its origin and licence, and the digests of the files it refers to."""
        asset = self._document.json["asset"]
        extras = asset.get("extras")
        origin = {key: str(asset[key]) for key in ("copyright", "generator") if key in asset}
        if isinstance(extras, dict):
            keys = ("author", "license", "licence")
            origin |= {key: extras[key] for key in keys if isinstance(extras.get(key), str)}
        if self._document.files:
            origin["files"] = json.dumps(self._document.files, sort_keys=True, ensure_ascii=False)
        return origin

    def _copies(self, node: Json) -> list[Float64s]:
        """Return the transforms of a node's instances (EXT_mesh_gpu_instancing), else only the identity."""
        instancing = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
        if instancing is None:
            return [np.eye(4)]
        columns = {
            key: self._document.accessor(instancing["attributes"][name], (3, 4)).astype(np.float64)
            for name, key in (("TRANSLATION", "translation"), ("ROTATION", "rotation"), ("SCALE", "scale"))
            if name in instancing["attributes"]
        }
        count = min((len(rows) for rows in columns.values()), default=0)
        return [local_matrix({key: rows[i] for key, rows in columns.items()}) for i in range(count)]

    def _mesh(self, number: int) -> list[Primitive]:
        if number not in self._meshes:
            what = f"{self._document.name}: meshes[{number}].primitives"
            entries = [
                as_object(entry, f"{what}[{index}]")
                for index, entry in enumerate(self._document.item("meshes", number)["primitives"])
            ]
            self._meshes[number] = [
                self._primitive(entry, f"{what}[{index}]")
                for index, entry in enumerate(entries)
                if entry.get("mode", _TRIANGLES) in (_TRIANGLES, _TRIANGLE_STRIP, _TRIANGLE_FAN)
                and "POSITION" in entry["attributes"]
            ]
        return self._meshes[number]

    def _primitive(self, entry: Json, name: str) -> Primitive:
        document = self._document
        attributes = entry["attributes"]
        triangles, decoded = document.draco(entry, name) or (None, {})
        positions = document.accessor(attributes["POSITION"], (3,), decoded.get("POSITION"))
        with np.errstate(invalid="ignore"):  # of signalling NaNs
            positions = positions.astype(np.float64)
        if not np.isfinite(positions).all():
            raise ModelError(f"{name} has vertices that are not finite; repair the model")
        indices = self._indices(entry, triangles, len(positions), name)
        mode = entry.get("mode", _TRIANGLES) if triangles is None else _TRIANGLES
        number = entry.get("material") if self._options.materials else None
        return Primitive(
            document, name, positions, _triangles(indices, mode).astype(np.int32), number, attributes,
            decoded, entry.get("targets", []),
        )  # fmt: skip

    def _indices(self, entry: Json, triangles: Array | None, count: int, name: str) -> Int64s:
        """Return the vertices of the corners of a primitive, or of its decoded triangles: below ``count``."""
        if triangles is not None:
            indices = triangles.reshape(-1)
        elif "indices" in entry:
            indices = self._document.accessor(entry["indices"], (1,))[:, 0]
        else:
            return np.arange(count)
        if indices.dtype.kind == "f":
            what = name.replace(": ", ": the indices of ", 1)
            raise ModelError(f"{what} are not integers; export it again")
        low, high = indices.min(initial=0), indices.max(initial=0)
        if len(indices) and not 0 <= low <= high < count:
            raise ModelError(
                f"{name} uses vertex {low if low < 0 else high}, but there are {count}; "
                "export the model again"
            )
        if high == np.iinfo(indices.dtype).max:
            raise ModelError(
                f"{name} uses vertex {high}, but {indices.dtype.name} indices keep this "
                "number for the end of a strip (3.7.2.1); export it with wider indices"
            )
        return indices.astype(np.int64)

    def _part(self, primitive: Primitive, known: Description, has_frames: bool) -> Part:
        """Read what a primitive's material needs, and what may be of use without one."""
        positions, triangles = primitive.positions, primitive.triangles
        part = Part(positions, triangles, np.zeros(len(triangles), np.int32))
        if not self._options.materials:
            return part

        def bound(rows: Floats | None) -> Corners | None:
            return None if rows is None else Corners(rows.astype(np.float32), triangles)

        colors = primitive.attribute("COLOR_0", (3, 4))
        if colors is not None and colors.shape[1] == 3:
            colors = np.append(colors, np.ones((len(colors), 1)), axis=1)
        uv = primitive.attribute("TEXCOORD_0", (2,))
        coordinates = []
        for slot in known.slots:
            read = uv if slot.name == "TEXCOORD_0" else primitive.attribute(slot.name, (2,))
            if read is None:
                text = (
                    f"{self._document.name}: a textured material is of meshes without {slot.name}, which read"
                )
                warnings.warn(text + " one texel; give them coordinates", ModelWarning, stacklevel=2)
                read = np.zeros((len(positions), 2))
            with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused in use
                coordinates.append(Corners(slot.applied(read).astype(np.float32), triangles))
        frames = None
        if has_frames:
            normals, place = bound(primitive.attribute("NORMAL", (3,))), known.material.normal_slot
            tangents = mapped = None
            if place is not None:  # tangents mean something only below a normal map
                tangents, mapped = bound(primitive.attribute("TANGENT", (4,))), coordinates[place]
            frames = corner_frames(positions, triangles, normals, tangents, mapped)
        is_smooth = "NORMAL" in primitive.attributes
        return Part(
            positions, triangles, part.materials, bound(colors), coordinates, bound(uv), frames, is_smooth
        )


def _triangles(indices: Int64s, mode: int) -> Int64s:
    """Return the triangles (m, 3) of a list, a strip or a fan (3.7.2.1); what is left over is dropped."""
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    count = max(len(indices) - 2, 0)
    first = np.arange(count)
    if mode == _TRIANGLE_FAN:
        return np.stack([indices[first + 1], indices[first + 2], np.broadcast_to(indices[:1], count)], axis=1)
    odd = first % 2
    return np.stack([indices[first], indices[first + 1 + odd], indices[first + 2 - odd]], axis=1)
