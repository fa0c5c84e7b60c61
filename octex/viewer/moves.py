"""Animations as the page takes them: bones and targets at frames, and what of the vertices they move.

One stream, of which all parts are planes of bytes:

    bones of vertices      how many of each vertex; their numbers; their shares, of 2¹⁶
    targets of vertices    how many of each vertex; their numbers; what they add, x, y, z, of the edge's 2ᵇ;
                           if any turns normals, what they add to these, of 2ᵇ
    of each animation      number by number of its bones (12 each, row after row) and targets: this at each
                           frame, less what it was at the one before; of 2ᵇ, translations of the edge's 2ᵇ

Bones take positions from the middle of the model, so that they are exact on it wherever it stands. Numbers
that can be negative are zigzag. Vertices are the surface's, which the mesh's name as their owners.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Array, Float64s
from octex.formats.streams import deflated, planes, zigzag
from octex.source.motion import Animation, Motion
from octex.source.surface import Surface

_BITS, _SHARE_BITS, _MOST_BITS = 18, 16, 30
#: Every how many frames are left out, one after the other, until a motion is small enough.
_EVERY = 1, 2, 4


class PackedMotion(NamedTuple):
    """What the page plays: for the header, and a stream of deflate; none where ``header`` is empty."""

    header: dict[str, Any]
    stream: bytes
    notes: list[str]


def packed_motion(motion: Motion, surface: Surface, level: int, room: int | None) -> PackedMotion:
    """Pack animations, with fewer frames beyond ``room`` bytes; ``notes`` say what is left out."""
    notes = list(motion.faults)
    start = motion.start_on(surface.vertices, surface.rest)
    if not motion.animations:
        return PackedMotion({}, b"", notes)
    if start is None:
        why = "it stands or rests as another model does" if len(motion.positions) == len(surface.rest) else ""
        return PackedMotion(
            {}, b"", [*notes, f"no animations: {why or 'its vertices are not the file’s own'}"]
        )
    for every in _EVERY:
        header, stream = _packed(motion, every)
        packed = deflated(stream, level)
        if room is None or len(packed) <= room:
            if every > 1:
                notes.append(
                    f"animations: every {every}th frame" if every > 2 else "animations: every second frame"
                )
            return PackedMotion({**header, "start": start, "bytes": len(packed)}, packed, notes)
    return PackedMotion({}, b"", [*notes, f"no animations: they take {len(packed):,} bytes"])


def _packed(motion: Motion, every: int) -> tuple[dict[str, Any], bytes]:
    low, high = motion.positions.min(axis=0), motion.positions.max(axis=0)
    edge, middle = float((high - low).max()) or 1.0, (low + high) / 2
    animations = []
    for each in motion.animations:  # every so many frames; bones take positions less the middle
        bones = each.bones[::every].copy()
        bones[..., 3] += bones[..., :3] @ middle
        animations.append(each._replace(bones=bones, weights=each.weights[::every]))
    largest = max(
        1.0,
        *(float(np.abs(each.bones[..., :3]).max()) for each in animations),
        *(float(np.abs(each.bones[..., 3]).max()) / edge for each in animations),
        *(float(np.abs(each.weights).max(initial=0.0)) for each in animations),
    )
    bits = min(_BITS, _MOST_BITS - math.ceil(math.log2(largest)))
    scale = float(1 << bits)
    shares = np.rint(motion.bones.shares * (1 << _SHARE_BITS))
    parts = [planes(np.diff(motion.bones.first)), planes(motion.bones.numbers), planes(shares)]
    parts += [planes(np.diff(motion.targets.first)), planes(motion.targets.numbers)]
    added = np.rint(motion.targets.shares / edge * scale)
    parts += [planes(zigzag(added[:, axis])) for axis in range(3)]
    turns = np.rint(motion.turns * scale)
    if turns.any():
        parts += [planes(zigzag(turns[:, axis])) for axis in range(3)]
    units = np.array([1.0, 1.0, 1.0, 1.0 / edge]) * scale
    for each in animations:
        bones = (each.bones * units).reshape(len(each.bones), -1)
        series = np.rint(np.concatenate([bones, each.weights * scale], axis=1)).astype(np.int64)
        parts.append(planes(zigzag(np.diff(series, axis=0, prepend=0).T.ravel())))
    header = {
        "bits": bits,
        "edge": edge,
        "middle": middle.tolist(),
        "vertices": len(motion.positions),
        "entries": [motion.bones.numbers.size, motion.targets.numbers.size],
        "bones": animations[0].bones.shape[1],
        "targets": animations[0].weights.shape[1],
        "turns": bool(turns.any()),
        "animations": [
            {"name": each.name, "length": each.length, "frames": len(each.bones), "bounds": bounds}
            for each, bounds in zip(animations, _bounds(motion, animations, middle), strict=True)
        ],
    }
    return header, b"".join(parts)


def _bounds(motion: Motion, animations: list[Animation], middle: Float64s) -> list[list[list[float]]]:
    """Return the corners of boxes that animations stay in, by the boxes of what each bone moves."""
    vertices = np.repeat(np.arange(len(motion.positions)), np.diff(motion.bones.first))
    reach = np.zeros((len(motion.positions), 3))  # how far targets go
    moved = np.repeat(np.arange(len(motion.positions)), np.diff(motion.targets.first))
    np.add.at(reach, moved, np.abs(motion.targets.shares))
    n_bones = animations[0].bones.shape[1]
    low, high = np.full((n_bones, 3), np.inf), np.full((n_bones, 3), -np.inf)
    np.minimum.at(low, motion.bones.numbers, (motion.positions - reach - middle)[vertices])
    np.maximum.at(high, motion.bones.numbers, (motion.positions + reach - middle)[vertices])
    used = np.isfinite(low[:, 0])
    low, high = low[used], high[used]
    center, half = (low + high) / 2, (high - low) / 2
    found = []
    for each in animations:
        bones = each.bones[:, used]
        at = _times(bones[..., :3], center) + bones[..., 3]
        off = _times(np.abs(bones[..., :3]), half)
        found.append([(at - off).min(axis=(0, 1)).tolist(), (at + off).max(axis=(0, 1)).tolist()])
    return found


def _times(matrices: Float64s, vectors: Array) -> Float64s:
    return np.asarray(np.einsum("fbij,bj->fbi", matrices, vectors))
