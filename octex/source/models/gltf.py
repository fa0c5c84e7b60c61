"""glTF 2.0 and GLB models: meshes, the scene's transforms and instances, and what materials bind to corners.

trimesh is not asked: beside what its accessors lose (see ``gltf_file``), it skips triangle fans and drops
samplers, texture transforms and all texture coordinates but the first.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Array, Float32s, Float64s, Floats, Int32s, Int64s
from octex.errors import ModelError, ModelWarning
from octex.source.corners import Corners, Frames
from octex.source.materials import MaterialSource
from octex.source.models.gltf_animation import fields_at
from octex.source.models.gltf_file import Document, as_object
from octex.source.models.gltf_materials import Bound, read_materials
from octex.source.models.gltf_motion import Placed, motion_of
from octex.source.models.gltf_pose import Pose
from octex.source.models.gltf_scene import local_matrix, scene_nodes
from octex.source.models.options import Options
from octex.source.motion import Motion
from octex.source.surface import Surface
from octex.source.tangents import corner_frames, transformed

_TRIANGLES, _TRIANGLE_STRIP, _TRIANGLE_FAN = 4, 5, 6


def load_gltf(path: Path, options: Options) -> Surface:
    """Read the scene of a .gltf or .glb file; meshes that no node of it shows are left out.

    Its materials are read as ``gltf_materials`` says, those of primitives in use, as far as ``options`` wants
    their channels. ``uv`` of the surface is TEXCOORD_0, where all primitives with textures have it.
    ``provenance`` holds what the file says of its origin, and the digests of the files that it refers to.

    Rest positions are the mesh as it is modelled, without morph targets and skins. With ``options.pose``
    these and the nodes move the positions, as ``gltf_animation`` and ``gltf_pose`` say.
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


class _Shape(NamedTuple):
    """The triangles of a mesh primitive, and where the file keeps the rest of it."""

    positions: Float64s
    triangles: Int32s
    material: int | None
    attributes: dict[str, Any]
    decoded: dict[str, Array]  # what of them an extension has
    targets: list[Any]  # of morphs
    name: str


class _Instance(NamedTuple):
    """A mesh as a node shows it."""

    mesh: int
    node: int
    copy: Float64s  # (4, 4)   of the mesh below the node
    matrix: Float64s  # (4, 4)   to the world, as it rests


class _Primitive(NamedTuple):
    """A mesh primitive before it is placed in the scene."""

    shape: _Shape
    bound: Bound
    colors: Float32s | None  # (n, 4)
    coordinates: list[Float32s]  # (n, 2)   by slot
    uv: Float32s | None  # (n, 2)   TEXCOORD_0
    frames: Frames | None


class _Scene:
    """Collects the primitives of all nodes into one surface."""

    def __init__(self, document: Document, options: Options) -> None:
        self._document = document
        self._options = options
        self._shapes: dict[int, list[_Shape]] = {}

    def surface(self) -> Surface:
        document = self._document
        shown = self._shown()
        placed = [(instance.matrix, shape) for instance, shape in shown]
        if not placed:
            raise ModelError(f"{document.name} has no triangles; octex needs a surface, not points or lines")
        bound = read_materials(document, (shape.material for _, shape in placed), self._options)
        is_smooth = any("NORMAL" in shape.attributes for _, shape in placed)
        is_mapped = any(each.material.normal_slot is not None for each in bound.values())
        has_normals = is_mapped or (self._options.normals and is_smooth)
        primitives: dict[str, _Primitive] = {}
        for _, shape in placed:
            if shape.name not in primitives:
                primitives[shape.name] = self._primitive(shape, bound[shape.material], has_normals)
        each = [primitives[shape.name] for _, shape in placed]
        vertices, triangles = [], []
        normals, tangents = [], []
        first = 0
        for (matrix, shape), primitive in zip(placed, each, strict=True):
            linear = matrix[:3, :3]
            with np.errstate(over="ignore", invalid="ignore"):  # the surface refuses what is not finite
                # A mirroring transform turns triangles inside out (3.7.4).
                order = slice(None, None, -1 if np.linalg.det(linear) < 0 else 1)
                vertices.append(shape.positions @ linear.T + matrix[:3, 3])
            triangles.append(shape.triangles[:, order] + np.int32(first))
            first += len(shape.positions)
            if primitive.frames is not None:
                turned = transformed(primitive.frames, linear)
                normals.append(turned.normals._replace(rows=turned.normals.rows[:, order]))
                tangents.append(turned.tangents._replace(rows=turned.tangents.rows[:, order]))
        positions, joined = np.concatenate(vertices), np.concatenate(triangles)

        def corners(attributes: list[Float32s | None], default: float) -> Corners | None:
            """Join an attribute of all primitives; those without it get the default. None if none has it."""
            width = next((given.shape[1] for given in attributes if given is not None), None)
            if width is None:
                return None
            rows = [
                np.full((len(shape.positions), width), default, np.float32) if given is None else given
                for (_, shape), given in zip(placed, attributes, strict=True)
            ]
            return Corners(np.concatenate(rows), joined)

        frames = Frames(Corners.joined(normals), Corners.joined(tangents)) if has_normals else None
        slots = zip_longest(*(primitive.coordinates for primitive in each))
        numbers = {number: index for index, number in enumerate(bound)}
        source = MaterialSource(
            [entry.material for entry in bound.values()],
            np.repeat(
                np.array([numbers[shape.material] for _, shape in placed], np.int32),
                [len(shape.triangles) for _, shape in placed],
            ),
            positions,
            joined,
            colors=corners([primitive.colors for primitive in each], 1.0),
            coordinates=[found for slot in slots if (found := corners(list(slot), 0.0)) is not None],
            frames=frames,
            name=document.name,
            filter=self._options.filter,
            channels=self._options.channels,
        )
        uv = None
        if all(primitive.uv is not None for primitive in each):
            uv = corners([primitive.uv for primitive in each], 0.0)
        return Surface(
            positions if self._options.pose is None else self._posed(self._options.pose, shown),
            joined,
            source,
            rest=None if self._options.pose is None else positions,
            uv=uv,
            frames=frames if is_smooth else None,
            name=document.name,
            provenance=self._provenance(),
        )

    def motion(self, rate: float) -> Motion | None:
        """Return how all vertices move, so many frames a second; None without animations."""
        placed = [
            Placed(
                instance.node, instance.copy, instance.matrix, shape.positions, shape.targets,
                partial(self._attribute, shape), shape.name,
            )
            for instance, shape in self._shown()
        ]  # fmt: skip
        return motion_of(self._document, placed, rate)

    def _shown(self) -> list[tuple[_Instance, _Shape]]:
        """List the primitives of the scene that have triangles, where nodes show them."""
        return [
            (instance, shape)
            for instance in self._instances()
            for shape in self._mesh(instance.mesh)
            if len(shape.triangles)
        ]

    def _provenance(self) -> dict[str, str]:
        """Return what the file says of its origin and licence, and the digests of the files it refers to."""
        asset = self._document.json["asset"]
        extras = asset.get("extras")
        found = {key: str(asset[key]) for key in ("copyright", "generator") if key in asset}
        if isinstance(extras, dict):
            keys = ("author", "license", "licence")
            found |= {key: extras[key] for key in keys if isinstance(extras.get(key), str)}
        if self._document.files:
            found["files"] = json.dumps(self._document.files, sort_keys=True, ensure_ascii=False)
        return found

    def _posed(self, pose: str, shown: Sequence[tuple[_Instance, _Shape]]) -> Float64s:
        """Return the positions (n, 3) of all vertices in a pose."""
        posed = Pose(self._document, fields_at(self._document, pose))
        return np.concatenate(
            [
                posed.positions(
                    instance.node,
                    instance.copy,
                    shape.positions,
                    shape.targets,
                    partial(self._attribute, shape),
                    shape.name,
                )
                for instance, shape in shown
            ]
        )

    def _instances(self) -> list[_Instance]:
        """List the meshes of the scene, depth first."""
        return [
            _Instance(node["mesh"], number, each, matrix @ each)
            for number, node, matrix in scene_nodes(self._document)
            if "mesh" in node
            for each in self._copies(node)
        ]

    def _copies(self, node: dict[str, Any]) -> list[Float64s]:
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

    def _mesh(self, number: int) -> list[_Shape]:
        if number not in self._shapes:
            name = f"meshes[{number}].primitives"
            entries = [
                as_object(entry, f"{self._document.name}: {name}[{index}]")
                for index, entry in enumerate(self._document.item("meshes", number)["primitives"])
            ]
            self._shapes[number] = [
                self._shape(entry, f"{name}[{index}]")
                for index, entry in enumerate(entries)
                if entry.get("mode", _TRIANGLES) in (_TRIANGLES, _TRIANGLE_STRIP, _TRIANGLE_FAN)
                and "POSITION" in entry["attributes"]
            ]
        return self._shapes[number]

    def _shape(self, entry: dict[str, Any], name: str) -> _Shape:
        document = self._document
        attributes = entry["attributes"]
        triangles, decoded = document.draco(entry, f"{document.name}: {name}") or (None, {})
        positions = document.accessor(attributes["POSITION"], (3,), decoded.get("POSITION"))
        with np.errstate(invalid="ignore"):  # of signalling NaNs
            positions = positions.astype(np.float64)
        if not np.isfinite(positions).all():
            raise ModelError(f"{document.name}: {name} has vertices that are not finite; repair the model")
        indices = self._indices(entry, triangles, len(positions), name)
        mode = entry.get("mode", _TRIANGLES) if triangles is None else _TRIANGLES
        number = entry.get("material") if self._options.materials else None
        return _Shape(
            positions, _triangles(indices, mode).astype(np.int32), number, attributes, decoded,
            entry.get("targets", []), name,
        )  # fmt: skip

    def _indices(self, entry: dict[str, Any], triangles: Array | None, count: int, name: str) -> Int64s:
        """Return the vertices of the corners of a primitive, or of its decoded triangles: below ``count``."""
        document = self._document
        if triangles is not None:
            indices = triangles.reshape(-1)
        elif "indices" in entry:
            indices = document.accessor(entry["indices"], (1,))[:, 0]
        else:
            return np.arange(count)
        if indices.dtype.kind == "f":
            raise ModelError(f"{document.name}: the indices of {name} are not integers; export it again")
        low, high = indices.min(initial=0), indices.max(initial=0)
        if len(indices) and not 0 <= low <= high < count:
            raise ModelError(
                f"{document.name}: {name} uses vertex {low if low < 0 else high}, but there are {count}; "
                "export the model again"
            )
        if high == np.iinfo(indices.dtype).max:
            raise ModelError(
                f"{document.name}: {name} uses vertex {high}, but {indices.dtype.name} indices keep this "
                "number for the end of a strip (3.7.2.1); export it with wider indices"
            )
        return indices.astype(np.int64)

    def _primitive(self, shape: _Shape, bound: Bound, has_normals: bool) -> _Primitive:
        """Read what a shape's material needs, and what may be of use without one."""
        if not self._options.materials:
            return _Primitive(shape, bound, None, [], None, None)
        colors = None
        given = self._attribute(shape, "COLOR_0", (3, 4))
        if given is not None:
            colors = np.ones((len(given), 4), np.float32)
            colors[:, : given.shape[1]] = given
        uv = self._attribute(shape, "TEXCOORD_0", (2,))
        coordinates = []
        for slot in bound.slots:
            name = f"TEXCOORD_{slot.number}"
            given = uv if slot.number == 0 else self._attribute(shape, name, (2,))
            if given is None:
                text = (
                    f"{self._document.name}: a textured material is of meshes without {name}, which read one"
                )
                warnings.warn(text + " texel; give them coordinates", ModelWarning, stacklevel=2)
                given = np.zeros((len(shape.positions), 2))
            with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused in use
                coordinates.append(slot.applied(given).astype(np.float32))
        frames = self._frames(shape, bound, coordinates) if has_normals else None
        return _Primitive(
            shape, bound, colors, coordinates, None if uv is None else uv.astype(np.float32), frames
        )

    def _frames(self, shape: _Shape, bound: Bound, coordinates: Sequence[Float32s]) -> Frames:
        """Return a primitive's frames in its own space; tangents mean something only below a normal map."""

        def corners(rows: Floats | None) -> Corners | None:
            return None if rows is None else Corners(rows.astype(np.float32), shape.triangles)

        normals = corners(self._attribute(shape, "NORMAL", (3,)))
        slot = bound.material.normal_slot
        if slot is None:
            return corner_frames(shape.positions, shape.triangles, normals, None, None)
        tangents = corners(self._attribute(shape, "TANGENT", (4,)))
        mapped = corners(coordinates[slot])
        return corner_frames(shape.positions, shape.triangles, normals, tangents, mapped)

    def _attribute(self, shape: _Shape, name: str, components: tuple[int, ...]) -> Float64s | None:
        """Return a vertex attribute, None if the primitive has none of this name."""
        if name not in shape.attributes:
            return None
        rows = self._document.accessor(shape.attributes[name], components, shape.decoded.get(name))
        with np.errstate(invalid="ignore"):
            rows = rows.astype(np.float64)
        if len(rows) != len(shape.positions):
            raise ModelError(
                f"{self._document.name}: {shape.name} {name} has {len(rows)} rows "
                f"for {len(shape.positions)} vertices"
            )
        return rows


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
