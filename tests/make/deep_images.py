"""Image files of more than eight bits, put together byte by byte from the formats' own pages."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

_EXR_KINDS = {"uint32": 0, "float16": 1, "float32": 2}


class Part(NamedTuple):
    """A part of an OpenEXR file: channels (height, width) by name, and the windows' corners."""

    channels: Mapping[str, npt.NDArray[Any]]
    corner: tuple[int, int] = (0, 0)  # x, y of the data window
    display: tuple[int, int, int, int] | None = None  # first and last x, y, x, y; None: the data window


def exr(*parts: Part) -> bytes:
    """An uncompressed OpenEXR file of scan lines (openexr.com, File Layout)."""
    several = len(parts) > 1
    headers, chunks = b"", []
    for number, part in enumerate(parts):
        height, width = next(iter(part.channels.values())).shape
        x, y = part.corner
        data = (x, y, x + width - 1, y + height - 1)
        entries = b"".join(
            name.encode() + b"\0" + struct.pack("<iB3xii", _EXR_KINDS[array.dtype.name], 0, 1, 1)
            for name, array in sorted(part.channels.items())
        )
        attributes = [
            ("channels", "chlist", entries + b"\0"),
            ("compression", "compression", b"\0"),
            ("dataWindow", "box2i", struct.pack("<4i", *data)),
            ("displayWindow", "box2i", struct.pack("<4i", *(part.display or data))),
            ("lineOrder", "lineOrder", b"\0"),
            ("pixelAspectRatio", "float", struct.pack("<f", 1)),
            ("screenWindowCenter", "v2f", bytes(8)),
            ("screenWindowWidth", "float", struct.pack("<f", 1)),
        ]
        if several:
            attributes += [
                ("name", "string", b"part%d" % number),
                ("type", "string", b"scanlineimage"),
                ("chunkCount", "int", struct.pack("<i", height)),
            ]
        for name, kind, value in attributes:
            headers += name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
        headers += b"\0"
        for row in range(height):
            line = b"".join(array[row].tobytes() for _, array in sorted(part.channels.items()))
            head = struct.pack("<i", number) if several else b""
            chunks.append(head + struct.pack("<ii", y + row, len(line)) + line)
    start = b"\x76\x2f\x31\x01" + struct.pack("<i", 2 + 0x1000 * several) + headers + b"\0" * several
    at = len(start) + 8 * len(chunks)
    offsets = b""
    for chunk in chunks:
        offsets += struct.pack("<q", at)
        at += len(chunk)
    return start + offsets + b"".join(chunks)


def hdr(mantissas: npt.NDArray[np.uint8], order: bytes = b"-Y %d +X %d") -> bytes:
    """A Radiance HDR file of RGBE texels (rows, columns, 4) as they are (Ward, Real Pixels)."""
    size = order % mantissas.shape[:2]
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + size + b"\n" + mantissas.tobytes()


def tiff(
    stored: npt.NDArray[Any],
    photometric: int,
    alpha: int | None = None,
    size: Sequence[int] = (),
    order: str = "<",
) -> bytes:
    """A TIFF file of one strip (TIFF 6.0): (height, width, samples), its last of a kind of extra sample."""
    height, width = size or stored.shape[:2]
    samples = stored.shape[2]
    kind = {"u": 1, "i": 2, "f": 3}[stored.dtype.kind]
    body = stored.astype(stored.dtype.newbyteorder(order)).tobytes()
    tags: list[tuple[int, int, list[int]]] = [
        (256, 4, [width]),
        (257, 4, [height]),
        (258, 3, [stored.dtype.itemsize * 8] * samples),
        (259, 3, [1]),
        (262, 3, [photometric]),
        (273, 4, [8]),
        (277, 3, [samples]),
        (278, 4, [height]),
        (279, 4, [len(body)]),
        (339, 3, [kind] * samples),
    ]
    if alpha is not None:
        tags.insert(-1, (338, 3, [alpha]))
    at = 8 + len(body)
    extra, entries = b"", b""
    for tag, field, values in tags:
        value = struct.pack(f"{order}{len(values)}{'H' if field == 3 else 'I'}", *values)
        if len(value) > 4:
            place = at + len(extra)
            extra += value
            value = struct.pack(f"{order}I", place)
        entries += struct.pack(f"{order}HHI", tag, field, len(values)) + value.ljust(4, b"\0")
    directory = struct.pack(f"{order}H", len(tags)) + entries + bytes(4)
    return (
        {"<": b"II*\0", ">": b"MM\0*"}[order]
        + struct.pack(f"{order}I", at + len(extra))
        + body
        + extra
        + directory
    )


def psd(stored: npt.NDArray[Any]) -> bytes:
    """A Photoshop file (height, width, 3) of 16 or 32 bits without layers."""
    height, width, channels = stored.shape
    depth = stored.dtype.itemsize * 8
    planes = np.moveaxis(stored, 2, 0)
    header = b"8BPS" + struct.pack(">H6xHIIHH", 1, channels, height, width, depth, 3)
    return header + bytes(12) + b"\0\0" + planes.astype(planes.dtype.newbyteorder(">")).tobytes()


def sgi(stored: npt.NDArray[np.uint16]) -> bytes:
    """An SGI file (height, width, channels) of 16 bits, its rows from the bottom up."""
    height, width, channels = stored.shape
    header = struct.pack(">HBBHHHHII", 474, 0, 2, 3, width, height, channels, 0, 65535)
    return header.ljust(512, b"\0") + np.moveaxis(stored[::-1], 2, 0).astype(">u2").tobytes()


def pnm(stored: npt.NDArray[np.uint16], most: int = 65535) -> bytes:
    """A PGM or PPM file of 16 bits: (height, width, 1 or 3)."""
    height, width, channels = stored.shape
    kind = b"P5" if channels == 1 else b"P6"
    return kind + b"\n# made by hand\n%d %d\n%d\n" % (width, height, most) + stored.astype(">u2").tobytes()


def pfm(stored: npt.NDArray[np.float32]) -> bytes:
    """A PFM file: (height, width, 1 or 3), its rows from the bottom up."""
    height, width, channels = stored.shape
    kind = b"Pf" if channels == 1 else b"PF"
    return kind + b"\n%d %d\n-1.0\n" % (width, height) + stored[::-1].astype("<f4").tobytes()
