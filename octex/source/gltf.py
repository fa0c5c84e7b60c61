"""glTF 2.0 and GLB models: meshes, the scene's transforms and instances, base colour bound as the file says.

trimesh is not asked: beside what its accessors lose (see ``gltf_file``), it skips triangle fans and drops
samplers, texture transforms and all texture coordinates but the first.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.errors import ImageError, ModelError
from octex.source.gltf_file import CODED, Document
from octex.source.images import decode_image
from octex.source.materials import AlphaMode, Corners, Material, MaterialSource, Texture
from octex.source.pyramid import CLAMP, MIRROR, REPEAT
from octex.source.surface import Surface

_TRIANGLES, _TRIANGLE_STRIP, _TRIANGLE_FAN = 4, 5, 6
_ALPHA_MODES: dict[str, AlphaMode] = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}
_WRAPS = {10497: REPEAT, 33648: MIRROR, 33071: CLAMP}
_NEAREST = 9728


def load_gltf(path: Path, materials: bool = True) -> Surface:
    """Read the scene of a .gltf or .glb file; meshes that no node of it shows are left out.

    Without ``materials`` the surface is white, and no image is read.

    Morph targets and skins are not applied: the mesh is taken as it is modelled.
    Raises ModelError or ImageError.
    """
    return _Scene(Document(path), materials).surface()


class _Primitive(NamedTuple):
    """A mesh primitive before it is placed in the scene."""

    positions: npt.NDArray[np.float64]
    triangles: npt.NDArray[np.int64]
    material: int
    colors: npt.NDArray[np.float32] | None  # (n, 4)
    coordinates: npt.NDArray[np.float32] | None  # (n, 2)   of the base colour texture


class _Scene:
    """Collects the primitives of all nodes into one surface."""

    def __init__(self, document: Document, materials: bool) -> None:
        self._document = document
        self._has_materials = materials
        self._primitives: dict[int, list[_Primitive]] = {}
        self._materials: list[Material] = []
        self._material_numbers: dict[int | None, int] = {}
        self._images: dict[int, npt.NDArray[np.uint16]] = {}

    def surface(self) -> Surface:
        document = self._document
        placed = [
            (matrix, primitive)
            for mesh, matrix in self._instances()
            for primitive in self._mesh(mesh)
            if len(primitive.triangles)
        ]
        if not placed:
            raise ModelError(f"{document.name} has no triangles; octex needs a surface, not points or lines")
        vertices, triangles = [], []
        first = 0
        for matrix, primitive in placed:
            with np.errstate(over="ignore", invalid="ignore"):  # the surface refuses what is not finite
                vertices.append(primitive.positions @ matrix[:3, :3].T + matrix[:3, 3])
            # A mirroring transform turns triangles inside out (3.7.4).
            corners = (
                primitive.triangles[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else primitive.triangles
            )
            triangles.append((corners + first).astype(np.int32))
            first += len(primitive.positions)
        joined = np.concatenate(triangles)
        each = [primitive for _, primitive in placed]
        colors = _corners(each, [p.colors for p in each], np.ones(4, np.float32), joined)
        coordinates = _corners(each, [p.coordinates for p in each], np.zeros(2, np.float32), joined)
        numbers = np.repeat(np.array([p.material for p in each], np.int32), [len(p.triangles) for p in each])
        positions = np.concatenate(vertices)
        source = MaterialSource(
            self._materials,
            numbers,
            positions,
            joined,
            colors=colors,
            coordinates=coordinates,
            name=document.name,
        )
        asset = document.json["asset"]
        return Surface(
            positions,
            joined,
            source,
            name=document.name,
            provenance={key: str(asset[key]) for key in ("copyright", "generator") if key in asset},
        )

    def _instances(self) -> list[tuple[int, npt.NDArray[np.float64]]]:
        """List the meshes of the scene, each with its global transform, depth first."""
        document = self._document
        if "scenes" in document.json:
            roots = document.item("scenes", document.json.get("scene", 0)).get("nodes", [])
        else:  # without scenes a file is a library; its roots are the best guess
            children = {c for n in document.json.get("nodes", []) for c in n.get("children", [])}
            roots = [i for i in range(len(document.json.get("nodes", []))) if i not in children]
        found: list[tuple[int, npt.NDArray[np.float64]]] = []
        seen: set[int] = set()
        stack = [(root, np.eye(4)) for root in reversed(roots)]
        while stack:
            number, parent = stack.pop()
            node = document.item("nodes", number)
            if number in seen:
                raise ModelError(f"{document.name}: nodes[{number}] is reached twice; nodes must form a tree")
            seen.add(number)
            with np.errstate(over="ignore", invalid="ignore"):
                matrix = parent @ _local_matrix(node)
            if "mesh" in node:
                found.extend((node["mesh"], matrix @ each) for each in self._copies(node))
            stack.extend((child, matrix) for child in reversed(node.get("children", [])))
        return found

    def _copies(self, node: dict[str, Any]) -> list[npt.NDArray[np.float64]]:
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
        return [_local_matrix({key: rows[i] for key, rows in columns.items()}) for i in range(count)]

    def _mesh(self, number: int) -> list[_Primitive]:
        if number not in self._primitives:
            mesh = self._document.item("meshes", number)
            self._primitives[number] = [
                self._primitive(entry, f"meshes[{number}]")
                for entry in mesh["primitives"]
                if entry.get("mode", _TRIANGLES) in (_TRIANGLES, _TRIANGLE_STRIP, _TRIANGLE_FAN)
                and "POSITION" in entry["attributes"]
            ]
        return self._primitives[number]

    def _primitive(self, entry: dict[str, Any], where: str) -> _Primitive:
        document = self._document
        document.refuse_compression(entry)
        attributes = entry["attributes"]
        positions = document.accessor(attributes["POSITION"], (3,)).astype(np.float64)
        if not np.isfinite(positions).all():
            raise ModelError(f"{document.name}: {where} has vertices that are not finite; repair the model")
        if "indices" in entry:
            indices = document.accessor(entry["indices"], (1,))[:, 0].astype(np.int64)
        else:
            indices = np.arange(len(positions))
        if len(indices) and not 0 <= indices.min() <= indices.max() < len(positions):
            worst = indices.min() if indices.min() < 0 else indices.max()
            raise ModelError(
                f"{document.name}: {where} uses vertex {worst}, but there are {len(positions)}; "
                "export the model again"
            )
        number = entry.get("material") if self._has_materials else None
        colors = None
        if "COLOR_0" in attributes:
            colors = np.ones((len(positions), 4), np.float32)
            given = self._attribute(attributes["COLOR_0"], (3, 4), len(positions), f"{where} COLOR_0")
            colors[:, : given.shape[1]] = given
        coordinates = None
        info = self._texture_info(number)
        if info is not None:
            transform = info.get("extensions", {}).get("KHR_texture_transform", {})
            name = f"TEXCOORD_{transform.get('texCoord', info.get('texCoord', 0))}"
            if name not in attributes:
                raise ModelError(
                    f"{document.name}: {where} has a textured material but no {name}; "
                    "give the mesh texture coordinates, or export it without the texture"
                )
            given = self._attribute(attributes[name], (2,), len(positions), f"{where} {name}")
            with np.errstate(over="ignore"):  # what becomes infinite is refused where it is used
                coordinates = _transformed(given, transform).astype(np.float32)
        triangles = _triangles(indices, entry.get("mode", _TRIANGLES))
        return _Primitive(positions, triangles, self._material(number), colors, coordinates)

    def _attribute(
        self, accessor: int, components: tuple[int, ...], count: int, what: str
    ) -> npt.NDArray[np.float64]:
        rows = self._document.accessor(accessor, components).astype(np.float64)
        if len(rows) != count:
            raise ModelError(f"{self._document.name}: {what} has {len(rows)} rows for {count} vertices")
        return rows

    def _texture_info(self, number: int | None) -> dict[str, Any] | None:
        """Return the reference of a material to its base colour texture."""
        entry = {} if number is None else self._document.item("materials", number)
        info: dict[str, Any] | None = _base_color(entry)[1]
        return info

    def _material(self, number: int | None) -> int:
        if number not in self._material_numbers:
            self._material_numbers[number] = len(self._materials)
            entry = {} if number is None else self._document.item("materials", number)
            factor, info = _base_color(entry)
            red, green, blue, alpha = map(float, factor)
            mode = entry.get("alphaMode", "OPAQUE")
            if mode not in _ALPHA_MODES:
                raise ModelError(
                    f"{self._document.name}: materials[{number}] has an unknown alphaMode {mode}"
                )
            self._materials.append(
                Material(
                    factor=(red, green, blue, alpha),
                    texture=None if info is None else self._texture(info["index"]),
                    alpha_mode=_ALPHA_MODES[mode],
                    cutoff=float(entry.get("alphaCutoff", 0.5)),
                )
            )
        return self._material_numbers[number]

    def _texture(self, number: int) -> Texture:
        document = self._document
        entry = document.item("textures", number)
        source = entry.get("source")
        for name, extension in entry.get("extensions", {}).items():
            if source is None and name in ("EXT_texture_webp", "EXT_texture_avif"):
                source = extension.get("source")
            elif source is None and name in CODED:
                raise document.coded(name)
        if source is None:
            raise ModelError(f"{document.name}: textures[{number}] names no image that octex reads")
        sampler = document.item("samplers", entry["sampler"]) if "sampler" in entry else {}
        wraps = []
        for axis in ("wrapS", "wrapT"):
            code = sampler.get(axis, 10497)
            if code not in _WRAPS:
                raise ModelError(f"{document.name}: a sampler has an unknown {axis} {code}; export it again")
            wraps.append(_WRAPS[code])
        nearest = sampler.get("magFilter") == _NEAREST
        return Texture(self._image(source), wraps[0], wraps[1], nearest)

    def _image(self, number: int) -> npt.NDArray[np.uint16]:
        if number not in self._images:
            document = self._document
            entry = document.item("images", number)
            name = f"{document.name}: images[{number}]"
            if "bufferView" in entry:
                data = bytes(document.view(entry["bufferView"])[0])
            elif "uri" in entry:
                uri = entry["uri"]
                if not uri.startswith("data:"):
                    name = f"{name} ({uri})"
                data = document.resource(uri, f"images[{number}]", ImageError)
            else:
                raise ImageError(f"{name} has neither a uri nor a bufferView; export the model again")
            self._images[number] = decode_image(data, name)
        return self._images[number]


def _base_color(material: dict[str, Any]) -> tuple[Any, Any]:
    """Return a base colour's factor and reference to a texture; of older materials, the diffuse colour's."""
    older = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if older is not None:
        return older.get("diffuseFactor", (1, 1, 1, 1)), older.get("diffuseTexture")
    pbr = material.get("pbrMetallicRoughness", {})
    return pbr.get("baseColorFactor", (1, 1, 1, 1)), pbr.get("baseColorTexture")


def _corners(
    primitives: list[_Primitive],
    attributes: list[npt.NDArray[np.float32] | None],
    default: npt.NDArray[np.float32],
    triangles: npt.NDArray[np.int32],
) -> Corners | None:
    """Join an attribute of all primitives; those without it get the default. None if none has it."""
    if all(attribute is None for attribute in attributes):
        return None
    rows = [
        np.broadcast_to(default, (len(primitive.positions), len(default))) if attribute is None else attribute
        for primitive, attribute in zip(primitives, attributes, strict=True)
    ]
    return Corners(np.concatenate(rows), triangles)


def _transformed(coordinates: npt.NDArray[np.float64], transform: dict[str, Any]) -> npt.NDArray[np.float64]:
    """Scale, rotate counter-clockwise as seen on the image, then move coordinates (KHR_texture_transform)."""
    if not transform:
        return coordinates
    scaled = coordinates * np.array(transform.get("scale", (1, 1)), np.float64)
    angle = float(transform.get("rotation", 0))
    cos, sin = np.cos(angle), np.sin(angle)
    turned = scaled @ np.array([[cos, -sin], [sin, cos]])
    moved: npt.NDArray[np.float64] = turned + np.array(transform.get("offset", (0, 0)), np.float64)
    return moved


def _local_matrix(node: dict[str, Any]) -> npt.NDArray[np.float64]:
    """Return a node's matrix (column-major in the file), or translation · rotation · scale (3.6.2)."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    length = x * x + y * y + z * z + w * w
    s = 2 / length if length else 0.0
    rotation = np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
            [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
            [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _triangles(indices: npt.NDArray[np.int64], mode: int) -> npt.NDArray[np.int64]:
    """Return the triangles (m, 3) of a list, a strip or a fan (3.7.2.1); what is left over is dropped."""
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    count = max(len(indices) - 2, 0)
    first = np.arange(count)
    if mode == _TRIANGLE_FAN:
        return np.stack([indices[first + 1], indices[first + 2], np.broadcast_to(indices[:1], count)], axis=1)
    odd = first % 2
    return np.stack([indices[first], indices[first + 1 + odd], indices[first + 2 - odd]], axis=1)
