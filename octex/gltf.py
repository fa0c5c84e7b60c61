"""A glTF 2.0 or GLB file: its JSON, the accessors and resources that it refers to, and its scene.

Accessors are read here and not by trimesh, which takes sparse ones for zeros and leaves normalized integers
unscaled. KHR_draco_mesh_compression is decoded by DracoPy (the extra ``draco``), EXT_meshopt_compression and
its successor KHR_meshopt_compression by meshopt (the extra ``meshopt``).
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import os
import reprlib
import struct
import urllib.parse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Float64s
from octex.errors import ImageError, MissingExtraError, ModelError, damaged
from octex.files import read_bytes, referred

Json = dict[str, Any]

DRACO = "KHR_draco_mesh_compression"
MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
#: The last of Draco's data types that are integers.
_LAST_INTEGERS = 8
# A block of up to 256 rows takes a bit for four bytes of a row, at least.
_MOST_PER_BYTE = 1024

_LIMIT = float(np.finfo(np.float64).max)
#: The numbers that fields of nodes have.
_COUNTS = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}
COMPONENT_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# An accessor may stand for zeros that the file does not hold; more than this is taken for damage.
_MOST_ZEROS = 2**24


class Document:
    """A parsed file: its JSON, and its buffers; ``content`` are the file's bytes, if read already."""

    def __init__(self, path: Path, content: bytes | None = None) -> None:
        self.path = path
        self.name = path.name
        self.files: dict[str, str] = {}  # SHA-256 of the other files read, by their names in this one
        self._buffers: dict[int, bytes] = {}
        self._decoded: dict[int, bytes] = {}
        data = read_bytes(path) if content is None else content
        self._binary: bytes | None = None
        if data[:4] == b"glTF":
            data = self._unpack(data)
        try:
            self.json = json.loads(data.decode("utf-8-sig"), parse_constant=_refuse_constant)
        except UnicodeDecodeError:
            raise ModelError(
                f"{self.name} is not a glTF file: it is neither GLB nor JSON; give it the ending of its "
                "format"
            ) from None
        except (ValueError, RecursionError) as error:
            raise damaged(f"{self.name} is not a glTF file, or is damaged ({error})") from None
        if not isinstance(self.json, dict) or not isinstance(self.json.get("asset"), dict):
            raise damaged(f"{self.name} is not a glTF file: it has no asset")
        version = str(self.json["asset"].get("version"))
        needed = str(self.json["asset"].get("minVersion", "2.0"))
        if not version.startswith("2.") or needed > "2.0":
            is_kind = f"is glTF {version}" if needed <= "2.0" else f"needs glTF {needed}"
            raise ModelError(f"{self.name} {is_kind}; octex reads glTF 2.0: convert it first")

    @property
    def _required(self) -> list[Any]:
        return self.items("extensionsRequired")

    def _unpack(self, data: bytes) -> bytes:
        """Return the JSON chunk of a GLB and store its binary chunk."""
        if len(data) < 20:
            raise ModelError(f"{self.name} is truncated: a GLB header has 20 bytes, the file {len(data)}")
        version, length, json_length = struct.unpack_from("<III", data, 4)
        if version != 2:
            raise ModelError(f"{self.name} is GLB version {version}; octex reads version 2: convert it first")
        if data[16:20] != b"JSON":
            raise ModelError(f"{self.name} is damaged: its first chunk is not JSON")
        if length > len(data) or 20 + json_length > len(data):
            raise ModelError(f"{self.name} is truncated: it should have {length} bytes and has {len(data)}")
        end = 20 + json_length
        while end + 8 <= length and self._binary is None:
            size, kind = struct.unpack_from("<I4s", data, end)
            first, end = end + 8, end + 8 + size
            if kind == b"BIN\0":
                if end > len(data):
                    raise ModelError(f"{self.name} is truncated: its binary chunk ends early")
                self._binary = data[first:end]
        return data[20 : 20 + json_length]

    def items(self, kind: str) -> list[Any]:
        """Return a top-level array, empty if missing."""
        items = self.json.get(kind, [])
        if not isinstance(items, list):
            raise damaged(f"{self.name}: {kind} must be a list, not {reprlib.repr(items)}")
        return items

    def item(self, kind: str, index: Any) -> Json:
        """Return one object of a top-level array."""
        items = self.items(kind)
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(items):
            which = f"{kind}[{reprlib.repr(index)}]"
            raise damaged(f"{self.name} refers to {which}, which it does not have")
        return as_object(items[index], f"{self.name}: {kind}[{index}]")

    def resource(self, uri: str, what: str, error_class: type[ModelError | ImageError] = ModelError) -> bytes:
        """Return the bytes of a data: URI, or of a file in the same folder."""
        if uri.startswith("data:"):
            head, comma, payload = uri.partition(",")
            if not comma:
                raise error_class(f"{self.name}: {what} has a data: URI without data")
            try:
                raw = urllib.parse.unquote_to_bytes(payload)
                if not head.endswith(";base64"):
                    return raw
                raw = b"".join(raw.split())
                return base64.b64decode(raw + b"=" * (-len(raw) % 4), validate=True)
            except binascii.Error as error:
                raise error_class(f"{self.name}: {what} is not valid base64 ({error})") from None
        if "://" in uri:
            raise error_class(f"{self.name}: {what} is at {uri}; octex reads files only: download it first")
        folder = self.path.parent
        try:
            decoded = referred(folder, os.fsdecode(urllib.parse.unquote_to_bytes(uri)))
            exact = referred(folder, uri)  # some exporters leave a percent sign as it is
            data = read_bytes(decoded if decoded.is_file() else exact)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            others = ", or read only other channels (--channels)" if error_class is ImageError else ""
            remedy = f"; put it next to the model{others}" if isinstance(error, FileNotFoundError) else ""
            raise error_class(f"{self.name}: {what} cannot be read: {uri}: {reason}{remedy}") from None
        self.files[uri] = hashlib.sha256(data).hexdigest()
        return data

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            entry = self.item("buffers", index)
            what = f"buffers[{index}]"
            if "uri" in entry:
                data = self.resource(entry["uri"], what)
            elif index == 0 and self._binary is not None:
                data = self._binary
            else:
                raise ModelError(f"{self.name}: {what} has no data; export the model again")
            if len(data) < entry["byteLength"]:
                raise ModelError(
                    f"{self.name}: {what} is truncated: {len(data)} of {entry['byteLength']} bytes"
                )
            self._buffers[index] = data
        return self._buffers[index]

    def view(self, index: int) -> tuple[memoryview, int | None]:
        """Return the decoded bytes of a buffer view, and its stride."""
        entry = self.item("bufferViews", index)
        what = f"{self.name}: bufferViews[{index}]"
        extensions = as_object(entry.get("extensions", {}), f"{what}.extensions")
        name = next((name for name in MESHOPT if name in extensions), None)
        if name is not None and name not in self._required:
            has_binary = entry["buffer"] == 0 and self._binary is not None
            if "uri" in self.item("buffers", entry["buffer"]) or has_binary:
                name = None  # plain bytes are there too
        if name is None:
            return self._range(entry, what), entry.get("byteStride")
        if index not in self._decoded:
            coded = as_object(extensions[name], f"{what}.extensions.{name}")
            self._decoded[index] = _decode_meshopt(bytes(self._range(coded, what)), coded, what)
        return memoryview(self._decoded[index]), entry.get("byteStride")

    def _range(self, entry: Json, what: str) -> memoryview:
        start, length = entry.get("byteOffset", 0), entry["byteLength"]
        data = self._buffer(entry["buffer"])
        if start < 0 or length < 0 or start + length > len(data):
            raise damaged(f"{what} reaches outside its buffer")
        return memoryview(data)[start : start + length]

    def draco(self, primitive: Json, what: str) -> tuple[Array, dict[str, Array]] | None:
        """Return the triangles (m, 3) and attributes of a primitive in Draco's coding, or None."""
        extensions = as_object(primitive.get("extensions", {}), f"{what}.extensions")
        if DRACO not in extensions:
            return None
        position = self.item("accessors", primitive["attributes"]["POSITION"])
        if DRACO not in self._required and ("bufferView" in position or "sparse" in position):
            return None
        coded = as_object(extensions[DRACO], f"{what}.extensions.{DRACO}")
        names = as_object(coded["attributes"], f"{what}.extensions.{DRACO}.attributes")
        data = bytes(self.view(coded["bufferView"])[0])
        try:
            import DracoPy
        except ImportError:
            raise MissingExtraError.needed(f"{what}: to decode Draco's meshes", "DracoPy", "draco") from None
        try:
            mesh = DracoPy.decode(data)
            attributes = {}
            for each in mesh.attributes:  # DracoPy gives positions as floats, also if integers were encoded
                rows: Array = each["data"]
                is_whole = each["data_type"] <= _LAST_INTEGERS and rows.dtype.kind == "f"
                attributes[int(each["unique_id"])] = rows.astype(np.int64) if is_whole else rows
            triangles = getattr(mesh, "faces", None)
        except Exception as error:  # DracoPy has errors of its own
            raise damaged(f"{what}: its Draco content is damaged ({_line(error)})") from None
        if triangles is None:
            raise damaged(f"{what}: its Draco content has no triangles")
        for name, number in names.items():
            if number not in attributes:
                raise ModelError(f"{what}: its Draco content has no attribute {number}, for {name}")
        return triangles, {name: attributes[number] for name, number in names.items()}

    def accessor(self, index: int, components: tuple[int, ...], decoded: Array | None = None) -> Array:
        """Return an accessor (count, components); normalized integers as float64 in −1 … 1.

        ``components`` are the allowed numbers. ``decoded`` are the accessor's rows, if an extension coded
        them.
        """
        entry = self.item("accessors", index)
        what = f"{self.name}: accessors[{index}]"
        dtype = np.dtype(COMPONENT_TYPES[entry["componentType"]])
        width = _COMPONENTS.get(entry["type"], 0)
        if width not in components:
            raise damaged(f"{what} has type {entry['type']}, which does not fit its use")
        count = entry["count"]
        if decoded is not None:
            if decoded.shape[1:] != (width,) or (decoded.dtype.kind == "f") != (dtype.kind == "f"):
                shape = f"{decoded.dtype} {decoded.shape}"
                raise damaged(f"{what} does not fit what was decoded for it, {shape}")
            rows = decoded.astype(dtype)
        elif "bufferView" in entry:
            rows = self._rows(entry, count, width, dtype, what)
        elif 0 <= count * width <= _MOST_ZEROS:
            rows = np.zeros((count, width), dtype)
        else:
            raise ModelError(f"{what} has {count} elements without data; export the model again")
        if "sparse" in entry and decoded is None:
            sparse, indices = entry["sparse"], entry["sparse"]["indices"]
            kind = np.dtype(COMPONENT_TYPES[indices["componentType"]])
            positions = self._rows(indices, sparse["count"], 1, kind, what)[:, 0]
            if len(positions) and int(positions.max()) >= count:
                raise ModelError(f"{what} has sparse indices outside its {count} elements")
            rows = rows.copy()
            rows[positions] = self._rows(sparse["values"], sparse["count"], width, dtype, what)
        if entry.get("normalized") and dtype.kind in "iu":
            rows = np.maximum(rows / np.iinfo(dtype).max, -1.0)
        return rows

    def _rows(self, entry: Json, count: int, width: int, dtype: np.dtype[Any], what: str) -> Array:
        """Return ``count`` rows of the buffer view of a record."""
        data, stride = self.view(entry["bufferView"])
        offset, row = entry.get("byteOffset", 0), width * dtype.itemsize
        stride = stride or row
        end = offset + stride * (count - 1) + row if count else 0
        if offset < 0 or count < 0 or stride < row or end > len(data):
            raise ModelError(f"{what} reaches outside its buffer view; export the model again")
        if count == 0:
            return np.empty((0, width), dtype)
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))


def as_object(value: Any, what: str) -> Json:
    """Return a JSON object, or raise ModelError."""
    if not isinstance(value, dict):
        raise damaged(f"{what} must be an object, not {reprlib.repr(value)}")
    return value


def as_numbers(values: Any, count: int, what: str, limit: float) -> tuple[float, ...]:
    """Return ``count`` numbers below a limit, or raise ModelError."""
    numbers = values if isinstance(values, (list, tuple)) else ()
    if len(numbers) != count or not all(is_number(number, limit) for number in numbers):
        raise damaged(f"{what} must be {count} numbers, not {reprlib.repr(values)}")
    return tuple(map(float, numbers))


def is_number(value: Any, limit: float) -> bool:
    """Return whether a JSON value is a number below a limit."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < limit


def _refuse_constant(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")


def _decode_meshopt(data: bytes, entry: Json, what: str) -> bytes:
    """Decode a buffer view of meshopt; errors call it ``what``."""
    try:
        import meshopt
    except ImportError:
        raise MissingExtraError.needed(f"{what}: to decode meshopt's buffers", "meshopt", "meshopt") from None
    count, stride = entry["count"], entry["byteStride"]
    if not 0 <= count * stride <= _MOST_PER_BYTE * len(data):
        raise damaged(
            f"{what}: {len(data)} bytes of meshopt content cannot hold {count} rows of {stride} bytes"
        )
    if count == 0:
        return b""
    try:
        rows: Array = meshopt.decode_gltf_buffer(data, count, stride, entry["mode"], entry.get("filter"))
    except (ValueError, TypeError) as error:
        raise damaged(f"{what}: its meshopt content is damaged ({_line(error)})") from None
    return rows.tobytes()


def _line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def scene_nodes(
    document: Document, posed: Mapping[int, Json] | None = None
) -> Iterator[tuple[int, Json, Float64s]]:
    """Yield the scene's nodes, depth first: number, node, and its matrix (4, 4) to the world.

    ``posed`` replaces fields of nodes, by number.
    """
    if document.items("scenes"):
        roots = _links(document, "scenes", document.json.get("scene", 0), "nodes")
    else:
        numbers = range(len(document.items("nodes")))
        children = {child for each in numbers for child in _links(document, "nodes", each, "children")}
        roots = [each for each in numbers if each not in children]
    seen: set[int] = set()
    stack = [(root, np.eye(4)) for root in reversed(roots)]
    while stack:
        number, parent = stack.pop()
        if number in seen:
            raise ModelError(f"{document.name}: nodes[{number}] is reached twice; nodes must form a tree")
        seen.add(number)
        node = document.item("nodes", number)
        if posed:
            node = {**node, **posed.get(number, {})}
        for field, count in _COUNTS.items():
            if field in node:
                as_numbers(node[field], count, f"{document.name}: nodes[{number}]: {field}", _LIMIT)
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = parent @ local_matrix(node)
        stack.extend((child, matrix) for child in reversed(_links(document, "nodes", number, "children")))
        yield number, node, matrix


def _links(document: Document, kind: str, number: Any, field: str) -> list[int]:
    """Return the existing nodes that a scene or a node lists."""
    numbers = document.item(kind, number).get(field, [])
    if not isinstance(numbers, list):
        raise damaged(f"{document.name}: {kind}[{number}]: {field} must be a list of indices")
    for each in numbers:
        document.item("nodes", each)
    return numbers


def local_matrix(fields: Mapping[str, npt.ArrayLike]) -> Float64s:
    """Return a node's matrix (column-major in the file), or translation · rotation · scale (3.6.2)."""
    if "matrix" in fields:
        return np.array(fields["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(fields.get("rotation", (0, 0, 0, 1)), np.float64)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(w, x, y, z) * np.array(fields.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = fields.get("translation", (0, 0, 0))
    return matrix


def rotation_matrix(w: float, x: float, y: float, z: float) -> Float64s:
    """Return the matrix (3, 3) of a quaternion of any length; the identity for length 0."""
    length = w * w + x * x + y * y + z * z
    s = 2 / length if length else 0.0
    return np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
            [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
            [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
        ]
    )
