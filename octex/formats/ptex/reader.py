"""Reads .ptx files lazily."""

from __future__ import annotations

import os
import threading
import zlib
from functools import cached_property
from typing import Self

import numpy as np

from octex.arrays import Array, Bools, Int8s, Int64s, Uint32s
from octex.checks import as_path, as_whole, locked
from octex.errors import ModelError
from octex.files import open_file
from octex.formats.ptex import layout
from octex.formats.ptex.layout import Faces

#: Most bytes that a byte of a zlib stream can hold.
_MOST_PER_BYTE = 1032
_ROOM = 64


class PtexFile:
    """An open .ptx file.

    mesh_type      "quad" or "triangle"
    dtype          of the texels: uint8, uint16, float16 or float32
    n_channels     components of a texel
    alpha_channel  the component that is alpha, or None
    n_faces        number of faces
    n_levels       stored levels: the texels, and reductions of them
    faces          their resolutions and neighbours
    is_constant    (n_faces,) whether a face is one colour
    border_modes   at the mesh's borders along u and v: "clamp", "black" or "periodic"
    edge_filter    "none"; "tangent": values are vectors in the face's tangent space

    Opening reads the headers and appended edits; texels are read on demand. Raises ModelError, naming the
    file, for files that cannot be read, and for damage whenever it is found.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = as_path(path)
        self._lock = threading.Lock()
        try:
            self._file = open_file(self.path)
        except OSError as error:
            raise ModelError(f"{self.path} cannot be read: {error.strerror or error}") from None
        try:
            self._open()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        """Close the file."""
        if hasattr(self, "_file"):
            self._file.close()

    def __repr__(self) -> str:
        kind = f"{self.n_channels} × {self.dtype.name}"
        return f"<PtexFile {self.path.name!r} of {self.n_faces:,} {self.mesh_type} faces, {kind}>"

    @property
    def most_bytes(self) -> int:
        """The most bytes of texels that a file of this size can hold."""
        return self._size * _MOST_PER_BYTE

    def close(self) -> None:
        """Close the file; arrays already read stay valid."""
        self._file.close()

    def _open(self) -> None:
        self._size = self._file.seek(0, os.SEEK_END)
        header = np.frombuffer(self._read(0, layout.HEADER.itemsize), layout.HEADER)[0]
        if header["magic"] != layout.MAGIC:
            raise self._refusal("it does not begin as Ptex files do", "is not a .ptx file")
        if header["version"] != layout.VERSION:
            raise ModelError(
                f"{self.path.name} has Ptex version {header['version']}; octex reads {layout.VERSION}"
            )
        if header["mesh_type"] >= len(layout.MESH_TYPES) or header["data_type"] >= len(layout.DTYPES):
            raise self._refusal("an unknown kind of mesh or of numbers")
        self.mesh_type = layout.MESH_TYPES[header["mesh_type"]]
        self.dtype = np.dtype(layout.DTYPES[header["data_type"]])
        self._stored = self.dtype.newbyteorder("<")
        self.n_channels, self.n_faces = int(header["channels"]), int(header["faces"])
        self.n_levels = int(header["levels"])
        alpha = int(header["alpha_channel"])
        self.alpha_channel = alpha if 0 <= alpha < self.n_channels else None
        if not self.n_channels or not self.n_faces or not self.n_levels:
            raise self._refusal("it has no channels, no faces or no levels")
        if header["level_info"] != self.n_levels * layout.LEVEL_INFO.itemsize:
            raise self._refusal("its levels' sizes take another number of bytes than there are levels")
        self._pixel = self.n_channels * self.dtype.itemsize
        length = int(header["extended_header"])
        known = layout.EXTENDED_HEADER.itemsize
        data = self._read(layout.HEADER.itemsize, min(length, known)).ljust(known, b"\0")
        extended = np.frombuffer(data, layout.EXTENDED_HEADER)[0]
        u, v, edges = (int(extended[name]) for name in ("u_border", "v_border", "edge_filter"))
        if max(u, v) >= len(layout.BORDER_MODES) or edges >= len(layout.EDGE_FILTERS):
            raise self._refusal("an unknown border mode or edge filter")
        self.border_modes = layout.BORDER_MODES[u], layout.BORDER_MODES[v]
        self.edge_filter = layout.EDGE_FILTERS[edges]

        at = layout.HEADER.itemsize + length
        sizes = {name: int(header[name]) for name in ("face_info", "constants", "level_info", "level_data")}
        sections = {}
        for name, size in sizes.items():
            sections[name] = at, size
            at += size
        has_metadata = header["metadata_zipped"] > 0 or extended["large_zipped"] > 0
        self._metadata_at = at, int(header["metadata_zipped"]), int(header["metadata"])
        large = int(extended["large_zipped"]) + int(extended["large_data"])
        self._large_end = at + self._metadata_at[1] + layout.BARRIER + large
        if max(at, self._large_end if has_metadata else 0) > self._size:
            raise self._refusal("it ends early")
        self._constants_at = sections["constants"]
        first, room = sections["level_data"]
        info = np.frombuffer(self._read(*sections["level_info"]), layout.LEVEL_INFO)[0]
        length, level_header, faces = info.tolist()
        if faces != self.n_faces:
            raise self._refusal("its levels have another number of faces than it has")
        if level_header > length or length > room:
            raise self._refusal("a level is larger than all of them")
        #: where the first level begins, its bytes, and those of its header
        self._level = first, length, level_header
        self._info = np.frombuffer(
            self._inflated(*sections["face_info"], self.n_faces * layout.FACE_INFO.itemsize), layout.FACE_INFO
        ).copy()
        self._read_edits(extended, at if not has_metadata else self._large_end)
        self._check_faces()
        log2, neighbors, across, subfaces = layout.unpacked_faces(self._info)
        self.faces = Faces(locked(log2), locked(neighbors), locked(across), locked(subfaces))
        self.is_constant: Bools = locked(self._info["flags"] & layout.IS_CONSTANT != 0)

    def _read_edits(self, extended: np.void, end: int) -> None:
        """Note the positions of edits; those of faces replace the face's record."""
        self._edited: dict[int, tuple[int, int]] = {}  # face: start of the header and pixel, end of the edit
        self._metadata_edits: list[tuple[int, int, int]] = []
        at = max(int(extended["edits_at"]), end)
        stop = self._size
        if extended["edits_at"] > 0:
            stop = at + int(extended["edits"])
            if stop > self._size:
                raise self._refusal("it ends early")
        elif end < self._size:  # older files have edits from the barrier to the end
            at = max(at, self._large_end)
        data = self._read(at, stop - at) if at < stop else b""
        position = 0
        while position + 5 <= len(data):
            kind, size = data[position], int.from_bytes(data[position + 1 : position + 5], "little")
            begin, position = position + 5, position + 5 + size
            if position > len(data):
                raise self._refusal("an edit ends early")
            if kind == layout.EDIT_FACE:
                start = begin + 4 + layout.FACE_INFO.itemsize
                if start + 4 + self._pixel > position:
                    raise self._refusal("an edit of a face is too short")
                face = int.from_bytes(data[begin : begin + 4], "little")
                if face >= self.n_faces:
                    raise self._refusal(f"an edit of face {face}; it has {self.n_faces}")
                self._info[face] = np.frombuffer(data[begin + 4 : start], layout.FACE_INFO)[0]
                self._info[face]["flags"] |= layout.HAS_EDITS
                self._edited[face] = at + start, at + position
            elif kind == layout.EDIT_METADATA:
                if size < 8:
                    raise self._refusal("an edit of metadata is too short")
                zipped = int.from_bytes(data[begin : begin + 4], "little")
                length = int.from_bytes(data[begin + 4 : begin + 8], "little")
                if zipped > size - 8:
                    raise self._refusal("an edit of metadata is too short")
                self._metadata_edits.append((at + begin + 8, zipped, length))

    def _check_faces(self) -> None:
        info = self._info
        u, v, neighbors = info["u_log2"], info["v_log2"], info["neighbors"]
        is_triangle = self.mesh_type == layout.MESH_TYPES[layout.TRIANGLE]
        sides = 3 if is_triangle else 4
        if min(u.min(), v.min()) < 0 or max(u.max(), v.max()) > layout.LONGEST_LOG2:
            raise self._refusal(f"a face's side is not of 1 to 2^{layout.LONGEST_LOG2} texels")
        if is_triangle and (u != v).any():
            raise self._refusal("a triangle has another number of texels along u than along v")
        if (neighbors[:, :sides] < -1).any() or (neighbors[:, :sides] >= self.n_faces).any():
            raise self._refusal(f"a face has a neighbour that is not among the {self.n_faces}")
        info["neighbors"][:, sides:] = -1

    @cached_property
    def constants(self) -> Array:
        """The average of each face (n_faces, n_channels), in the stored type."""
        data = self._inflated(*self._constants_at, self.n_faces * self._pixel)
        values = np.frombuffer(data, self._stored).reshape(self.n_faces, -1).astype(self.dtype)
        for face, (at, _) in self._edited.items():
            values[face] = np.frombuffer(self._read(at + 4, self._pixel), self._stored)
        return locked(values)

    def texels(self, face: int) -> Array:
        """Return the texels (v, u, n_channels) of a face, the row of v = 0 first, as numbers of ``dtype``.

        For a triangle the array is the square that the layout describes. Raises ArgumentError for a face out
        of range.
        """
        face = as_whole(face, "face", 0, self.n_faces - 1)
        u, v = self.faces.log2[face].tolist()
        if self.is_constant[face]:
            return np.broadcast_to(self.constants[face], (1 << v, 1 << u, self.n_channels))
        if face in self._edited:
            at, end = self._edited[face]
            words = np.frombuffer(self._read(at, 4), "<u4")
            size, encoding = (int(each[0]) for each in layout.sizes_of(words))
            begin = at + 4 + self._pixel
            if begin + size > end:
                raise self._refusal("an edit of a face is too short")
        else:
            begin, size, encoding = (int(each[face]) for each in self._blocks)
        return self._decoded(self._read(begin, size), encoding, u, v, is_tile=False)

    def all_texels(self) -> tuple[Array, Int8s]:
        """Return texels (k, channels) of all faces, one for constant faces, and log2 of sides (faces, 2)."""
        log2 = np.where(self.is_constant[:, None], np.int8(0), self.faces.log2)
        counts = np.int64(1) << log2.sum(axis=1, dtype=np.int64)
        if counts.sum(dtype=np.float64) * self._pixel > self.most_bytes:
            raise self._refusal("it is too short for its texels")
        ends = np.cumsum(counts)
        texels = np.empty((int(ends[-1]), self.n_channels), self.dtype)
        for face, (count, end) in enumerate(zip(counts.tolist(), ends.tolist(), strict=True)):
            texels[end - count : end] = (
                self.constants[face] if self.is_constant[face] else self.texels(face).reshape(count, -1)
            )
        return texels, log2

    @cached_property
    def _blocks(self) -> tuple[Int64s, Int64s, Uint32s]:
        """The start of each face's block (n_faces,), its size and its encoding."""
        at, length, header = self._level
        sizes, encodings = layout.sizes_of(np.frombuffer(self._inflated(at, header, 4 * self.n_faces), "<u4"))
        if header + int(sizes.sum()) > length:
            raise self._refusal("the blocks of a level are larger than it")
        return at + header + np.cumsum(sizes) - sizes, sizes, encodings

    def _decoded(self, data: bytes, encoding: int, u: int, v: int, *, is_tile: bool) -> Array:
        shape = 1 << v, 1 << u, self.n_channels
        if encoding == layout.CONSTANT:
            if len(data) != self._pixel:
                raise self._refusal("a pixel takes another number of bytes than its channels")
            pixel = np.frombuffer(data, self._stored).astype(self.dtype)
            return np.broadcast_to(pixel, shape)
        if encoding == layout.TILED:
            if is_tile:
                raise self._refusal("a tile of tiles")
            return self._from_tiles(data, u, v)
        if encoding == layout.DIFFERENCED and self.dtype.kind != "u":
            raise self._refusal("differences of numbers that are not whole")
        plane = self._unzipped(data, self._pixel << u + v)
        values: Array = np.frombuffer(plane, self._stored)
        if encoding == layout.DIFFERENCED:
            values = np.cumsum(values, dtype=self.dtype)
        planar = values.astype(self.dtype, copy=False).reshape(self.n_channels, *shape[:2])
        return np.moveaxis(planar, 0, 2)

    def _from_tiles(self, data: bytes, u: int, v: int) -> Array:
        if len(data) < 6:
            raise self._refusal("a face of tiles ends early")
        tile_u, tile_v = np.frombuffer(data[:2], np.int8).tolist()
        header = int.from_bytes(data[2:6], "little")
        if not (0 <= tile_u <= u and 0 <= tile_v <= v) or 6 + header > len(data):
            raise self._refusal("its tiles do not fit a face")
        across, count = 1 << u - tile_u, 1 << u - tile_u + v - tile_v
        words = self._unzipped(data[6 : 6 + header], 4 * count)
        sizes, encodings = layout.sizes_of(np.frombuffer(words, "<u4"))
        begins = 6 + header + np.cumsum(sizes) - sizes
        if begins[-1] + sizes[-1] > len(data):
            raise self._refusal("a face of tiles ends early")
        zipped = encodings != layout.CONSTANT
        if (sizes[zipped] * _MOST_PER_BYTE + _ROOM < self._pixel << tile_u + tile_v).any():
            raise self._refusal("a tile is too short for its texels")
        whole = np.empty((1 << v, 1 << u, self.n_channels), self.dtype)
        rows, columns = 1 << tile_v, 1 << tile_u
        for tile, (begin, size, encoding) in enumerate(
            zip(begins.tolist(), sizes.tolist(), encodings.tolist(), strict=True)
        ):
            row, column = tile // across * rows, tile % across * columns
            whole[row : row + rows, column : column + columns] = self._decoded(
                data[begin : begin + size], encoding, tile_u, tile_v, is_tile=True
            )
        return whole

    @cached_property
    def metadata(self) -> dict[str, str]:
        """The stored texts by name, without large metadata."""
        texts: dict[str, str] = {}
        for at, zipped, size in (self._metadata_at, *self._metadata_edits):
            data, position = self._inflated(at, zipped, size) if size else b"", 0
            while position < len(data):
                after = position + 1 + data[position]
                if not data[position] or after + 5 > len(data):
                    raise self._refusal("an entry of the metadata ends early")
                key, kind = data[position + 1 : after], data[after]
                position = after + 5 + int.from_bytes(data[after + 1 : after + 5], "little")
                if position > len(data) or kind >= layout.METADATA_TYPES:
                    raise self._refusal("an entry of the metadata ends early or is of an unknown type")
                if kind == layout.TEXT:
                    name, value = (each.split(b"\0", 1)[0] for each in (key, data[after + 5 : position]))
                    texts[name.decode("utf-8", "replace")] = value.decode("utf-8", "replace")
        return texts

    def _read(self, at: int, size: int) -> bytes:
        if at + size > self._size:
            raise self._refusal("it ends early")
        try:
            with self._lock:
                self._file.seek(at)
                data = self._file.read(size)
        except (OSError, ValueError) as error:
            raise ModelError(f"{self.path} cannot be read: {error}") from None
        if len(data) != size:
            raise self._refusal("it ends early")
        return data

    def _inflated(self, at: int, zipped: int, size: int) -> bytes:
        return self._unzipped(self._read(at, zipped), size)

    def _unzipped(self, data: bytes, size: int) -> bytes:
        """Return the content of a zlib stream, without allocating for sizes that it cannot hold."""
        if size > len(data) * _MOST_PER_BYTE + _ROOM:
            raise self._refusal("a stream is too short for what it should hold")
        stream = zlib.decompressobj()
        try:
            content = stream.decompress(data, size + 1)
        except zlib.error as error:
            raise self._refusal(str(error)) from None
        if len(content) != size or not stream.eof:
            raise self._refusal(f"a stream does not hold the {size:,} bytes that it should")
        return content

    def _refusal(self, why: str, what: str = "is damaged") -> ModelError:
        return ModelError(f"{self.path.name} {what}: {why}; write it again")
