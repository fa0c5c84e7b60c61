"""Small models of every kind, written on the fly."""

from __future__ import annotations

import base64
import io
import json
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import PIL.Image

# A unit square in the plane z = 0, as two triangles, with coordinates whose v runs down the image.
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
SQUARE_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]], np.uint16)
SQUARE_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)

REPEAT, MIRROR, CLAMP = 10497, 33648, 33071
NEAREST, LINEAR = 9728, 9729

_PNG_PASSES = (
    (0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2),
)  # fmt: skip


def random_image(
    height: int, width: int, channels: int = 3, dtype: str = "uint8", seed: int = 0
) -> npt.NDArray[Any]:
    """Noise: every wrong texel shows."""
    top = np.iinfo(dtype).max
    return np.random.default_rng(seed).integers(0, top, (height, width, channels), dtype, endpoint=True)


def saved(image: npt.NDArray[Any] | PIL.Image.Image, kind: str = "PNG", **options: Any) -> bytes:
    """A file of an image, as Pillow writes it."""
    stream = io.BytesIO()
    (PIL.Image.fromarray(image) if isinstance(image, np.ndarray) else image).save(stream, kind, **options)
    return stream.getvalue()


def png(
    texels: npt.NDArray[Any],
    *,
    interlaced: bool = False,
    transparent: Sequence[int] | None = None,
    palette: npt.NDArray[np.uint8] | None = None,
    palette_alpha: Sequence[int] = (),
    filters: Sequence[int] = (0, 1, 2, 3, 4),
) -> bytes:
    """A PNG file of uint8 or uint16 texels (height, width, 1 to 4), its rows filtered in turn."""
    height, width, channels = texels.shape
    depth = texels.dtype.itemsize * 8
    step = channels * depth // 8
    color_type = 3 if palette is not None else {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    stored = texels.astype(texels.dtype.newbyteorder(">"))
    raw = b""
    row_number = 0
    for x, y, dx, dy in _PNG_PASSES if interlaced else ((0, 0, 1, 1),):
        part = stored[y::dy, x::dx]
        if part.size == 0:
            continue
        above = bytes(part.shape[1] * step)
        for row in part:
            line = row.tobytes()
            kind = filters[row_number % len(filters)]
            raw += bytes([kind]) + _filtered(line, above, step, kind)
            above = line
            row_number += 1
    header = struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, int(interlaced))
    chunks = [_chunk(b"IHDR", header)]
    if palette is not None:
        chunks.append(_chunk(b"PLTE", palette.tobytes()))
        if palette_alpha:
            chunks.append(_chunk(b"tRNS", bytes(palette_alpha)))
    elif transparent is not None:
        chunks.append(_chunk(b"tRNS", b"".join(struct.pack(">H", code) for code in transparent)))
    chunks += [_chunk(b"IDAT", zlib.compress(raw)), _chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _filtered(line: bytes, above: bytes, step: int, kind: int) -> bytes:
    out = bytearray()
    for i, byte in enumerate(line):
        left = line[i - step] if i >= step else 0
        up = above[i]
        corner = above[i - step] if i >= step else 0
        estimate = left + up - corner
        nearest = min((left, up, corner), key=lambda each: abs(estimate - each))
        guess = (0, left, up, (left + up) // 2, nearest)[kind]
        out.append((byte - guess) % 256)
    return bytes(out)


class Gltf:
    """A glTF file in the making."""

    def __init__(self) -> None:
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}
        self.binary = bytearray()

    def add(self, kind: str, **entry: Any) -> int:
        """Append to a top-level array; return its number."""
        self.json.setdefault(kind, []).append({k: v for k, v in entry.items() if v is not None})
        return len(self.json[kind]) - 1

    def view(self, data: bytes, stride: int | None = None) -> int:
        self.binary += bytes(-len(self.binary) % 4)
        offset = len(self.binary)
        self.binary += data
        return self.add("bufferViews", buffer=0, byteOffset=offset, byteLength=len(data), byteStride=stride)

    def accessor(self, rows: npt.NDArray[Any], normalized: bool | None = None) -> int:
        rows = np.ascontiguousarray(rows)
        columns = 1 if rows.ndim == 1 else rows.shape[1]
        codes = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
        entry: dict[str, Any] = {
            "bufferView": self.view(rows.tobytes()),
            "componentType": codes[rows.dtype.name],
            "count": len(rows),
            "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[columns],
            "normalized": normalized,
        }
        if columns == 3 and rows.dtype == np.float32 and np.isfinite(rows).all():
            entry |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self.add("accessors", **entry)

    def image(self, data: bytes, mime: str = "image/png") -> int:
        return self.add("images", bufferView=self.view(data), mimeType=mime)

    def texture(
        self,
        image: int,
        wrap: tuple[int, int] | None = None,
        mag: int | None = None,
        minify: int | None = None,
    ) -> int:
        sampler = None
        if wrap is not None or mag is not None:
            s, t = wrap or (None, None)
            sampler = self.add("samplers", wrapS=s, wrapT=t, magFilter=mag, minFilter=minify)
        return self.add("textures", source=image, sampler=sampler)

    def material(self, texture: int | Mapping[str, Any] | None = None, **entry: Any) -> int:
        pbr: dict[str, Any] = dict(entry.pop("pbr", {}))
        if "factor" in entry:
            pbr["baseColorFactor"] = list(entry.pop("factor"))
        if texture is not None:
            pbr["baseColorTexture"] = {"index": texture} if isinstance(texture, int) else dict(texture)
        return self.add("materials", pbrMetallicRoughness=pbr, **entry)

    def primitive(
        self,
        positions: npt.NDArray[Any] = SQUARE,
        triangles: npt.NDArray[Any] | None = SQUARE_TRIANGLES,
        *,
        uv: npt.NDArray[Any] | None = None,
        colors: npt.NDArray[Any] | None = None,
        material: int | None = None,
        mode: int | None = None,
        **attributes: int,
    ) -> dict[str, Any]:
        attributes["POSITION"] = self.accessor(positions)
        if uv is not None:
            attributes["TEXCOORD_0"] = self.accessor(uv, None if uv.dtype == np.float32 else True)
        if colors is not None:
            attributes["COLOR_0"] = self.accessor(colors, None if colors.dtype == np.float32 else True)
        entry: dict[str, Any] = {"attributes": attributes}
        if triangles is not None:
            entry["indices"] = self.accessor(triangles.reshape(-1))
        if material is not None:
            entry["material"] = material
        if mode is not None:
            entry["mode"] = mode
        return entry

    def show(self, *primitives: dict[str, Any], **transform: Any) -> int:
        """Put a mesh into the scene; return its node."""
        mesh = self.add("meshes", primitives=list(primitives))
        node = self.add("nodes", mesh=mesh, **transform)
        self.json["scenes"][0]["nodes"].append(node)
        return node

    def save(self, path: Path, *, external: bool = False) -> Path:
        """Write a .glb, or a .gltf with its buffer inside or, if ``external``, in a file beside it."""
        self.binary += bytes(-len(self.binary) % 4)
        header = dict(self.json)
        if path.suffix == ".glb":
            if self.binary:
                header["buffers"] = [{"byteLength": len(self.binary)}]
            text = json.dumps(header).encode()
            text += b" " * (-len(text) % 4)
            chunks = struct.pack("<I4s", len(text), b"JSON") + text
            if self.binary:
                chunks += struct.pack("<I4s", len(self.binary), b"BIN\0") + bytes(self.binary)
            path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
            return path
        if external:
            uri = "a buffer.bin".replace(" ", "%20")
            (path.parent / "a buffer.bin").write_bytes(self.binary)
        else:
            uri = "data:application/octet-stream;base64," + base64.b64encode(self.binary).decode()
        if self.binary:
            header["buffers"] = [{"byteLength": len(self.binary), "uri": uri}]
        path.write_text(json.dumps(header))
        return path


#: Takes away what is at a place.
MISSING = object()


def rows(*numbers: Any, dtype: str = "float32") -> Callable[[Gltf], int]:
    """Return what adds an accessor of these numbers."""
    return lambda gltf: gltf.accessor(np.array(numbers, dtype))


def put(document: Any, changes: Mapping[str, Any], gltf: Gltf | None = None) -> None:
    """Put values at dotted places of a document; functions get what makes the file, and return the value."""
    for place, value in changes.items():
        *holders, key = place.split(".")
        holder = document
        for each in holders:
            holder = holder[int(each)] if isinstance(holder, list) else holder.setdefault(each, {})
        at = int(key) if isinstance(holder, list) else key
        if value is MISSING:
            del holder[at]
        else:
            holder[at] = value(gltf) if callable(value) else value


def textured_square(
    path: Path,
    image: bytes | str,
    *,
    scale: float = 1.0,
    shift: float = 0.0,
    external: bool = False,
    **options: Any,
) -> Path:
    """A glTF square with an image, or its URI; ``options`` are those of Gltf.texture and of Gltf.material."""
    gltf = Gltf()
    sampler = {key: options.pop(key) for key in ("wrap", "mag", "minify") if key in options}
    number = gltf.add("images", uri=image) if isinstance(image, str) else gltf.image(image)
    material = gltf.material(gltf.texture(number, **sampler), **options)
    gltf.show(gltf.primitive(uv=(SQUARE_UV * scale + shift).astype(np.float32), material=material))
    return gltf.save(path, external=external)


def obj(path: Path, lines: str, mtl: str | None = None, images: Mapping[str, bytes] | None = None) -> Path:
    """An OBJ file, the MTL file beside it that its first line then names, and images."""
    if mtl is not None:
        path.with_suffix(".mtl").write_text(mtl)
        lines = f"mtllib {path.with_suffix('.mtl').name}\n{lines}"
    path.write_text(lines)
    for name, data in (images or {}).items():
        (path.parent / name).parent.mkdir(parents=True, exist_ok=True)
        (path.parent / name).write_bytes(data)
    return path


def obj_lines(vertices: npt.ArrayLike, faces: Iterable[Iterable[int]]) -> str:
    """The lines of an OBJ file's vertices, which may have colours behind their positions, and faces."""
    rows = [f"v {' '.join(map(str, row))}" for row in np.asarray(vertices).tolist()]
    rows += [f"f {' '.join(str(each + 1) for each in face)}" for face in faces]
    return "\n".join(rows) + "\n"


OBJ_SQUARE = """v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
"""


def ply(
    path: Path,
    elements: Mapping[str, Mapping[str, tuple[str, Sequence[Any]]]],
    *,
    encoding: str = "ascii",
    comments: Sequence[str] = (),
) -> Path:
    """A PLY file of elements → properties → (type, a value or a list for each row).

    A list's type is written "list COUNT_TYPE TYPE".
    """
    letters = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f",
               "double": "d"}  # fmt: skip
    order = ">" if encoding == "binary_big_endian" else "<"
    header = ["ply", f"format {encoding} 1.0", *(f"comment {comment}" for comment in comments)]
    body = b""
    for element, properties in elements.items():
        count = len(next(iter(properties.values()))[1])
        header.append(f"element {element} {count}")
        header += [f"property {kind} {name}" for name, (kind, _) in properties.items()]
        for row in range(count):
            words: list[str] = []
            for kind, values in properties.values():
                types = kind.split()
                entries = list(values[row]) if types[0] == "list" else [values[row]]
                if types[0] == "list":
                    words.append(str(len(entries)))
                    if encoding != "ascii":
                        body += struct.pack(order + letters[types[1]], len(entries))
                words += [str(entry) for entry in entries]
                if encoding != "ascii":
                    body += struct.pack(f"{order}{len(entries)}{letters[types[-1]]}", *entries)
            if encoding == "ascii":
                body += (" ".join(words) + "\n").encode()
    header.append("end_header\n")
    path.write_bytes("\n".join(header).encode() + body)
    return path


def ply_square(**properties: tuple[str, Sequence[Any]]) -> dict[str, dict[str, tuple[str, Sequence[Any]]]]:
    """The square's elements; extra properties go to the vertices if there are four values, else to faces."""
    vertex: dict[str, tuple[str, Sequence[Any]]] = {
        axis: ("float", SQUARE[:, i].tolist()) for i, axis in enumerate("xyz")
    }
    face: dict[str, tuple[str, Sequence[Any]]] = {
        "vertex_indices": ("list uchar int", SQUARE_TRIANGLES.tolist())
    }
    for name, (kind, values) in properties.items():
        (vertex if len(values) == 4 else face)[name] = (kind, values)
    return {"vertex": vertex, "face": face}


def stl(path: Path, positions: npt.NDArray[Any], triangles: npt.NDArray[Any], *, ascii: bool = False) -> Path:
    """An STL file."""
    if ascii:
        facets = [
            "facet normal 0 0 0\nouter loop\n"
            + "".join(f"vertex {x} {y} {z}\n" for x, y, z in positions[corners].tolist())
            + "endloop\nendfacet\n"
            for corners in triangles
        ]
        path.write_text("solid a\n" + "".join(facets) + "endsolid a\n")
        return path
    data = bytes(80) + struct.pack("<I", len(triangles))
    for corners in triangles:
        data += struct.pack("<12fH", 0, 0, 0, *positions[corners].reshape(-1).tolist(), 0)
    path.write_bytes(data)
    return path
