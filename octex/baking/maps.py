"""Channels of a texture at the texels of a map, as the images of a material (glTF 2.0, 3.9)."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.channels import ALPHA, CHANNELS, ColorSpace, encode
from octex.jit import inlined, kernel
from octex.parallel import ordered_map
from octex.source.corners import Frames
from octex.source.images.pyramid import Texels
from octex.source.materials import AlphaMode, Input, Material, Texture
from octex.texture import OctreeTexture

#: The images of a material, by the channel that names each: the channels in red, green and blue, and alpha.
IMAGES = {
    "base_color": ("base_color", "alpha"),
    "roughness": ("occlusion", "roughness", "metallic"),
    "emissive": ("emissive",),
    "specular": ("specular",),
    "normal": ("normal",),
}
#: Alpha that is hardly anywhere between these is a mask.
_CLEAR, _SOLID, _MOST_BETWEEN = 0.05, 0.95, 0.1
#: Directions shorter than this point nowhere; squared.
_NOWHERE = 1e-12


class Points(NamedTuple):
    """Points of a surface that texels show."""

    rest: Float64s  # (n, 3)
    dPdx: Float64s  # (n, 3)   how rest positions change to the texel at the right
    dPdy: Float64s  # (n, 3)   and to the one below
    normals: Float64s  # (n, 3)   of the triangles at rest


def sampled(texture: OctreeTexture, names: list[str], points: Points) -> dict[str, Float32s]:
    """Return channels (n, components) at points, averaged over their texels; linear light."""
    found = texture.sample(
        points.rest, names, dPdx=points.dPdx, dPdy=points.dPdy, normals=points.normals, threads=1
    )
    return dict(found)


def in_tangent_space(
    directions: Float32s, frames: Frames, triangles: Int32s, barycentric: Float64s
) -> Float32s:
    """Return directions at rest (n, 3) in the frames of points of triangles (n,), of length 1.

    x is along the tangent, y along the bitangent, z along the normal (MikkTSpace's conventions).
    """
    found = np.empty((triangles.size, 3), np.float32)
    _turn_in(directions, *frames.normals, *frames.tangents, triangles, barycentric, found)
    return found


@inlined
def _between(
    values: Float32s, rows: Int32s, triangle: int, p: float, q: float, r: float
) -> tuple[float, float, float]:
    a, b, c = rows[triangle, 0], rows[triangle, 1], rows[triangle, 2]
    return (
        p * values[a, 0] + q * values[b, 0] + r * values[c, 0],
        p * values[a, 1] + q * values[b, 1] + r * values[c, 1],
        p * values[a, 2] + q * values[b, 2] + r * values[c, 2],
    )


@inlined
def _of_length_1(x: float, y: float, z: float) -> tuple[float, float, float]:
    length = np.sqrt(x * x + y * y + z * z)
    scale = 1.0 / length if length > 0.0 else 0.0
    return x * scale, y * scale, z * scale


@kernel
def _turn_in(
    directions: Float32s, normals: Float32s, normal_rows: Int32s, tangents: Float32s, tangent_rows: Int32s,
    triangles: Int32s, barycentric: Float64s, found: Float32s,
) -> None:  # fmt: skip
    for n in range(triangles.size):
        triangle = int(triangles[n])
        p, q, r = barycentric[n, 0], barycentric[n, 1], barycentric[n, 2]
        nx, ny, nz = _between(normals, normal_rows, triangle, p, q, r)
        nx, ny, nz = _of_length_1(nx, ny, nz)
        tx, ty, tz = _between(tangents, tangent_rows, triangle, p, q, r)
        along = nx * tx + ny * ty + nz * tz
        tx, ty, tz = _of_length_1(tx - along * nx, ty - along * ny, tz - along * nz)
        hand = 1.0 if tangents[tangent_rows[triangle, 0], 3] >= 0.0 else -1.0
        bx, by, bz = hand * (ny * tz - nz * ty), hand * (nz * tx - nx * tz), hand * (nx * ty - ny * tx)
        dx, dy, dz = float(directions[n, 0]), float(directions[n, 1]), float(directions[n, 2])
        x, y, z = dx * tx + dy * ty + dz * tz, dx * bx + dy * by + dz * bz, dx * nx + dy * ny + dz * nz
        if x * x + y * y + z * z < _NOWHERE:
            x, y, z = 0.0, 0.0, 1.0
        found[n, 0], found[n, 1], found[n, 2] = _of_length_1(x, y, z)


def turned(directions: Float32s, before: Float64s, after: Float64s) -> Float32s:
    """Return directions (n, 3), turned as unit vectors ``before`` (n, 3) turn straight to ``after``."""
    cosines = np.einsum("nx,nx->n", before, after)[:, None]
    axes = np.cross(before, after)
    along = np.einsum("nx,nx->n", axes, directions)[:, None]
    made = directions * cosines + np.cross(axes, directions) + axes * along / np.maximum(1.0 + cosines, 1e-6)
    return np.asarray(made, np.float32)


def unit(vectors: Float64s) -> Float64s:
    """Return vectors (n, 3) of length 1; zeros stay."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(lengths > 0, lengths, 1.0), np.float64)


def material_of(maps: Mapping[str, Float32s], wrap: int, executor: Executor) -> Material:
    """Return a material whose images are maps (height, width, components) of channels, linear light.

    Alpha is a mask if hardly any texel is translucent. ``wrap`` is how coordinates beyond the unit square
    meet the images.
    """
    inputs: dict[str, Input] = {}
    encoding: list[tuple[Texels, Float32s, ColorSpace]] = []
    for channels in IMAGES.values():
        given = [name for name in channels if name in maps]
        if not given:
            continue
        texels = np.full((*maps[given[0]].shape[:2], 4), 65535, np.uint16)
        for name in given:
            form = CHANNELS[name]
            lane = 3 if name == ALPHA.name else channels.index(name)
            strength = max(1.0, float(maps[name].max(initial=1.0))) if form.space == "srgb" else 1.0
            encoding.append((texels[..., lane : lane + form.components], maps[name] / strength, form.space))
            lanes = tuple(range(lane, lane + form.components))
            inputs[name] = Input((strength,) * form.components, Texture(texels, wrap, wrap), lanes)
    list(ordered_map(executor, lambda each: _encode(*each), encoding))
    return Material(inputs, _mode_of(maps[ALPHA.name]) if ALPHA.name in maps else "opaque")


def _encode(texels: Texels, values: Float32s, space: ColorSpace) -> None:
    """Write values to lanes of texels, as codes of 8 bits."""
    np.multiply(encode(values, "uint8", space), np.uint16(257), out=texels, casting="unsafe")


def _mode_of(alpha: Float32s) -> AlphaMode:
    """Return how alpha counts: not at all if it is 1 all over."""
    if float(alpha.min(initial=1.0)) > 254 / 255:
        return "opaque"
    translucent = alpha < 1.0
    between = (alpha > _CLEAR) & (alpha < _SOLID)
    return "mask" if between.sum() <= _MOST_BETWEEN * translucent.sum() else "blend"
