"""3MF packages: meshes as the build places them, with their colours.

Core Specification 1.3, Materials and Properties 1.2, Production 1.1. Positions are in the file's unit. A
composite has the colour of its material with the largest share, a multi-property that of its last layer.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s
from octex.channels import ONE
from octex.errors import ModelError, damaged
from octex.files import read_bytes
from octex.source.colors import screen_colors
from octex.source.corners import Corners
from octex.source.images.decode import decode_image
from octex.source.images.pyramid import CLAMP, MIRROR, REPEAT
from octex.source.materials import Texture
from octex.source.mesh import check_below
from octex.source.models.reading import Options, PlacedMesh, colored_surface, warn, winding
from octex.source.surface import Surface, flip_v

_WRAPS = {"wrap": REPEAT, "mirror": MIRROR}
_BLENDS = ("multiproperties", "compositematerials")
_MODEL = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
_NESTED = 64
#: Attributes of triangles by which slicers store painted filaments.
_PAINT = (b"slic3rpe:mmu_segmentation=", b"paint_color=")
#: Largest size of a part over that of the package; text of meshes packs to a twentieth.
_UNPACKED = 200
#: Most bytes of placed meshes, in all and per byte of the package: components that share components multiply.
#: Bytes of a placement by itself.
_PLACED, _TIMES, _PLACEMENT = 2**28, 1000, 4096


def load_3mf(path: Path, options: Options) -> Surface:
    """Read the meshes that the build of a 3MF package places. Raises ModelError or ImageError."""
    data = read_bytes(path)
    try:
        package = zipfile.ZipFile(io.BytesIO(data))
    except zipfile.BadZipFile:
        raise damaged(f"{path.name} is damaged, or is not a 3MF package") from None
    with package:
        return _Package(package, path.name, options, len(data)).surface()


class _RowGroup(NamedTuple):
    """Consecutive rows of the tables, and the number of their image, 0 for none."""

    first: int
    size: int
    image: int
    is_blended: bool = False


class _ObjectMesh(NamedTuple):
    positions: Float64s
    triangles: Int64s  # (m, 3)
    rows: Int64s  # (m, 3)   each corner's row of the tables
    images: Int32s  # (m,)   each triangle's image, 0 for none


class _Package:
    """Collects the meshes of a package; corners have rows of two tables: colours and coordinates."""

    def __init__(self, package: zipfile.ZipFile, name: str, options: Options, size: int) -> None:
        self._package, self._name, self._options = package, name, options
        self._largest_part, self._bytes_left = _UNPACKED * size, _PLACED + _TIMES * size
        self._groups: dict[tuple[str, str], _RowGroup] = {}
        self._objects: dict[tuple[str, str], Element] = {}
        self._images: list[Texture | None] = [None]
        self._colors: list[Float32s] = [np.ones((1, 4), np.float32)]  # row 0: without colour
        self._coordinates: list[Float64s] = [np.zeros((1, 2))]
        self._parts: dict[str, Element] = {}
        self._meshes: dict[tuple[str, str], list[_ObjectMesh]] = {}  # of objects, not placed
        self._left_out: set[str] = set()

    def surface(self) -> Surface:
        """Return all placed meshes as one surface."""
        root = "3D/3dmodel.model"
        if "_rels/.rels" in self._package.namelist():
            models = (link for link in self._parsed("_rels/.rels") if link.get("Type") == _MODEL)
            root = next((link.get("Target", "").lstrip("/") for link in models), root)
        meshes = [
            mesh
            for item in _elements(self._part(root), "build", "item")
            for mesh in self._placed(_path(item, root), item, 0)
        ]
        if not any(len(mesh.triangles) for mesh in meshes):
            raise ModelError(f"{self._name} has no triangles; octex needs a surface, not slices or beams")
        if self._left_out:
            left_out = " and ".join(sorted(self._left_out))
            warn(f"{self._name}: octex reads triangles, and leaves out {left_out}; export them as a mesh")
        firsts = np.cumsum([0, *(len(mesh.positions) for mesh in meshes)])
        triangles = np.concatenate([m.triangles + first for m, first in zip(meshes, firsts, strict=False)])
        rows = np.concatenate([mesh.rows for mesh in meshes]).astype(np.int32)
        images = np.concatenate([mesh.images for mesh in meshes])
        part = PlacedMesh(
            np.concatenate([mesh.positions for mesh in meshes]),
            triangles.astype(np.int32),
            images,
            colors=Corners(np.concatenate(self._colors), rows) if rows.any() else None,
            uv=Corners(flip_v(np.concatenate(self._coordinates)), rows) if images.any() else None,
        )
        return colored_surface(self._name, self._options, part, self._images)

    def _read(self, part: str) -> bytes:
        try:
            entry = self._package.getinfo(part.lstrip("/"))
        except KeyError:
            raise damaged(f"{self._name} has no part {part}") from None
        if entry.file_size > self._largest_part:
            raise damaged(
                f"{self._name}: {part} unpacks to {entry.file_size:,} bytes, more than {_UNPACKED} times "
                "the file, as no model does"
            )
        return self._package.read(entry)

    def _parsed(self, part: str) -> Element:
        data = self._read(part)
        if b"<!DOCTYPE" in data:  # the specification forbids them, and entities may blow up
            raise damaged(f"{self._name}: {part} has a document type, which 3MF forbids")
        if any(b" " + word in data for word in _PAINT):
            warn(f"{self._name}: colours painted in a slicer are not read; export vertex colours")
        try:
            return ElementTree.fromstring(data)
        except ElementTree.ParseError as error:
            raise damaged(f"{self._name}: {part} is damaged ({error})") from None

    def _part(self, part: str) -> Element:
        """Return a model part, and list its objects and groups."""
        if part not in self._parts:
            self._parts[part] = root = self._parsed(part)
            textures = {
                texture.get("id", ""): texture for texture in _elements(root, "resources", "texture2d")
            }
            for resources in _elements(root, "resources"):
                for resource in resources:
                    key = part, resource.get("id", "")
                    if _tag(resource) == "object":
                        self._objects[key] = resource
                    elif self._options.materials:
                        self._group(key, resource, textures)
        return self._parts[part]

    def _group(self, key: tuple[str, str], group: Element, textures: dict[str, Element]) -> None:
        """Add the rows of a group to the tables."""
        kind, rows = _tag(group), list(group)
        count, image = len(rows), 0
        colors, coordinates = np.ones((count, 4), np.float32), np.zeros((count, 2))
        if kind in ("colorgroup", "basematerials"):
            word = "color" if kind == "colorgroup" else "displaycolor"
            codes = [_color(row.get(word, "#FFFFFFFF")) for row in rows]
            colors = screen_colors(np.array(codes, np.float64).reshape(-1, 4) / 255.0)
        elif kind == "texture2dgroup" and self._options.wants("base_color"):
            number = group.get("texid", "")
            if number not in textures:
                raise damaged(f"{self._name}: texture {number!r} is missing")
            texture = textures[number]
            path = texture.get("path", "")
            texels = decode_image(self._read(path), f"{self._name}: {path}")
            texels[..., 3] = ONE[texels.dtype.name]
            u, v = (_WRAPS.get(texture.get(f"tilestyle{axis}", "wrap"), CLAMP) for axis in "uv")
            image = len(self._images)
            self._images.append(Texture(texels, u, v))
            texts = [[row.get("u"), row.get("v")] for row in rows]
            coordinates = np.array(texts, np.float64).reshape(-1, 2)
        elif kind in _BLENDS:
            try:
                layer, properties = _dominant(group)
            except (IndexError, ValueError):
                raise damaged(f"{self._name}: {kind} {key[1]!r} lacks what it blends") from None
            blended = self._groups.get((key[0], layer))
            if blended is None:
                return
            check_below(properties, blended.size, f"{self._name}: {kind} {key[1]!r} blends property")
            blended_rows = blended.first + properties
            image, colors = blended.image, np.concatenate(self._colors)[blended_rows]
            coordinates = np.concatenate(self._coordinates)[blended_rows]
        elif kind != "texture2dgroup":
            return
        self._groups[key] = _RowGroup(sum(map(len, self._colors)), count, image, kind in _BLENDS)
        self._colors.append(colors)
        self._coordinates.append(coordinates)

    def _placed(self, part: str, item: Element, depth: int) -> list[_ObjectMesh]:
        """Return the meshes of an item of the build, or of a component, transformed by it."""
        self._part(part)
        number = item.get("objectid", "")
        if depth > _NESTED or (part, number) not in self._objects:
            raise damaged(f"{self._name}: object {number!r} is missing, or contains itself")
        entry = self._objects[part, number]
        meshes = [
            mesh
            for component in _elements(entry, "components", "component")
            for mesh in self._placed(_path(component, part), component, depth + 1)
        ]
        if (part, number) not in self._meshes:
            self._meshes[part, number] = [self._mesh(part, entry, mesh) for mesh in _elements(entry, "mesh")]
            if any(name.endswith("}slicestackid") for name in entry.attrib):
                self._left_out.add("slices")
            if _elements(entry, "mesh", "beamlattice"):
                self._left_out.add("beams")
        meshes += self._meshes[part, number]
        self._bytes_left -= _PLACEMENT + sum(array.nbytes for mesh in meshes for array in mesh)
        if self._bytes_left < 0:
            raise ModelError(
                f"{self._name} places the same parts too many times; export it with fewer copies"
            )
        transform = item.get("transform")
        if transform is None:
            return meshes
        matrix = np.array(transform.split(), np.float64).reshape(4, 3)
        linear, offset, order = matrix[:3], matrix[3], winding(matrix[:3])
        return [
            _ObjectMesh(positions @ linear + offset, triangles[:, order], rows[:, order], images)
            for positions, triangles, rows, images in meshes
        ]

    def _mesh(self, part: str, entry: Element, mesh: Element) -> _ObjectMesh:
        corners = [(v.get("x"), v.get("y"), v.get("z")) for v in _elements(mesh, "vertices", "vertex")]
        faces = _elements(mesh, "triangles", "triangle")
        used = [(face.get("v1"), face.get("v2"), face.get("v3")) for face in faces]
        triangles = np.array(used, np.int64).reshape(-1, 3)
        rows, images = np.zeros((len(faces), 3), np.int64), np.zeros(len(faces), np.int32)
        default, index = entry.get("pid", ""), entry.get("pindex", "0")
        groups = np.array([face.get("pid", default) for face in faces])
        texts = [
            (first := face.get("p1", index), face.get("p2", first), face.get("p3", first)) for face in faces
        ]
        properties = np.array(texts, np.int64).reshape(-1, 3)
        for number in np.unique(groups):
            group = self._groups.get((part, str(number)))
            if group is not None:
                if group.is_blended:
                    warn(f"{self._name}: of materials that are blended one is read; bake them to a texture")
                is_member = groups == number
                check_below(properties[is_member], group.size, f"{self._name}: a triangle uses property")
                rows[is_member] = group.first + properties[is_member]
                images[is_member] = group.image
        check_below(triangles, len(corners), f"{self._name}: a triangle uses vertex")
        return _ObjectMesh(np.array(corners, np.float64).reshape(-1, 3), triangles, rows, images)


def _dominant(group: Element) -> tuple[str, Int64s]:
    """Return the last layer of multi-properties, or the materials of composites, and its properties (n,)."""
    if _tag(group) == "multiproperties":
        layers = group.get("pids", "").split()
        last = len(layers) - 1
        properties = [int((row.get("pindices", "").split() + ["0"] * len(layers))[last]) for row in group]
        return layers[last], np.array(properties, np.int64)
    materials = [int(word) for word in group.get("matindices", "").split()]
    shares = [[float(word) for word in row.get("values", "").split()] for row in group]
    return group.get("matid", ""), np.array([materials[int(np.argmax(row))] for row in shares], np.int64)


def _tag(element: Element) -> str:
    """Return an element's name without its namespace, in which files differ."""
    return element.tag.rpartition("}")[2]


def _elements(element: Element, *names: str) -> list[Element]:
    """Return the elements at a path of names."""
    elements = [element]
    for name in names:
        elements = [each for one in elements for each in one if _tag(each) == name]
    return elements


def _path(element: Element, part: str) -> str:
    """Return the part that an item or a component names, by default its own (Production Extension)."""
    paths = [value for key, value in element.items() if key.rpartition("}")[2] == "path"]
    return paths[0].lstrip("/") if paths else part


def _color(code: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(code.lstrip("#").ljust(8, "F"))[:4])
