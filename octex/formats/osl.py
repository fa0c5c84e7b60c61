"""OSL: a texture as an image, and a shader of Open Shading Language that looks it up, for path tracers.

The shader walks the octree for each point of the surface, as `OctreeTexture.sample` does: see walk.osl, which
describes the image.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Sequence
from importlib.resources import files
from string import Template

import numpy as np

from octex.arrays import Array, Uint16s
from octex.channels import ALPHA, ChannelFormat, decode
from octex.checks import as_names, as_path
from octex.errors import ArgumentError
from octex.files import replacing
from octex.processing.resize import resize
from octex.texture import Channel, OctreeTexture, as_texture
from octex.tree.children import children_before, masks_of
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.split import counts_of

ENDING = ".osl"
#: Texels in a row of the image.
_WIDTH = 4096
#: Most cells that the image's 24-bit numbers can index.
_MOST_CELLS = 1 << 24
#: Positions below a plane of cells by this part of the root's edge count as on it, the precision of float32.
_ROUNDED = 2.0**-22
#: Reserved words of OSL (OSL 1.12, 3.2), its variables and the shader's inputs.
_RESERVED = """
and break closure color continue do else emit float for if illuminance illuminate int matrix normal
not or output point public return string struct vector void while bool case catch char class const
delete default double enum extern false friend goto inline long new operator private protected short
signed sizeof static switch template this throw true try typedef uniform union unsigned varying
virtual volatile P I N Ng u v Position Normal Filter ZUp File
"""
_WORDS = _RESERVED.split()
#: Rows of the image that are compressed together.
_ROWS = 64


def write_osl(
    texture: OctreeTexture, path: str | os.PathLike[str], *, channels: Sequence[str] | None = None
) -> None:
    """Write a texture as NAME.osl, a shader of Open Shading Language, and its image NAME.osl.tif.

    channels  names of the channels that the shader has outputs for (default: all with at most 3 components)

    The shader's outputs are named like the channels, except ``normal_``. A colour is linear light; a
    direction is a normal in the renderer's world. Its inputs:

    Position  the rest position, in the object's axes (default: the rendered position)
    Normal    the shading normal there (default: as rendered); surface that faces away has no weight
    Filter    0 nearest, 1 linear, 2 quadratic (default), as in ``sample``
    ZUp       1: the object's axes have z up, as in Blender, and are turned to the texture's y up
    File      the image

    Where all leaves have one depth, a lookup on the surface agrees with ``sample`` with normals to 1/255.
    Other leaves are first divided, as by ``octex.resize``: ``nearest`` then reads finer cells, and the others
    differ by up to 4/255. Points off the surface get a coarser level, whose cells count alike. Footprints are
    not averaged: use several rays a pixel.

    The image stores 16-bit numbers, of floats from the least to the greatest value, and alpha in 8 bits.
    Raises ArgumentError for another ending, for unknown channels or none, for channels of 4 components, and
    for more than 16,777,216 cells; OutputError if a file cannot be written.
    """
    texture, path = as_texture(texture), as_path(path)
    if path.suffix.lower() != ENDING:
        raise ArgumentError(f"{path}: an OSL shader is saved as NAME{ENDING}")
    names = _chosen(texture, path, channels)
    texture = _of_one_depth(texture, path)
    planes = _planes([texture.channels[name].format for name in names])
    image = path.with_name(f"{path.name}.tif")
    tree = texture.tree
    n_rows = tree.split.cells.size + tree.split.areas.size
    first, rows = (-(-count // _WIDTH) * _WIDTH for count in (max(tree.n_nodes, 1), tree.n_cells + n_rows))
    texels = np.zeros((first + rows * len(planes) + _WIDTH, 4), np.uint16)
    texels[-_WIDTH:] = 65535  # tells the shader which way up the renderer reads
    texels[: tree.n_nodes] = _nodes(texture)
    ranges: dict[str, tuple[float, float]] = {}
    for number, plane in enumerate(planes):
        begin = first + number * rows
        _fill(texels[begin : begin + tree.n_cells + n_rows], texture, plane, ranges)
    with replacing(image) as file:
        file.write(_tiff_file(texels.reshape(-1, _WIDTH, 4)))
    numbers = {
        "WIDTH": _WIDTH, "HEIGHT": len(texels) // _WIDTH, "CELLS": first, "ROWS": rows,
        "DEPTH": tree.max_depth, "HAS_ALPHA": int(ALPHA.name in texture.channels), "ROUNDED": _ROUNDED,
        "ORIGIN": f"vector({', '.join(map(repr, map(float, texture.placement.origin)))})",
        "SIZE": float(texture.placement.size),
    }  # fmt: skip
    template = Template((files(__name__.rpartition(".")[0]) / "walk.osl").read_text("utf-8"))
    defines = [f"#define {name} {value}" for name, value in numbers.items()]
    outputs, statements = _outputs(texture, planes, ranges)
    walk = template.substitute(
        name=re.sub(r"\W", "_", f"octex_{path.stem}"),
        file=str(image.resolve()).replace("\\", "\\\\").replace('"', '\\"'),
        outputs=",\n".join(outputs),
        statements="\n".join(statements),
    )
    with replacing(path) as file:
        file.write("\n".join([*defines, walk]).encode())


def _chosen(texture: OctreeTexture, path: os.PathLike[str], channels: Sequence[str] | None) -> list[str]:
    """Return the names of the channels to write."""
    stored = texture.channels
    if channels is None:
        names = [name for name, each in stored.items() if each.format.components <= 3]
    else:
        names = as_names(channels, "channels", stored, "channel of the texture")
        for name in names:
            if stored[name].format.components > 3:
                raise ArgumentError(f"{path}: channel {name!r} has 4 components; an OSL shader has 3 at most")
    if not names:
        raise ArgumentError(f"{path}: there is no channel to write; give a texture with base_color")
    return names


def _of_one_depth(texture: OctreeTexture, path: os.PathLike[str]) -> OctreeTexture:
    """Return a texture whose leaves all have the greatest depth."""
    counts = [leaves for leaves, _ in texture.tree.cells_by_depth()]
    for depth in range(len(counts) - 1, -1, -1):
        nodes = texture.tree.arrays.level_nodes
        cells = int(nodes[depth + 1] - nodes[depth]) + sum(
            leaves * 8 ** (depth - level) for level, leaves in enumerate(counts[: depth + 1])
        )
        if 8 * cells // 7 <= _MOST_CELLS:
            break
    if depth < len(counts) - 1:
        raise ArgumentError(
            f"{path}: takes more than {_MOST_CELLS:,} cells with leaves of one depth; "
            f"write texture.level({depth})"
        )
    return resize(texture, depth) if sum(counts[:depth]) else texture


def _planes(formats: Sequence[ChannelFormat]) -> list[list[str]]:
    """Distribute channels to planes, whose components, at most three, share texels; single ones come last."""
    single = [each.name for each in formats if each.components == 1]
    planes = [[each.name] for each in formats if each.components > 1]
    return planes + [single[begin : begin + 3] for begin in range(0, len(single), 3)]


def _nodes(texture: OctreeTexture) -> Uint16s:
    """Return the texels of nodes (nodes, 4)."""
    tree = texture.tree
    masks = [masks_of(tree.arrays.groups, word)[: tree.n_nodes].astype(np.int64) for word in range(2)]
    first_cells, first_nodes = children_before(tree.arrays.groups, np.arange(tree.n_nodes))
    words = np.stack([first_cells << 8 | masks[0], first_nodes << 8 | masks[1]], axis=1).astype("<u4")
    return words.view("<u2").reshape(-1, 4)


def _fill(
    texels: Uint16s, texture: OctreeTexture, plane: Sequence[str], ranges: dict[str, tuple[float, float]]
) -> None:
    """Write the texels of a plane: first cells, then split cells with their facings."""
    tree = texture.tree
    split, n_cells = tree.split, tree.n_cells
    counts = counts_of(split.facings)
    firsts = n_cells + np.cumsum(counts + 1) - counts - 1
    is_facing = np.ones(len(texels) - n_cells, np.bool_)
    is_facing[firsts - n_cells] = False
    lane = 0
    for name in plane:
        channel = texture.channels[name]
        values, ranges[name] = _codes(channel)
        lanes = slice(lane, lane + channel.format.components)
        texels[:n_cells, lanes] = values[:n_cells]
        texels[firsts, lanes] = values[split.cells]
        texels[n_cells:, lanes][is_facing] = values[n_cells:]
        lane = lanes.stop
    alpha = np.full(len(texels), 255, np.uint16)
    if ALPHA.name in texture.channels:
        codes = (_codes(texture.channels[ALPHA.name])[0][:, 0].astype(np.uint32) + 128) // 257
        alpha[:n_cells], alpha[firsts] = codes[:n_cells], codes[split.cells]
        alpha[n_cells:][is_facing] = codes[n_cells:]
    texels[:, 3] = alpha << 8
    texels[:n_cells, 3] |= tree.arrays.flags & np.uint8(FACING_FLAGS)
    texels[split.cells, 3] |= SPLIT
    texels[split.cells, 0], texels[split.cells, 1], texels[split.cells, 2] = firsts & 0xFFFF, firsts >> 16, 0


def _codes(channel: Channel) -> tuple[Uint16s, tuple[float, float]]:
    """Return the values of cells and split rows in 16 bits, and the values that 0 and 1 stand for."""
    form = channel.format
    low, high = (-1.0, 1.0) if form.space == "direction" else (0.0, 1.0)
    values = [decode(each, form.space) for each in (channel.values, channel.split_values)]
    if form.dtype.startswith("float"):
        low = min(low, *(float(each.min(initial=0.0)) for each in values))
        high = max(high, *(float(each.max(initial=0.0)) for each in values))
    scaled = (np.concatenate(values) - np.float32(low)) * np.float32(65535 / (high - low))
    return np.rint(scaled).astype(np.uint16), (low, high)


def _outputs(
    texture: OctreeTexture, planes: Sequence[Sequence[str]], ranges: dict[str, tuple[float, float]]
) -> tuple[list[str], list[str]]:
    """Return the shader's outputs, which are the channels, and the statements that compute them."""
    outputs, lines = [], []
    for number, plane in enumerate(planes):
        lines.append(f"  color o_values{number};")
        arguments = f"{number}, o_cells, o_weights, o_count, o_facing, o_values{number}, o_alpha"
        lines.append(f"  blend(File, o_turned, {arguments});")
        for lane, channel in enumerate(plane):
            form, (low, high) = texture.channels[channel].format, ranges[channel]
            scale = f"{low!r} + {high - low!r} * "
            output = output_name(channel)
            if form.components == 1:
                value = "o_alpha" if channel == ALPHA.name else f"{scale}o_values{number}[{lane}]"
                outputs.append(f"  output float {output} = 0")
                lines.append(f"  {output} = {value};")
            elif form.space == "direction" and form.components == 3:
                outputs.append(f"  output normal {output} = N")
                lines.append(f"  vector o_rest{number} = tilted((vector)({scale}o_values{number}), ZUp);")
                lines.append(
                    f'  {output} = normalize(transform("object", "common", (normal)o_rest{number}));'
                )
            else:
                outputs.append(f"  output color {output} = 0")
                lines.append(f"  {output} = {scale}o_values{number};")
    return outputs, lines


def output_name(channel: str) -> str:
    """Return the name of the shader's output for a channel; reserved words, like "normal", get a "_"."""
    name = re.sub(r"\W", "_", channel)
    return f"{name}_" if name in _WORDS else name


def _tiff_file(texels: Array) -> bytes:
    """Return a deflated TIFF of texels (height, width, 4) with 16 bits; the last lane is data (TIFF 6.0)."""
    height, width, lanes = texels.shape
    strips = [
        zlib.compress(texels[row : row + _ROWS].astype("<u2").tobytes(), 1) for row in range(0, height, _ROWS)
    ]
    short, long = 3, 4
    sizes = np.array([len(each) for each in strips], "<u4")
    # After the header and the table: the lanes' bits, then the offsets and the sizes of the strips.
    tags = 12
    tail = 8 + 2 + 12 * tags + 4
    strip_tables = tail + 2 * lanes
    strips_begin = strip_tables + 8 * len(strips)
    offsets = (strips_begin + np.cumsum(sizes) - sizes).astype("<u4")
    has_several = len(strips) > 1
    entries = [
        (256, long, 1, width), (257, long, 1, height), (258, short, lanes, tail), (259, short, 1, 8),
        (262, short, 1, 2), (273, long, len(strips), strip_tables if has_several else int(offsets[0])),
        (277, short, 1, lanes), (278, long, 1, _ROWS),
        (279, long, len(strips), strip_tables + 4 * len(strips) if has_several else int(sizes[0])),
        (284, short, 1, 1), (338, short, 1, 0), (339, short, 1, 1),
    ]  # fmt: skip
    table = b"".join(struct.pack("<HHII", *each) for each in entries)
    head = struct.pack("<2sHIH", b"II", 42, 8, tags) + table + bytes(4) + struct.pack("<4H", *[16] * lanes)
    return b"".join([head, offsets.tobytes(), sizes.tobytes(), *strips])
