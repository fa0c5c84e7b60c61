"""Packs animations for a page: bones and morph targets by frame, and their weights on vertices.

One stream; all its parts are planes of bytes:

    bones of vertices      count for each vertex; bone numbers; weights in 2⁻¹⁶
    targets of vertices    count for each vertex; target numbers; offsets x, y, z in the edge's 2⁻ᵇ;
                           if any target turns normals, their offsets in 2⁻ᵇ
    of each animation      each number of its bones (12 each, row by row) and targets: its difference at each
                           frame from the frame before; in 2⁻ᵇ, translations in the edge's 2⁻ᵇ

Bones act on positions relative to the model's middle, for precision far from the origin. Signed numbers are
zigzag coded. Vertices are the surface's; the mesh names them as owners.
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
#: Frame steps, tried in order until a motion fits.
_EVERY = 1, 2, 4


class PackedMotion(NamedTuple):
    """A page's animations: the header's entry and a deflated stream; none if ``header`` is empty."""

    header: dict[str, Any]
    stream: bytes
    notes: list[str]


def packed_motion(motion: Motion, surface: Surface, level: int, room: int | None) -> PackedMotion:
    """Pack animations, with fewer frames if they exceed ``room`` bytes; ``notes`` list what is left out."""
    notes = list(motion.faults)
    start = motion.start_on(surface.vertices, surface.rest)
    if not motion.animations:
        return PackedMotion({}, b"", notes)
    if start is None:
        why = "its pose or rest mesh is another model's" if len(motion.positions) == len(surface.rest) else ""
        return PackedMotion(
            {}, b"", [*notes, f"no animations: {why or 'its vertices are not the file’s own'}"]
        )
    for step in _EVERY:
        header, stream = _packed(motion, step)
        packed = deflated(stream, level)
        if room is None or len(packed) <= room:
            if step > 1:
                notes.append(
                    f"animations: every {step}th frame" if step > 2 else "animations: every second frame"
                )
            return PackedMotion({**header, "start": start, "bytes": len(packed)}, packed, notes)
    return PackedMotion({}, b"", [*notes, f"no animations: they take {len(packed):,} bytes"])


def _packed(motion: Motion, step: int) -> tuple[dict[str, Any], bytes]:
    low, high = motion.positions.min(axis=0), motion.positions.max(axis=0)
    edge, middle = float((high - low).max()) or 1.0, (low + high) / 2
    animations = []
    for each in motion.animations:  # every step-th frame; bones act on positions minus the middle
        bones = each.bones[::step].copy()
        bones[..., 3] += bones[..., :3] @ middle
        animations.append(each._replace(bones=bones, weights=each.weights[::step]))
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
    """Return the bounding boxes of animations, from the boxes of the vertices that each bone moves."""
    vertices = np.repeat(np.arange(len(motion.positions)), np.diff(motion.bones.first))
    reach = np.zeros((len(motion.positions), 3))  # largest offsets by targets
    target_vertices = np.repeat(np.arange(len(motion.positions)), np.diff(motion.targets.first))
    np.add.at(reach, target_vertices, np.abs(motion.targets.shares))
    n_bones = animations[0].bones.shape[1]
    low, high = np.full((n_bones, 3), np.inf), np.full((n_bones, 3), -np.inf)
    np.minimum.at(low, motion.bones.numbers, (motion.positions - reach - middle)[vertices])
    np.maximum.at(high, motion.bones.numbers, (motion.positions + reach - middle)[vertices])
    used = np.isfinite(low[:, 0])
    low, high = low[used], high[used]
    center, half = (low + high) / 2, (high - low) / 2
    boxes = []
    for each in animations:
        bones = each.bones[:, used]
        at = _times(bones[..., :3], center) + bones[..., 3]
        off = _times(np.abs(bones[..., :3]), half)
        boxes.append([(at - off).min(axis=(0, 1)).tolist(), (at + off).max(axis=(0, 1)).tolist()])
    return boxes


def _times(matrices: Float64s, vectors: Array) -> Float64s:
    return np.asarray(np.einsum("fbij,bj->fbi", matrices, vectors))
