"""A texture and its mesh as the page takes them: levels one after another, small enough to send.

Each chunk holds some levels, coarse ones first, as one stream of raw deflate. Of each of its levels come:

    node masks, leaf masks   a byte for each node of the level above
    areas                    a byte for each cell that is a node, less its parent's
    flags                    a byte for each cell, exclusive or with its parent's
    values                   of each channel, component after component, a byte for each cell, less its
                             parent's; of colours red and blue are stored less green

Numbers of cells and nodes follow from the masks, as in octex.tree.layout. Values are 8-bit codes; other types
are cast, floats from the range that they have. The last chunk holds the rows of kept nodes and of split
cells, if there are any.

The mesh is one stream: positions in whole numbers of 2⁻ᵇ of a cube's edge, each less the one before it;
normals as points of an octahedron, likewise; where it moves, the surface's vertices, and if it is posed the
normals at rest; where it has maps, coordinates in them and colours (``maps``); triangles by how far back each
vertex is from the next new one.
Numbers of more than a byte are stored as planes of bytes, the lowest first. For how it moves see ``moves``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from octex.arrays import Array, Float64s, Int32s, Uint8s, bit_counts
from octex.channels import ChannelFormat
from octex.drawing.environment import Environment
from octex.drawing.reflection import reflectances
from octex.errors import ArgumentError
from octex.processing.mapping import cast
from octex.source.materials import MaterialSource
from octex.texture import Channel, OctreeTexture, TextureSet
from octex.tree.children import masks_of
from octex.tree.layout import FACING_FLAGS
from octex.tree.octree import distinct
from octex.tree.split import rows_of
from octex.view.shading import corner_normals
from octex.viewer.maps import Maps
from octex.viewer.moves import packed_motion
from octex.viewer.streams import deflated, planes, zigzag

if TYPE_CHECKING:
    from octex.source.motion import Motion
    from octex.source.surface import Surface

#: Cells that the page's numbers, of 24 bits, can name; of a deeper tree the finest levels are left out.
MOST_CELLS = 1 << 24
#: Parts that the page tells apart by what it keeps of each pixel.
MOST_PARTS = 255
#: Cells that come in the first chunk.
_FIRST = 20_000


class Packed(NamedTuple):
    """What a page shows, or a part of that: a header, ready for JSON, and streams by their names."""

    header: dict[str, Any]
    streams: dict[str, bytes]

    @property
    def notes(self) -> list[str]:
        """What a page shows otherwise than its textures have it."""
        parts = self.header["parts"]
        return [
            f"{part['name']}: {note}" if part["name"] else note for part in parts for note in part["notes"]
        ]


class Part(NamedTuple):
    """A texture and the surface that it is of; of a set, a part of the model."""

    name: str
    texture: OctreeTexture
    surface: Surface | None


class Prepared(NamedTuple):
    """A texture as the page has it, of 8 bits, and what a part's header says of that."""

    texture: OctreeTexture
    header: dict[str, Any]


def parts_of(textures: OctreeTexture | TextureSet, surface: Surface | None) -> list[Part]:
    """Return what a page shows: a texture, or a set's, each with its part of the surface.

    Raises ArgumentError for more parts than a page shows, and for a surface with other parts than the set.
    """
    if isinstance(textures, OctreeTexture):
        return [Part("", textures, surface)]
    if len(textures) > MOST_PARTS:
        raise ArgumentError(
            f"a page shows at most {MOST_PARTS} parts, not {len(textures):,}; choose one of them"
        )
    if surface is None:
        return [Part(name, texture, None) for name, texture in textures.items()]
    numbers = surface.parts
    if numbers.max() + 1 != len(textures):
        count = f"{numbers.max() + 1:,} part{'s' if numbers.max() else ''}"
        raise ArgumentError(
            f"{surface.name} has {count}, and the set {len(textures):,}; give the set's model"
        )
    return [
        Part(name, texture, surface.part((numbers == number).nonzero()[0]))
        for number, (name, texture) in enumerate(textures.items())
    ]


def packed_page(
    parts: Sequence[Part],
    *,
    title: str,
    motion: Motion | None = None,
    maps: Maps | None = None,
    paints: bool = False,
    level: int = 6,
    room: int | None = None,
) -> Packed:
    """Pack all that a page shows, as ``pack`` does; motion, maps and paint are of a page of one part."""
    packed = [pack(each.texture, each.surface, level=level, room=room) for each in parts[1:]]
    first = parts[0]
    more: dict[str, Any] = {"motion": motion, "maps": maps, "paints": paints}
    packed.insert(0, pack(first.texture, first.surface, **more, level=level, room=room))
    headers = [{"name": part.name, **own.header} for part, own in zip(parts, packed, strict=True)]
    streams = {f"{n}-{name}": stream for n, own in enumerate(packed) for name, stream in own.streams.items()}
    studio, streams["studio"] = _packed_studio()
    return Packed({"title": title, "studio": studio, "parts": headers}, streams)


@cache
def _packed_studio() -> tuple[dict[str, Any], bytes]:
    """Return the header and the stream of the studio light, by which the library draws its own pictures.

    16-bit floats, each less the one before: the studio's tables, then A and B of the reflectance A·F₀ + B.
    """
    tables, reflectance = Environment.studio().tables, reflectances()
    light = tables.light[:, 0]  # it is grey
    halves = np.concatenate([light, reflectance.ravel()]).astype("<f2").view("<u2").astype(np.int64)
    header = {"tables": tables.shapes.tolist(), "reflectances": len(reflectance), "numbers": halves.size}
    return header, deflated(planes(zigzag(np.diff(halves, prepend=0))), 9)


def pack(
    texture: OctreeTexture,
    surface: Surface | None,
    *,
    motion: Motion | None = None,
    maps: Maps | None = None,
    paints: bool = False,
    level: int = 6,
    room: int | None = None,
) -> Packed:
    """Pack a texture, the surface that it is of, how that moves and its maps; deflate's ``level`` is 1 to 9.

    The header's ``notes`` say what the page shows otherwise than lookups have it. ``motion`` has
    fewer frames, or is left out, where it takes more than ``room`` bytes. A page that ``paints`` knows the
    surface's parts. Raises ArgumentError for a surface that is not the texture's.
    """
    if surface is not None:
        surface = surface.placed_on(texture)
    texture, header = prepared(texture)
    notes = header["notes"]
    streams: dict[str, bytes] = {}
    header["chunks"] = []
    for levels, stream in _chunks(texture):
        name = f"levels-{len(streams)}"
        streams[name] = deflated(stream, level)
        header["chunks"].append({"levels": levels, "bytes": len(streams[name])})
    if surface is not None:
        if motion is not None:
            moves = packed_motion(motion, surface, level, room)
            notes += moves.notes
            if moves.header:
                header["motion"], streams["motion"] = moves.header, moves.stream
        if maps is not None:
            header["source"] = maps.header
            streams |= {f"map-{number}": image for number, image in enumerate(maps.images)}
            notes += maps.notes
        header["mesh"], stream = _packed_mesh(texture, surface, "motion" in streams, maps, paints)
        streams["mesh"] = deflated(stream, level)
        header["mesh"]["bytes"] = len(streams["mesh"])
    return Packed(header, streams)


def prepared(texture: OctreeTexture) -> Prepared:
    """Return a texture as the page has it."""
    texture, ranges, notes = _with_bytes(texture)
    tree = texture.tree
    formats = [each.format for each in texture.channels.values()]
    slots = _slots(formats)
    header: dict[str, Any] = {
        "depth": tree.max_depth,
        "origin": list(texture.placement.origin),
        "size": texture.placement.size,
        "levelCells": tree.arrays.level_cells.tolist(),
        "levelNodes": tree.arrays.level_nodes.tolist(),
        "leaves": tree.n_leaves,
        "channels": [
            {
                "name": form.name,
                "components": form.components,
                "space": form.space,
                "at": slots[form.name],
                "range": ranges.get(form.name, [0.0, 1.0]),
            }
            for form in formats
        ],
        "area": slots["area"],
        "flags": slots["flags"],
        "planes": slots["planes"],
        "notes": notes,
        "isMixed": any(leaves for leaves, _ in tree.cells_by_depth()[:-1]) or tree.kept.cells.size > 0,
        "kept": tree.kept.cells.size,
        "split": [tree.split.cells.size, tree.split.areas.size],
    }
    return Prepared(texture, header)


def _chunks(texture: OctreeTexture) -> Iterator[tuple[list[int] | None, bytes]]:
    """Yield streams and the levels that are in them, the first and one beyond the last; None for tables."""
    tree = texture.tree
    cells = tree.arrays.level_cells.tolist()
    starts = [0, *(k for k in range(1, tree.max_depth + 1) if cells[k + 1] > _FIRST), tree.max_depth + 1]
    parts = list(_levels(texture))
    for first, end in pairwise(dict.fromkeys(starts)):
        yield [first, end], b"".join(parts[first:end])
    if tree.kept.cells.size + tree.split.cells.size:
        yield None, _tables(texture)


def _with_bytes(texture: OctreeTexture) -> tuple[OctreeTexture, dict[str, list[float]], list[str]]:
    """Return a texture of 8 bits that a page can show, what 0 and 1 stand for in it, and what differs."""
    notes: list[str] = []
    ranges: dict[str, list[float]] = {}
    channels = dict(texture.channels)
    for name, channel in texture.channels.items():
        if channel.format.dtype == "uint8":
            continue
        if channel.format.dtype.startswith("float") and channel.format.space != "direction":
            channels[name], ranges[name] = _in_range(channel)
        low, high = ranges.get(name, (-1 if channel.format.space == "direction" else 0, 1))
        notes.append(f"{name.replace('_', ' ')}: shown with 8 bits, {low:.4g} to {high:.4g}")
    if notes:
        texture = OctreeTexture(texture.tree, channels, texture.placement, texture.bounds, texture.metadata)
        texture = cast(texture, "uint8")
    depth = texture.tree.max_depth
    cells = texture.tree.arrays.level_cells
    while depth and int(cells[depth + 1]) > MOST_CELLS:
        depth -= 1
    if depth < texture.tree.max_depth:
        notes.append(f"depth {depth} of {texture.tree.max_depth}: a page shows {MOST_CELLS:,} cells at most")
        texture = texture.level(depth)
    return texture, ranges, notes


def _in_range(channel: Channel) -> tuple[Channel, list[float]]:
    """Return a channel of floats from 0 to 1, and what these stand for: 0 and 1, or its least and largest."""
    low, high = 0.0, 1.0
    for values in channel[1:]:
        if values.size:
            low, high = min(low, float(values.min())), max(high, float(values.max()))
    if (low, high) == (0.0, 1.0):
        return channel, [low, high]
    form = channel.format._replace(dtype="float32")
    parts = [((values.astype(np.float64) - low) / (high - low)).astype(np.float32) for values in channel[1:]]
    return Channel(form, *parts), [low, high]


def _tables(texture: OctreeTexture) -> bytes:
    """Return the last chunk: the rows of kept nodes and of split cells, less the values of their cells."""
    split, kept = texture.tree.split, texture.tree.kept
    facings = split.facings & np.uint8(FACING_FLAGS)
    owners = np.concatenate([kept.cells, rows_of(split).cells])
    steps = [np.diff(cells.astype(np.int64), prepend=0) for cells in (kept.cells, split.cells)]
    parts = [planes(np.concatenate(steps)), facings.tobytes()]
    for channel in texture.channels.values():
        rows = np.concatenate([channel.kept_values, channel.split_values])
        parts.append(np.ascontiguousarray((rows - channel.values[owners]).T).tobytes())
    return b"".join(parts)


def _slots(formats: list[ChannelFormat]) -> dict[str, Any]:
    """Return where channels, areas and flags lie, [plane, first component], and which planes are sRGB."""
    free: list[tuple[bool, list[int]]] = []
    at: dict[str, Any] = {}

    def place(name: str, components: int, is_srgb: bool) -> None:
        for number, (kind, slots) in enumerate([] if is_srgb else free):
            chosen = [slot for slot in slots if slot == 3 or not kind][:components]
            if len(chosen) == components and (components == 1 or chosen[0] == 0):
                at[name] = [number, chosen[0]]
                free[number] = kind, [slot for slot in slots if slot not in chosen]
                return
        at[name] = [len(free), 0]
        free.append((is_srgb, [slot for slot in range(components, 4) if free or slot < 3]))

    at["area"] = [0, 3]
    ranked = sorted(formats, key=lambda form: (form.name != "base_color", form.components != 3))
    if not formats or ranked[0].components == 4:
        free.append((False, [0, 1, 2]))
    for form in ranked:
        place(form.name, form.components, form.space == "srgb")
    place("flags", 1, False)
    at["planes"] = [is_srgb for is_srgb, _ in free]
    return at


def _levels(texture: OctreeTexture) -> Iterator[bytes]:
    """Yield what comes of each level."""
    arrays = texture.tree.arrays
    n_nodes = texture.tree.n_nodes
    node_masks, leaf_masks = (masks_of(arrays.groups, word)[:n_nodes] for word in range(2))
    above = np.zeros(1, np.int64)  # the cells that are nodes of the level above
    for level, (_, is_node) in enumerate(texture.tree.walk()):
        first, end = arrays.level_cells[level : level + 2].tolist()
        parts: list[Array] = []
        parents = np.zeros(1, np.int64)
        if level:
            rows = slice(*arrays.level_nodes[level - 1 : level + 1].tolist())
            parts += [node_masks[rows], leaf_masks[rows]]
            parents = np.repeat(above, bit_counts(node_masks[rows] | leaf_masks[rows]))
        known = np.uint8(level > 0)
        nodes = np.flatnonzero(is_node)
        parts.append(arrays.areas[first:end][nodes] - known * arrays.areas[parents[nodes]])
        parts.append(arrays.flags[first:end] ^ known * arrays.flags[parents])
        for channel in texture.channels.values():
            here, there = _apart(channel.values[first:end]), _apart(channel.values[parents])
            parts.append(np.ascontiguousarray((here - known * there).T))
        above = nodes + first
        yield b"".join(part.tobytes() for part in parts)


def _apart(values: Array) -> Uint8s:
    """Return colours (n, 3) with red and blue less green; others as they are."""
    values = np.asarray(values, np.uint8)
    if values.shape[1] != 3:
        return values
    green = values[:, 1]
    return np.stack([values[:, 0] - green, green, values[:, 2] - green], axis=1)


def _packed_mesh(
    texture: OctreeTexture, surface: Surface, moves: bool, maps: Maps | None, paints: bool
) -> tuple[dict[str, Any], bytes]:
    """Return what a mesh's stream holds, and the stream.

    Of one that ``moves`` it names vertices' owners, of one that is painted the parts that they are of.
    """
    order = np.arange(len(surface.triangles)) if maps is None else maps.order
    faces = surface.triangles[order]
    is_posed = surface.rest is not surface.vertices
    if surface.frames is None or is_posed:
        normals = corner_normals(surface.vertices, faces)
    else:
        normals = surface.frames.normals.values[surface.frames.normals.rows[order]]
    bits = min(max(20, texture.tree.max_depth + 8), 24)
    rest = texture.placement.to_texture_space(surface.rest)
    steps = np.rint(np.clip(rest, 0.0, 1.0) * (1 << bits)).astype(np.int32)
    columns = [steps[faces.ravel()], _octahedral(normals.reshape(-1, 3))]
    low, edge = np.array(texture.placement.origin), texture.placement.size
    if is_posed:
        used = surface.vertices[distinct(faces.ravel())]
        low, edge = used.min(axis=0), float(np.ptp(used, axis=0).max()) or 1.0
        posed = np.rint((surface.vertices - low) / edge * (1 << bits)).astype(np.int32)
        columns.append(posed[faces.ravel()])
    if moves:
        columns.append(faces.reshape(-1, 1))
    if moves and is_posed:
        columns.append(_octahedral(corner_normals(surface.rest, faces).reshape(-1, 3)))
    if maps is not None:
        columns.append(maps.columns[order].reshape(3 * len(faces), -1))
    has_parts = paints and bool(surface.parts.max() > 0)
    if has_parts:
        columns.append(np.repeat(surface.parts[order], 3)[:, None])
    corners = np.concatenate(columns, axis=1)
    _, first, which = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    by_first_use = np.argsort(first, kind="stable")
    rank = np.empty(first.size, np.int64)
    rank[by_first_use] = np.arange(first.size)
    rows, triangles = corners[first[by_first_use]], rank[which.ravel()]
    source = surface.source
    has_coordinates = isinstance(source, MaterialSource) and bool(source.coordinates)
    steps_back = np.maximum.accumulate(triangles) - triangles
    is_new = np.diff(np.maximum.accumulate(triangles), prepend=-1) > 0
    back = np.where(is_new, 0, steps_back + 1)
    parts = [planes(zigzag(np.diff(rows[:, column], prepend=0))) for column in range(rows.shape[1])]
    header = {
        "vertices": len(rows),
        "triangles": len(faces),
        "bits": bits,
        "posed": is_posed,
        "coordinates": surface.uv is not None or has_coordinates,
        "moves": moves,
        "parts": has_parts,
        "low": low.tolist(),
        "edge": edge,
    }
    return header, b"".join([*parts, planes(back)])


def _octahedral(normals: Array) -> Int32s:
    """Return unit vectors (n, 3) as whole numbers −1023 … 1023 (n, 2) on an unfolded octahedron."""
    vectors = np.asarray(normals, np.float64)
    sums = np.abs(vectors).sum(axis=1, keepdims=True)
    flat: Float64s = vectors / np.where(sums > 0, sums, 1.0)
    signs = np.where(flat[:, :2] < 0, -1.0, 1.0)
    folded = (1 - np.abs(flat[:, 1::-1])) * signs
    return np.asarray(np.rint(np.where(flat[:, 2:] < 0, folded, flat[:, :2]) * 1023), np.int32)
