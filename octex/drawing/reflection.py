"""Image-based lighting of glTF's GGX materials.

The split sum multiplies the prefiltered light around the mirrored ray by the lobe's reflectance (B. Karis,
"Real Shading in Unreal Engine 4", 2013). Single scattering loses the light that facets scatter repeatedly.
That light is added back from the irradiance, so that white surfaces reflect everything (C. Fdez-Agüera, "A
Multiple-Scattering Microfacet Model for Real-Time Image-Based Lighting", JCGT 2019).
"""

from __future__ import annotations

from functools import cache

import numpy as np

from octex.arrays import Float32s, Float64s, Floats
from octex.cameras.camera import Camera
from octex.drawing.environment import Environment, LightTables, glossy_light, matte_light
from octex.drawing.shaders import Appearance
from octex.jit import inlined, kernel
from octex.source.vectors import unit

#: Reflectance of non-metals along the normal (glTF 2.0, appendix B).
_DIELECTRIC = 0.04
#: Below this reflectance along the normal, which no solid has, reflectance at grazing angles fades too.
_DARKEST = 0.02
_SIZE = 32
_BITS = 12
_SAMPLES = 2**_BITS
#: Normals that face away from the eye are turned until their cosine with the view direction is this.
_GRAZING = 1e-3
#: Start of the tone mapper's compression, and its desaturation.
_COMPRESSED, _DESATURATION = 0.76, 0.15


def reflected(
    environment: Environment,
    camera: Camera,
    points: Floats,
    faces: Floats,
    normals: Floats,
    material: Appearance,
) -> Float32s:
    """Return the light (n, 3) reflected toward a camera; arguments as for ``soft_light.light``."""
    assert material.reflected is not None
    lit = np.empty((len(points), 3), np.float32)
    columns = np.ones((len(points), 9))
    columns[:, :3] = material.reflected
    columns[:, 3] = 0.0
    columns[:, 6:] = _DIELECTRIC if material.specular is None else material.specular
    for number, part in enumerate((material.metallic, material.roughness, material.occlusion), 3):
        if part is not None:
            columns[:, number] = part
    np.clip(columns[:, 3:], 0.0, 1.0, out=columns[:, 3:])
    perspective = camera.projection == "pinhole"
    eye = camera.position if perspective else -camera.world_to_camera[2, :3]
    points, faces, normals = (np.ascontiguousarray(array, np.float64) for array in (points, faces, normals))
    tables = environment.seen_by(camera)
    _reflect(tables, reflectances(), points, faces, normals, columns, eye, perspective, lit)
    return lit


def tone_mapped(light: Floats) -> Float64s:
    """Return tone-mapped linear light (n, 3): light brighter than white is compressed.

    Colours lose 0.04, the reflection of white light by non-metals; dark ones lose less. (Khronos PBR Neutral
    tone mapper, 2024.)
    """
    dark = np.minimum(light.min(axis=1, keepdims=True), 0.08)
    color = light.astype(np.float64) - (dark - 6.25 * dark * dark)
    peak = color.max(axis=1, keepdims=True)
    room = 1.0 - _COMPRESSED
    beyond = np.maximum(peak - _COMPRESSED, 0.0)
    lower = np.where(beyond > 0.0, 1.0 - room * room / (beyond + room), peak)
    saturation = 1.0 / (_DESATURATION * (peak - lower) + 1.0)
    return np.asarray(lower + (color * (lower / np.maximum(peak, 1e-12)) - lower) * saturation)


@cache
def reflectances() -> Float64s:
    """Return A, B of the reflectance A·F₀ + B by cosine and roughness, (32, 32, 2): Smith and Schlick."""
    middles = (np.arange(_SIZE) + 0.5) / _SIZE
    index = np.arange(_SAMPLES, dtype=np.uint64)
    turned = np.zeros(_SAMPLES)
    for bit in range(_BITS):
        turned += (index >> np.uint64(bit) & np.uint64(1)) / 2.0 ** (bit + 1)
    azimuth, height = 2 * np.pi * (index + 0.5) / _SAMPLES, turned + 0.5 / _SAMPLES
    table = np.empty((_SIZE, _SIZE, 2))
    v = np.stack([np.sqrt(1 - middles**2), np.zeros(_SIZE), middles], axis=1)
    for number, roughness in enumerate(middles):
        square = roughness**4
        up = np.sqrt((1 - height) / (1 + (square - 1) * height))
        out = np.sqrt(np.maximum(1 - up**2, 0))
        h = np.stack([out * np.cos(azimuth), out * np.sin(azimuth), up], axis=1)
        toward = v @ h.T  # for each cosine and sample
        mirrored = 2 * toward * up - middles[:, None]
        is_seen = (mirrored > 0) & (toward > 0)
        n_l, n_v = np.maximum(mirrored, 1e-12), middles[:, None]
        shadow = n_l * np.sqrt(n_v**2 * (1 - square) + square) + n_v * np.sqrt(n_l**2 * (1 - square) + square)
        weight = np.where(is_seen, 2 * n_l * toward / (shadow * up), 0.0)
        fresnel = (1 - np.clip(toward, 0, 1)) ** 5
        table[:, number, 0] = (weight * (1 - fresnel)).mean(axis=1)
        table[:, number, 1] = (weight * fresnel).mean(axis=1)
    return table


@inlined
def _reflectance(table: Float64s, cosine: float, roughness: float) -> tuple[float, float]:
    row = min(max(cosine * _SIZE - 0.5, 0.0), _SIZE - 1.0)
    column = min(max(roughness * _SIZE - 0.5, 0.0), _SIZE - 1.0)
    i, j = min(int(row), _SIZE - 2), min(int(column), _SIZE - 2)
    s, t = row - i, column - j
    slope = bias = 0.0
    for corner in range(4):
        weight = (s if corner & 1 else 1.0 - s) * (t if corner & 2 else 1.0 - t)
        slope += weight * table[i + (corner & 1), j + (corner >> 1), 0]
        bias += weight * table[i + (corner & 1), j + (corner >> 1), 1]
    return slope, bias


@kernel
def _reflect(
    tables: LightTables, table: Float64s, points: Float64s, faces: Float64s, normals: Float64s,
    materials: Float64s, eye: Float64s, perspective: bool, lit: Float32s,
) -> None:  # fmt: skip
    for n in range(len(points)):
        vx, vy, vz = eye[0], eye[1], eye[2]
        if perspective:
            vx, vy, vz = vx - points[n, 0], vy - points[n, 1], vz - points[n, 2]
        vx, vy, vz = unit((vx, vy, vz))
        side = 1.0 if faces[n, 0] * vx + faces[n, 1] * vy + faces[n, 2] * vz >= 0.0 else -1.0
        x, y, z = unit((normals[n, 0] * side, normals[n, 1] * side, normals[n, 2] * side))
        cosine = x * vx + y * vy + z * vz
        if cosine < _GRAZING:
            shortfall = _GRAZING - cosine
            x, y, z = unit((x + shortfall * vx, y + shortfall * vy, z + shortfall * vz))
            cosine = max(x * vx + y * vy + z * vz, _GRAZING)
        metallic, roughness = materials[n, 3], materials[n, 4]
        slope, bias = _reflectance(table, cosine, roughness)
        double = 2.0 * cosine
        glossy = glossy_light(tables, roughness, double * x - vx, double * y - vy, double * z - vz)
        matte = matte_light(tables, x, y, z)
        for c in range(3):
            base, first = materials[n, c], materials[n, 6 + c]
            once, again = _scattered(first, slope, bias * min(first / _DARKEST, 1.0))
            metal, metal_again = _scattered(base, slope, bias)
            dielectric = once * glossy[c] + (again + base * (1.0 - once - again)) * matte[c]
            conductor = metal * glossy[c] + metal_again * matte[c]
            lit[n, c] = materials[n, 5] * (dielectric + (conductor - dielectric) * metallic)


@inlined
def _scattered(first: float, slope: float, bias: float) -> tuple[float, float]:
    """Return the parts that scatter once and several times; ``first`` is the reflectance along the normal."""
    once = first * slope + bias
    lost = 1.0 - slope - bias
    average = first + (1.0 - first) / 21.0
    return once, once * average / (1.0 - lost * average) * lost
