"""What a .ptx file holds (Ptex 1, ptex.us/PtexFile.html): little-endian, packed; "z" is a zlib stream.

    Header          64 bytes
    ExtHeader       as many bytes as the header says, 40 today
    faces           z of FaceInfo, 20 bytes a face
    constants       z of one pixel a face: its average
    levels' sizes   16 bytes a level
    levels          each z of a block's bytes and encoding, 4 bytes a face; then the blocks, back to back
    metadata        z of entries; then 8 bytes of zero
    large metadata  z of entries without their values, then a z for each value
    edits           faces and metadata that replace what stands above

A pixel has one number a channel. A block has a face's texels, channel after channel, each in rows from v = 0
up. It is one pixel alone (CONSTANT), z of them (ZIPPED), z of their differences (DIFFERENCED), or a grid of
tiles, each a block by itself (TILED). A difference is from the texel before, the first from 0, modulo 2^bits.

Level 0 has all faces in order; those that are constant have no block. Level i has faces of half the texels
along u and along v, i times over, multiplied by alpha: those whose lesser side has more than 2^(i + 1)
texels, sorted by that side, the longest first, equal ones in order.

Faces are quads or triangles. On quads u goes from corner 0 to 1 and v from corner 0 to 3, on triangles u from
corner 0 to 1 and v from 0 to 2. Edge i goes from corner i to the next. A polygon that is no quad, among
quads, is a subface for each of its corners: with the corner at (0, 0), the middle of the edge that follows it
at (1, 0), that of the polygon at (1, 1). A quad beside such an edge has as neighbour the subface that comes
first along its edge.

A triangle of 2^n by 2^n texels is cut into cells of that grid, each with one texel that stands upright. Those
off the slanted edge have a second one, on its tip. The upright texel of cell (column i, row j) is stored
there; the other at column 2^n − 1 − j of row 2^n − 1 − i.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Int8s, Int32s, Int64s, Uint8s, Uint32s

MAGIC = b"Ptex"
VERSION, MINOR_VERSION = 1, 4

TRIANGLE, QUAD = 0, 1
MESH_TYPES = ("triangle", "quad")
DTYPES = ("uint8", "uint16", "float16", "float32")
BORDER_MODES = ("clamp", "black", "periodic")
EDGE_FILTERS = ("none", "tangent")

IS_CONSTANT, HAS_EDITS, IS_SUBFACE = 1, 2, 8
CONSTANT, ZIPPED, DIFFERENCED, TILED = range(4)
BLOCK_BITS = 30  # of a block's size; the two bits above hold its encoding
EDIT_FACE, EDIT_METADATA = 0, 1

#: Types of metadata: text, int8, int16, int32, float32 and float64.
METADATA_TYPES = 6
TEXT = 0
#: Least bytes of a tile.
TILE_BYTES = 65536
BARRIER = 8
#: log2 of the longest side of a face.
LONGEST_LOG2 = 20

HEADER = np.dtype(
    [
        ("magic", "S4"), ("version", "<u4"), ("mesh_type", "<u4"), ("data_type", "<u4"),
        ("alpha_channel", "<i4"), ("channels", "<u2"), ("levels", "<u2"), ("faces", "<u4"),
        ("extended_header", "<u4"), ("face_info", "<u4"), ("constants", "<u4"), ("level_info", "<u4"),
        ("minor_version", "<u4"), ("level_data", "<u8"), ("metadata_zipped", "<u4"), ("metadata", "<u4"),
    ]
)  # fmt: skip
EXTENDED_HEADER = np.dtype(
    [
        ("u_border", "<u2"), ("padding", "<u2"), ("v_border", "<u2"), ("edge_filter", "<u2"),
        ("large_zipped", "<u4"), ("large", "<u4"), ("large_data", "<u8"),
        ("edits", "<u8"), ("edits_at", "<u8"),
    ]
)  # fmt: skip
FACE_INFO = np.dtype(
    [
        ("u_log2", "i1"), ("v_log2", "i1"), ("edges", "u1"), ("flags", "u1"), ("neighbors", "<i4", (4,)),
    ]
)  # fmt: skip
LEVEL_INFO = np.dtype([("bytes", "<u8"), ("header", "<u4"), ("faces", "<u4")])
assert [each.itemsize for each in (HEADER, EXTENDED_HEADER, FACE_INFO, LEVEL_INFO)] == [64, 40, 20, 16]


class Faces(NamedTuple):
    """The faces of a .ptx file."""

    log2: Int8s  # (n, 2)        log2 of the texels along u and v
    neighbors: Int32s  # (n, 4)   the face across each edge, −1 for none; a triangle's fourth is −1
    edges: Uint8s  # (n, 4)       the number of that edge there
    subfaces: Bools  # (n,)       parts of polygons that are not quads

    @property
    def counts(self) -> Int64s:
        """The number of texels of each face (n,)."""
        counts: Int64s = np.int64(1) << self.log2.sum(axis=1, dtype=np.int64)
        return counts


def packed_faces(faces: Faces, is_constant: Bools) -> np.ndarray:
    """Return faces in the file's format."""
    info = np.zeros(len(faces.log2), FACE_INFO)
    info["u_log2"], info["v_log2"] = faces.log2.T
    info["neighbors"] = faces.neighbors
    info["edges"] = (faces.edges.astype(np.uint8) << np.arange(0, 8, 2, dtype=np.uint8)).sum(
        axis=1, dtype=np.uint8
    )
    info["flags"] = IS_CONSTANT * is_constant + IS_SUBFACE * faces.subfaces
    return info


def unpacked_faces(info: np.ndarray) -> Faces:
    """Return the faces (n,) of a file."""
    return Faces(
        np.stack([info["u_log2"], info["v_log2"]], axis=1),
        info["neighbors"].astype(np.int32),
        info["edges"][:, None] >> np.arange(0, 8, 2, dtype=np.uint8) & np.uint8(3),
        info["flags"] & IS_SUBFACE != 0,
    )


def sizes_of(words: Uint32s) -> tuple[Int64s, Uint32s]:
    """Return the sizes and the encodings of blocks from their words (n,)."""
    return (words & np.uint32((1 << BLOCK_BITS) - 1)).astype(np.int64), words >> np.uint32(BLOCK_BITS)


def reduced_order(log2: Int8s, is_constant: Bools) -> tuple[Int64s, Int64s]:
    """Return the order of faces in the levels above 0 (n,), and the number of each level's, from level 0."""
    key = np.where(is_constant, 1, log2.min(axis=1))
    order = np.argsort(-key, kind="stable")
    deepest = int(key.max(initial=2))
    return order, np.array(
        [len(key), *((key > level + 1).sum() for level in range(1, deepest - 1))], np.int64
    )


def tile_log2(u_log2: int, v_log2: int, pixel: int) -> tuple[int, int]:
    """Return log2 of the sides of a face's tiles; a texel has ``pixel`` bytes."""
    tiles = max(((pixel << u_log2 + v_log2) // TILE_BYTES).bit_length() - 1, 0)
    rest = u_log2 + v_log2 - tiles
    u = min((rest + 1) // 2, u_log2)
    return u, min(rest - u, v_log2)
