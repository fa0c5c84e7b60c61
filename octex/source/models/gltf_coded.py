"""What extensions keep coded in a glTF file: primitives by Draco, buffer views by meshopt.

KHR_draco_mesh_compression is decoded by DracoPy (the extra ``draco``); EXT_meshopt_compression, and its
successor KHR_meshopt_compression, by meshopt (the extra ``meshopt``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Array
from octex.errors import MissingExtraError, ModelError

DRACO = "KHR_draco_mesh_compression"
MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
#: The last of Draco's data types that are integers.
_LAST_INTEGERS = 8
# A block of up to 256 rows takes a bit for four bytes of a row, at least.
_MOST_PER_BYTE = 1024


class DracoMesh(NamedTuple):
    """Triangles, and what their vertices have by the attributes' unique ids."""

    triangles: Array  # (m, 3) integers
    attributes: dict[int, Array]  # (n, components), of the type that was encoded


def decode_draco(data: bytes, what: str) -> DracoMesh:
    """Decode a mesh, which errors call ``what``.

    Raises ModelError for damaged data, and for points; MissingExtraError without DracoPy.
    """
    try:
        import DracoPy
    except ImportError:
        raise MissingExtraError.needed(f"{what}: to decode Draco's meshes", "DracoPy", "draco") from None
    try:
        mesh = DracoPy.decode(data)
        attributes = {int(each["unique_id"]): _as_coded(each) for each in mesh.attributes}
        triangles = getattr(mesh, "faces", None)
    except Exception as error:  # DracoPy has errors of its own
        raise ModelError(f"{what}: its Draco content is damaged ({_line(error)}); export it again") from None
    if triangles is None:
        raise ModelError(f"{what}: its Draco content has no triangles; export it again")
    return DracoMesh(triangles, attributes)


def _as_coded(attribute: dict[str, Any]) -> Array:
    """Return an attribute's rows, of integers if these were encoded: DracoPy gives positions as floats."""
    rows: Array = attribute["data"]
    are_whole = attribute["data_type"] <= _LAST_INTEGERS
    return rows.astype(np.int64) if are_whole and rows.dtype.kind == "f" else rows


def decode_meshopt(data: bytes, entry: dict[str, Any], what: str) -> bytes:
    """Decode a buffer view, which errors call ``what``, as its extension says.

    Raises ModelError for damaged data; MissingExtraError without meshopt.
    """
    try:
        import meshopt
    except ImportError:
        raise MissingExtraError.needed(f"{what}: to decode meshopt's buffers", "meshopt", "meshopt") from None
    count, stride = entry["count"], entry["byteStride"]
    if not 0 <= count * stride <= _MOST_PER_BYTE * len(data):
        raise ModelError(
            f"{what}: {len(data)} bytes of meshopt content cannot hold {count} rows of {stride} bytes; "
            "export it again"
        )
    if count == 0:
        return b""
    try:
        rows: Array = meshopt.decode_gltf_buffer(data, count, stride, entry["mode"], entry.get("filter"))
    except (ValueError, TypeError) as error:
        raise ModelError(
            f"{what}: its meshopt content is damaged ({_line(error)}); export it again"
        ) from None
    return rows.tobytes()


def _line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
