"""Packs a texture and its mesh for a page: levels one after another, small enough to send.

Of levels and tables see octex.formats.web, of the mesh ``mesh``, of how it moves ``moves``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from octex.drawing.environment import Environment
from octex.drawing.reflection import reflectances
from octex.errors import ArgumentError
from octex.formats.streams import deflated, planes, zigzag
from octex.formats.web import packed_levels
from octex.texture import OctreeTexture, TextureSet
from octex.viewer.maps import Maps
from octex.viewer.mesh import packed_mesh
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


class PagePart(NamedTuple):
    """A texture and its surface; of a set, one part of the model."""

    name: str
    texture: OctreeTexture
    surface: Surface | None


def parts_of(textures: OctreeTexture | TextureSet, surface: Surface | None) -> list[PagePart]:
    """Return a texture, or a set's textures, each with its part of the surface.

    Raises ArgumentError for too many parts, and for a surface with other parts than the set.
    """
    if isinstance(textures, OctreeTexture):
        return [PagePart("", textures, surface)]
    if len(textures) > MOST_PARTS:
        raise ArgumentError(
            f"a page shows at most {MOST_PARTS} parts, not {len(textures):,}; choose one of them"
        )
    if surface is None:
        return [PagePart(name, texture, None) for name, texture in textures.items()]
    numbers = surface.parts
    if numbers.max() + 1 != len(textures):
        count = f"{numbers.max() + 1:,} part{'s' if numbers.max() else ''}"
        raise ArgumentError(
            f"{surface.name} has {count}, and the set {len(textures):,}; give the set's model"
        )
    return [
        PagePart(name, texture, surface.part((numbers == number).nonzero()[0]))
        for number, (name, texture) in enumerate(textures.items())
    ]


def packed_page(
    parts: Sequence[PagePart],
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
    options: dict[str, Any] = {"motion": motion, "maps": maps, "paints": paints}
    packed.insert(0, pack(first.texture, first.surface, **options, level=level, room=room))
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
