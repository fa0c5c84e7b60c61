"""Channels of a texture at the texels of a map, as the images of a material (glTF 2.0, 3.9)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import ALPHA, CHANNELS, NORMAL, encode
from octex.source.corners import Frames
from octex.source.images.pyramid import CLAMP
from octex.source.materials import AlphaMode, Input, Material, Texture
from octex.texture import OctreeTexture

Float32s = npt.NDArray[np.float32]
Float64s = npt.NDArray[np.float64]
Int32s = npt.NDArray[np.int32]

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
    normals = unit(frames.normals.at(triangles, barycentric))
    tangents = frames.tangents.at(triangles, barycentric)
    hands = np.where(frames.tangents.values[frames.tangents.rows[triangles, 0], 3] >= 0.0, 1.0, -1.0)
    along = tangents[:, :3] - np.einsum("nx,nx->n", tangents[:, :3], normals)[:, None] * normals
    along = unit(along)
    across = np.cross(normals, along) * hands[:, None]
    found = np.stack([np.einsum("nx,nx->n", directions, axis) for axis in (along, across, normals)], axis=1)
    lengths = np.linalg.norm(found, axis=1, keepdims=True)
    upright = np.where(lengths > 1e-6, found / np.maximum(lengths, 1e-30), (0.0, 0.0, 1.0))
    return upright.astype(np.float32)


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


def material_of(
    maps: Mapping[str, Float32s], alpha_mode: AlphaMode | None = None, wrap: int = CLAMP
) -> Material:
    """Return a material whose images are maps (height, width, components) of channels, linear light.

    ``alpha_mode`` None: "mask" if hardly any texel is translucent, else "blend". ``wrap`` is how coordinates
    beyond the unit square meet the images.
    """
    inputs: dict[str, Input] = {}
    mode: AlphaMode = "opaque"
    for channels in IMAGES.values():
        given = [name for name in channels if name in maps]
        if not given:
            continue
        height, width, _ = maps[given[0]].shape
        texels = np.full((height, width, 4), 65535, np.uint16)
        texture = Texture(texels, wrap, wrap)
        for name in given:
            values, form = maps[name], CHANNELS[name]
            lanes = (3,) if name == ALPHA.name else tuple(range(3))
            if form.components == 1 and name != ALPHA.name:
                lanes = (channels.index(name),)
            strength = 1.0
            if form.space == "srgb":
                strength = max(1.0, float(values.max(initial=1.0)))
                values = values / np.float32(strength)
            codes = encode(values, "uint8", form.space).astype(np.uint16) * np.uint16(257)
            texels[..., list(lanes)] = codes
            inputs[name] = Input(
                (strength,) * len(lanes) if name != NORMAL.name else (1.0,) * 3, texture, lanes
            )
        if "alpha" in given:
            mode = alpha_mode or _mode_of(maps["alpha"])
    return Material(inputs, mode)


def _mode_of(alpha: Float32s) -> AlphaMode:
    """Return how alpha counts: not at all if it is 1 all over."""
    if float(alpha.min(initial=1.0)) > 254 / 255:
        return "opaque"
    translucent = alpha < 1.0
    between = (alpha > _CLEAR) & (alpha < _SOLID)
    return "mask" if between.sum() <= _MOST_BETWEEN * translucent.sum() else "blend"
