"""Packs a texture and its mesh for a page: levels one after another, small enough to send.

octex.formats.web describes levels and tables.

The mesh is one stream, in this order. Positions: multiples of 2⁻ᵇ of a cube's edge, as differences.
Octahedral normals, as differences. If it moves: the surface's vertices, and in a pose the rest normals. With
maps: image coordinates and colours (``maps``). Triangles: each vertex as its distance from the next new one.
Numbers of more than a byte are planes of bytes, lowest first. ``moves`` describes motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from octex.arrays import Array, Float64s, Int32s
from octex.drawing.environment import Environment
from octex.drawing.hits import rest_normals, smooth_normals
from octex.drawing.reflection import reflectances
from octex.errors import ArgumentError
from octex.formats.streams import deflated, planes, zigzag
from octex.formats.web import packed_levels
from octex.source.materials import MaterialSource
from octex.texture import OctreeTexture, TextureSet
from octex.tree.octree import distinct
from octex.viewer.maps import Maps
from octex.viewer.moves import packed_motion

if TYPE_CHECKING:
    from octex.source.motion import Motion
    from octex.source.surface import Surface

#: The page numbers parts in one byte of each pixel.
MOST_PARTS = 255


class Packed(NamedTuple):
    """Contents of a page or of one part: a header, ready for JSON, and streams by name."""

    header: dict[str, Any]
    streams: dict[str, bytes]

    @property
    def notes(self) -> list[str]:
        """What the page shows differently from its textures."""
        parts = self.header["parts"]
        return [
            f"{part['name']}: {note}" if part["name"] else note for part in parts for note in part["notes"]
        ]


class Part(NamedTuple):
    """A texture and its surface; of a set, one part of the model."""

    name: str
    texture: OctreeTexture
    surface: Surface | None


def parts_of(textures: OctreeTexture | TextureSet, surface: Surface | None) -> list[Part]:
    """Return a texture, or a set's textures, each with its part of the surface.

    Raises ArgumentError for too many parts, and for a surface with other parts than the set.
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
    """Pack a whole page with ``pack``; motion, maps and paint need a page of one part."""
    packed = [pack(each.texture, each.surface, level=level, room=room) for each in parts[1:]]
    first = parts[0]
    more: dict[str, Any] = {"motion": motion, "maps": maps, "paints": paints}
    packed.insert(0, pack(first.texture, first.surface, **more, level=level, room=room))
    headers = [
        {"name": part.name, **packed_part.header} for part, packed_part in zip(parts, packed, strict=True)
    ]
    streams = {
        f"{n}-{name}": stream
        for n, packed_part in enumerate(packed)
        for name, stream in packed_part.streams.items()
    }
    studio, streams["studio"] = _packed_studio()
    return Packed({"title": title, "studio": studio, "parts": headers}, streams)


@cache
def _packed_studio() -> tuple[dict[str, Any], bytes]:
    """Return the header and stream of the studio light of the library's renderings.

    16-bit floats, as differences: the studio's tables, then A and B of the reflectance A·F₀ + B.
    """
    tables, reflectance = Environment.studio().tables, reflectances()
    light = tables.light[:, 0]  # the light is grey
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
    """Pack a texture, its surface, motion and maps; deflate's ``level`` is 1 to 9.

    The header's ``notes`` say where the page differs from lookups. ``motion`` has fewer frames, or is left
    out, where it takes more than ``room`` bytes. A page that ``paints`` gets the surface's parts. Raises
    ArgumentError for a surface that is not the texture's.
    """
    if surface is not None:
        surface = surface.placed_on(texture)
    header, streams = packed_levels(texture, level)
    notes = header["notes"]
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
        header["mesh"], stream = packed_mesh(texture, surface, "motion" in streams, maps, paints)
        streams["mesh"] = deflated(stream, level)
        header["mesh"]["bytes"] = len(streams["mesh"])
    return Packed(header, streams)


def packed_mesh(
    texture: OctreeTexture,
    surface: Surface,
    moves: bool = False,
    maps: Maps | None = None,
    paints: bool = False,
) -> tuple[dict[str, Any], bytes]:
    """Return the description of a mesh's stream, and the stream.

    With ``moves`` it includes vertices' owners, with ``paints`` their parts.
    """
    order = np.arange(len(surface.triangles)) if maps is None else maps.order
    faces = surface.triangles[order]
    is_posed = surface.rest is not surface.vertices
    normals = smooth_normals(surface.posed_frames(), surface.vertices, surface.triangles)[order]
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
        columns.append(_octahedral(rest_normals(surface)[order].reshape(-1, 3)))
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
    """Return unit vectors (n, 3) as integers −1023 … 1023 (n, 2) on an unfolded octahedron."""
    vectors = np.asarray(normals, np.float64)
    sums = np.abs(vectors).sum(axis=1, keepdims=True)
    flat: Float64s = vectors / np.where(sums > 0, sums, 1.0)
    signs = np.where(flat[:, :2] < 0, -1.0, 1.0)
    folded = (1 - np.abs(flat[:, 1::-1])) * signs
    return np.asarray(np.rint(np.where(flat[:, 2:] < 0, folded, flat[:, :2]) * 1023), np.int32)
