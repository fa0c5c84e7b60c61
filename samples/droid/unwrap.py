"""Texture coordinates as they are usually assigned: flat charts by part and direction, packed into maps.

Boxes are projected along the axes; turned and swept parts are rolled off as strips. Charts are packed by
their outlines, at one density (texels a unit) a map.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .solids import Array, Model, Skin

GUTTER = 3  # texels between two charts
CELL = 2  # texels: charts are packed on a grid of this step
# The directions ±x ±y ±z seen from outside: which local axes run right and up in the chart.
RIGHT = np.array([[0, 0, -1], [0, 0, 1], [0, 0, 1], [0, 0, 1], [1, 0, 0], [-1, 0, 0]], float)
UP = np.array([[0, 1, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 1, 0]], float)
FLANKS_FIRST = np.array([1.3, 1.0, 0.9])  # the skull's flanks reach around its rounded edges


class Map(NamedTuple):
    """A texture map's size in texels, and how many of them a unit of the model gets."""

    width: int
    height: int
    density: float


@dataclass(frozen=True)
class Unwrap:
    """Texture coordinates of the triangles' corners (m, 3, 2) in 0…1, v down, and the maps they lie in."""

    uv: Array
    maps: dict[str, Map]


@dataclass(frozen=True)
class Texels:
    """What lies under the n texels of a map that its triangles cover, and under a margin around them."""

    rows: Array  # (n,)
    columns: Array  # (n,)
    covered: Array  # (n,) bool: the texel's centre is in a triangle
    triangle: Array  # (n,)
    points: Array  # (n, 3) on the surface


# ---------------------------------------------------------------------------------------- charts


def lengths(line: Array) -> Array:
    """Return the length of a polyline (k, d) up to each of its points (k,)."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def length_at(line: Array, points: Array) -> Array:
    """Return the length of a polyline (k, d) up to where it is nearest to each point (…, d)."""
    flat, step, upto = points.reshape(-1, line.shape[1]), np.diff(line, axis=0), lengths(line)
    away = flat[:, None] - line[:-1]
    t = np.clip((away * step).sum(-1) / np.maximum((step**2).sum(-1), 1e-30), 0, 1)
    best = ((away - t[..., None] * step) ** 2).sum(-1).argmin(1)
    along = upto[best] + t[np.arange(len(flat)), best] * np.diff(upto)[best]
    return along.reshape(points.shape[:-1])


def unroll(angle: Array) -> Array:
    """Free the angles (n, 3) at triangles' corners from the jump at ±π."""
    angle = angle - 2 * np.pi * np.round((angle - angle[:, :1]) / (2 * np.pi))
    return angle - 2 * np.pi * np.floor((angle.mean(1) + np.pi) / (2 * np.pi) + 1e-9)[:, None]


def chart_turned(skin: Skin, corners: Array, normals: Array) -> tuple[Array, Array]:
    """Unwrap a turned part: chart 0 is the strip around it, the others are its flat ends."""
    assert skin.profile is not None
    outline = np.pad(skin.profile, ((1, 1), (0, 0)), "edge")
    outline[[0, -1], 0] = 0
    x, y, z = np.moveaxis(corners, -1, 0)
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    along = length_at(outline, np.stack([radius, z], -1))
    one, other = angle[:, [1, 2, 0]], angle[:, [2, 0, 1]]  # a corner on the axis lies between the other two
    angle = np.where(radius < 1e-7, one + np.angle(np.exp(1j * (other - one))) / 2, angle)
    st = np.stack([unroll(angle) * skin.radius, along], -1)
    chart = np.zeros(len(corners), np.int64)
    for k, ((r0, z0), (r1, z1)) in enumerate(pairwise(outline)):
        flat = abs(r1 - r0) > 0.4 * max(r0, r1) and abs(z1 - z0) < 0.2 * abs(r1 - r0)
        if flat:
            sign = 1 if r0 > r1 else -1
            low, high = lengths(outline)[k : k + 2] + np.array([-1e-6, 1e-6])
            end = (along >= low).all(1) & (along <= high).all(1) & (sign * normals[:, 2] > 0.8)
            chart[end] = 1 + k
            st[end] = corners[end][..., :2] * [sign, 1]
    return chart, st


def chart_swept(skin: Skin, corners: Array) -> tuple[Array, Array]:
    """Unwrap a tube along a line in the plane x = 0: one strip."""
    assert skin.profile is not None
    line = skin.profile[:, 1:]
    along = length_at(line, corners[..., 1:])
    angle = np.arctan2(corners[..., 0], corners[..., 2] - np.interp(along, lengths(line), line[:, 1]))
    return np.zeros(len(corners), np.int64), np.stack([unroll(angle) * skin.radius, along], -1)


def chart_box(skin: Skin, corners: Array, normals: Array) -> tuple[Array, Array]:
    """Unwrap by six planar projections, each where the normal is nearest to it."""
    weighted = normals * (FLANKS_FIRST if skin.finish == "shell" else 1.0)
    axis = np.abs(weighted).argmax(1)
    chart = 2 * axis + (weighted[np.arange(len(axis)), axis] < 0)
    axes = np.stack([RIGHT[chart], UP[chart]], 1)
    return chart, np.einsum("kci,kji->kcj", corners, axes)


def islands(triangles: Array) -> Array:
    """Say which connected piece each triangle (m, 3) belongs to."""
    corner, t = np.unique(triangles, return_inverse=True)
    t = t.reshape(-1, 3)
    label = np.arange(len(corner))
    while True:
        smaller = label.copy()
        for c in range(3):
            np.minimum.at(smaller, t[:, c], label[t].min(1))
        smaller = smaller[smaller]
        if (smaller == label).all():
            return label[t[:, 0]]
        label = smaller


def charts(model: Model) -> tuple[list[str], Array, Array]:
    """Cut the model into charts: each chart's map, each triangle's chart or −1, and coordinates (m, 3, 2)."""
    st = np.zeros((len(model.triangles), 3, 2))
    chart_of = np.full(len(model.triangles), -1)
    numbers: dict[tuple[str, str, int], int] = {}
    corners, normals = model.corners, model.normals
    for number, skin in enumerate(model.skins):
        mine = np.flatnonzero(model.skin == number)
        if skin.map is None or len(mine) == 0:
            continue
        local, facing = skin.to_local(corners[mine]), skin.turn_local(normals[mine])
        if skin.unwrap == "turned":
            chart, st[mine] = chart_turned(skin, local, facing)
        elif skin.unwrap == "swept":
            chart, st[mine] = chart_swept(skin, local)
        else:
            chart, st[mine] = chart_box(skin, local, facing)
        piece = np.zeros(len(mine), np.int64) if skin.share else islands(model.triangles[mine])
        for p, c in np.unique(np.stack([piece, chart]), axis=1).T:
            end = skin.unwrap == "turned" and c > 0  # parts of one name share their flat ends
            key = (skin.map, skin.share or (skin.name if end else f"{number}.{p}"), int(c))
            chart_of[mine[(piece == p) & (chart == c)]] = numbers.setdefault(key, len(numbers))
    return [name for name, _, _ in numbers], chart_of, st


# ---------------------------------------------------------------------------------------- packing


def sprinkle(corners: Array, spacing: float) -> Array:
    """Return points (n, 2) of a grid, all over triangles (m, 3, 2)."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    steps = np.ceil(longest / spacing).astype(int) + 1
    grid: list[Array] = []
    for n in np.unique(steps):
        i, j = np.nonzero(np.add.outer(np.arange(n + 1), np.arange(n + 1)) <= n)
        w = np.stack([n - i - j, i, j], -1) / n / spacing
        grid += [
            np.unique(np.round(w @ some).astype(np.int64) @ [1, 1 << 20]) for some in corners[steps == n]
        ]
    packed = np.unique(np.concatenate(grid))
    return np.stack([packed & 0xFFFFF, packed >> 20], -1) * spacing


def outline_mask(points: Array) -> Array:
    """Say which cells of edge 1 the points and the gutter around them touch."""
    reach = GUTTER / 2 / CELL
    around = [(reach * (1 + x), reach * (1 + y)) for x in (-1, 1) for y in (-1, 1)]
    cells = np.concatenate([np.floor(points + offset).astype(np.int64) for offset in around])
    mask = np.zeros(cells.max(0)[::-1] + 1, bool)
    mask[cells[:, 1], cells[:, 0]] = True
    return mask


def pack(masks: list[Array], columns: int, rows: int) -> list[tuple[int, int, int]] | None:
    """Place masks, longest first, each at the first free place in any quarter turn: (x, y, turn) in cells."""
    taken = np.zeros((rows, columns), np.float32)
    places = [(0, 0, 0)] * len(masks)
    for i in sorted(range(len(masks)), key=lambda i: -max(masks[i].shape)):
        spectrum = np.fft.rfft2(taken)
        found = []
        for turn in range(4):
            mask = np.rot90(masks[i], turn)
            h, w = mask.shape
            if h > rows or w > columns:
                continue
            overlap = np.fft.irfft2(spectrum * np.conj(np.fft.rfft2(mask, taken.shape)), taken.shape)
            y, x = np.nonzero(overlap[: rows - h + 1, : columns - w + 1] < 0.5)
            if len(y):
                cost = ((x + w) * 4096 + y) if columns > rows else ((y + h) * 4096 + x)
                k = int(cost.argmin())
                found.append((int(cost[k]), int(x[k]), int(y[k]), turn))
        if not found:
            return None
        _, x0, y0, turn = min(found)
        mask = np.rot90(masks[i], turn)
        taken[y0 : y0 + mask.shape[0], x0 : x0 + mask.shape[1]] += mask
        places[i] = x0, y0, turn
    return places


def unwrap(model: Model, maps: dict[str, Map]) -> Unwrap:
    """Pack the charts of the model at the maps' densities, or a little below where they do not fit."""
    names, chart_of, st = charts(model)
    uv, fitted = np.zeros_like(st), {}
    for name, (width, height, density) in maps.items():
        members = [np.flatnonzero(chart_of == chart) for chart, n in enumerate(names) if n == name]
        flat = [st[m] * [1, -1] for m in members]  # rows run down
        flat = [corners - corners.min((0, 1)) for corners in flat]
        places = None
        while places is None:
            masks = [outline_mask(sprinkle(corners * (density / CELL), 0.9)) for corners in flat]
            places = pack(masks, width // CELL, height // CELL)
            density *= 1 if places else 0.99
        fitted[name] = Map(width, height, density)
        for m, corners, mask, (x, y, turn) in zip(members, flat, masks, places, strict=True):
            at = corners * density + GUTTER / 2
            h, w = CELL * np.array(mask.shape)
            for _ in range(turn):  # as np.rot90: the right edge becomes the top
                at = np.stack([at[..., 1], w - at[..., 0]], -1)
                h, w = w, h
            uv[m] = (at + np.array([x, y]) * CELL) / [width, height]
    return Unwrap(uv, fitted)


# ---------------------------------------------------------------------------------------- baking


def spread(owner: Array) -> Array:
    """Let owned texels take unowned neighbours."""
    wide = np.pad(owner, 1, constant_values=-1)
    for y, x in ((0, 1), (2, 1), (1, 0), (1, 2)):
        beside = wide[y : y + owner.shape[0], x : x + owner.shape[1]]
        owner = np.where(owner < 0, beside, owner)
    return owner


def bake(model: Model, unwrapped: Unwrap, name: str, margin: int = 2) -> Texels:
    """Find the surface under every texel of a map, and under a margin of texels around every chart."""
    width, height, _ = unwrapped.maps[name]
    uv = unwrapped.uv * [width, height]
    mine = np.flatnonzero(model.of("map") == name)
    (ax, ay), (bx, by), (cx, cy) = uv.transpose(1, 2, 0)
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    inverse = np.where(area == 0, 0, 1 / np.where(area == 0, 1, area))

    def weights(t: Array | int, x: Array, y: Array) -> Array:
        wb = ((x - ax[t]) * (cy[t] - ay[t]) - (y - ay[t]) * (cx[t] - ax[t])) * inverse[t]
        wc = ((bx[t] - ax[t]) * (y - ay[t]) - (by[t] - ay[t]) * (x - ax[t])) * inverse[t]
        return np.stack([1 - wb - wc, wb, wc])

    owner = np.full((height, width), -1)
    low = np.maximum(np.ceil(uv.min(1) - 0.5), 0).astype(int)
    high = np.minimum(np.floor(uv.max(1) - 0.5) + 1, [width, height]).astype(int)
    for t in mine[area[mine] != 0]:
        (x0, y0), (x1, y1) = low[t], high[t]
        inside = (weights(t, np.arange(x0, x1) + 0.5, np.arange(y0, y1)[:, None] + 0.5) >= -1e-9).all(0)
        owner[y0:y1, x0:x1][inside] = t
    covered = owner >= 0
    for _ in range(margin):
        owner = spread(owner)
    rows, columns = np.nonzero(owner >= 0)
    triangle = owner[rows, columns]
    w = np.clip(weights(triangle, columns + 0.5, rows + 0.5), 0, 1)
    points = np.einsum("kn,nki->ni", w / w.sum(0), model.corners[triangle])
    return Texels(rows, columns, covered[rows, columns], triangle, points)
