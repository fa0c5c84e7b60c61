"""Image-based light: a latitude-longitude image, prefiltered for each roughness.

The tables assume that the view direction equals the normal (B. Karis, "Real Shading in Unreal Engine 4",
2013). They sum over all texels instead of sampling, over coarser texels where the lobe is smooth.
"""

from __future__ import annotations

import os
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import PIL.Image

from octex.arrays import Float32s, Float64s, Int64s
from octex.cameras.camera import Camera, as_vector
from octex.channels import decode
from octex.checks import as_number, as_reals
from octex.errors import ArgumentError, ImageError
from octex.jit import inlined, kernel
from octex.source.images.decode import read_image
from octex.source.images.pyramid import resized

#: Width limit of the image: 0.35° a texel.
_WIDEST = 1024
#: Number of roughness steps between the tables; the last but one has roughness 1.
_STEPS = 8
#: Width of each roughness's table; the last table is the irradiance.
_WIDTHS = (256, 128, 128, 64, 64, 64, 64, 64, 64)
#: Divide texels until they are smaller than this part of their distance from the lobe plus its width ...
_SMALL = 0.15
#: ... which counts at most this much.
_WIDEST_LOBE = 0.5
#: Least number of rows of the image's coarsest level.
_ROWS = 4
_STUDIO_WIDTH = 256
#: Squares of longer vectors could overflow.
_LONGEST = 1e150


class LightTables(NamedTuple):
    """An environment in the form that kernels read."""

    light: Float32s  # (texels, 3)   all tables, one after the other, row by row from the top
    shapes: Int64s  # (tables, 3)   first texel, height and width
    axes: Float64s  # (3, 3)   from world directions to the image's


class Environment:
    """Light from far away in every direction; make it with ``of`` or ``studio``.

    ``tables`` are for kernels. If it ``follows`` the camera, the image's middle is behind the camera. If it
    is ``tone_mapped``, renderings compress light brighter than white; otherwise they clip it.
    """

    def __init__(self, tables: LightTables, *, follows: bool = False, tone_mapped: bool = False) -> None:
        self.tables = tables
        self.follows = follows
        self.tone_mapped = tone_mapped

    @classmethod
    def of(
        cls,
        image: str | os.PathLike[str] | PIL.Image.Image | npt.ArrayLike,
        exposure: float = 0.0,
        up: npt.ArrayLike = (0.0, 1.0, 0.0),
    ) -> Environment:
        """Make one of an image file (``.hdr``, ``.exr`` or another), a Pillow image or an array.

        Arrays (height, width, 1 to 4) of floats are linear light, of integers sRGB codes. The image's top is
        ``up``. With +y up its middle is +z, in front of the model, and −x is to the right of it. This is the
        latitude-longitude map of OpenEXR's ImfEnvmap.h. Each stop of ``exposure`` doubles the light. Values
        below 0, from lossy files, become black. Raises ImageError for an unusable image, ArgumentError for an
        exposure beyond ±64 stops and an ``up`` of length 0.
        """
        texels, origin = read_image(image)
        name = "the image" if "array" in origin else next(iter(origin))
        exposure = as_number(exposure, "exposure", -64.0, 64.0)
        height, width = texels.shape[:2]
        if height > width:  # the faces of a cube, one below another
            raise ImageError(
                f"{name} is not an environment map: its {width} × {height} texels are taller than wide; "
                "give a latitude-longitude map, twice as wide as high"
            )
        light = decode(texels[..., :3], "linear" if texels.dtype == np.float32 else "srgb")
        light = light * decode(texels[..., 3:], "data")  # black where it is transparent
        light = _resampled(np.maximum(light, np.float32(0.0))) * 2.0**exposure
        return cls(_tables(light, _axes_of(up)))

    @classmethod
    def studio(cls, exposure: float = 0.0) -> Environment:
        """Return the built-in room: dark walls, a bright floor and ceiling, two lamps and two strips.

        exposure    in stops: 1 doubles the light

        The room is grey, follows the camera and is tone mapped. Materials look about as bright as in
        three.js' RoomEnvironment with its neutral tone mapping. Raises ArgumentError for an exposure beyond
        ±64.
        """
        stops = as_number(exposure, "exposure", -64.0, 64.0)
        tables = _studio()
        brighter = tables._replace(light=tables.light * np.float32(2.0**stops))
        return cls(brighter, follows=True, tone_mapped=True)

    def seen_by(self, camera: Camera) -> LightTables:
        """Return the tables with the axes that hold for this camera."""
        if not isinstance(camera, Camera):
            raise ArgumentError(f"camera must be an octex.Camera, not {camera!r}")
        if not self.follows:
            return self.tables
        return self.tables._replace(
            axes=np.ascontiguousarray(np.diag([1.0, -1.0, -1.0]) @ camera.world_to_camera[:3, :3])
        )

    def radiance(self, directions: npt.ArrayLike, roughness: float) -> Float64s:
        """Return prefiltered light (n, 3) around directions (n, 3) for a roughness."""
        return self._read(directions, as_number(roughness, "roughness", 0.0, 1.0) * _STEPS)

    def irradiance(self, normals: npt.ArrayLike) -> Float64s:
        """Return irradiance over π (n, 3) for normals (n, 3): the light that white matte surfaces reflect."""
        return self._read(normals, -1.0)

    def _read(self, directions: npt.ArrayLike, level: float) -> Float64s:
        vectors = as_reals(directions, "directions", (-1, 3), most=_LONGEST)
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        if not lengths.all():
            raise ArgumentError("directions must have a length")
        unit = np.ascontiguousarray(vectors / lengths, np.float64)
        light = np.empty_like(unit)
        _read_all(self.tables, unit, level, light)
        return light


def as_light(light: Environment | None) -> Environment | None:
    """Return a checked environment or None, or raise ArgumentError."""
    if light is not None and not isinstance(light, Environment):
        raise ArgumentError(f"light must be an octex.Environment, not {light!r}")
    return light


def _axes_of(up: npt.ArrayLike) -> Float64s:
    """Return the smallest rotation that takes ``up`` to +y."""
    x, y, z = as_vector(up, "up")
    if y < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    scale = 1.0 / (1.0 + y)
    return np.array(
        [[1 - x * x * scale, -x, -x * z * scale], [x, y, z], [-x * z * scale, -z, 1 - z * z * scale]]
    )


def _resampled(light: Float32s) -> Float64s:
    """Return an image of powers of two, no less than 4 × 8, by the means over texels' areas."""
    height, width = light.shape[:2]
    wide = 2 ** int(np.clip(np.floor(np.log2(width)), np.log2(2 * _ROWS), np.log2(_WIDEST)))
    high = 2 ** int(np.clip(np.floor(np.log2(height)), np.log2(_ROWS), np.log2(wide)))
    four = np.append(light, np.ones_like(light[..., :1]), axis=2)
    return resized(four, high, wide)[..., :3].astype(np.float64)


@cache
def _studio() -> LightTables:
    """Return the tables of the built-in room; +z is toward the camera, x to its right, y up."""
    directions = _directions(_STUDIO_WIDTH // 2, _STUDIO_WIDTH)
    up = directions[..., 1]
    light = 0.22 + 0.49 * _ramp(up, -0.05, -0.45) + 0.43 * _ramp(up, 0.1, 0.7)
    for centre, across, size, strength in (
        ((-0.62, 0.60, 0.50), (0.30, 0.30), 0.10, 9.3),  # the key lamp
        ((0.45, 0.75, 0.50), (0.16, 0.16), 0.06, 6.5),  # a smaller one above
        ((0.93, 0.20, 0.30), (0.10, 0.55), 0.06, 2.0),  # a strip at the right
        ((-0.45, 0.35, -0.82), (0.12, 0.50), 0.06, 4.6),  # and one behind
    ):
        middle = np.array(centre) / np.linalg.norm(centre)
        right = np.cross((0.0, 1.0, 0.0), middle)
        right /= np.linalg.norm(right)
        ahead = directions @ middle
        u = np.abs(directions @ right) / np.maximum(ahead, 1e-3)
        v = np.abs(directions @ np.cross(middle, right)) / np.maximum(ahead, 1e-3)
        lamp = _ramp(u, across[0] + size, across[0]) * _ramp(v, across[1] + size, across[1]) * (ahead > 0)
        light = light + strength * lamp
    return _tables(np.repeat(light[..., None], 3, axis=2), np.eye(3))


def _ramp(values: Float64s, low: float, high: float) -> Float64s:
    """Return a smooth step from 0 at ``low`` to 1 at ``high``."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def _directions(height: int, width: int) -> Float64s:
    """Return the directions (height, width, 3) of texel centres."""
    latitude = np.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    longitude = np.pi * (1.0 - 2.0 * (np.arange(width) + 0.5) / width)[None]
    rim = np.cos(latitude)
    up = np.broadcast_to(np.sin(latitude), (height, width))
    return np.stack([rim * np.sin(longitude), up, rim * np.cos(longitude)], axis=-1)


def _tables(light: Float64s, axes: Float64s) -> LightTables:
    """Return the tables, one a roughness and one of irradiance, of an image whose sides are powers of two."""
    pyramid, levels = _pyramid(light)
    sizes = [light.shape[:2], *((max(width // 2, 1), width) for width in _WIDTHS)]
    tables = [light.reshape(-1, 3)]
    for number, (height, width) in enumerate(sizes[1:], 1):
        directions = np.ascontiguousarray(_directions(height, width).reshape(-1, 3))
        texels = np.empty_like(directions)
        alpha = (number / _STEPS) ** 2 if number < len(_WIDTHS) else 0.0
        _gather(pyramid, levels, directions, alpha, texels)
        tables.append(texels)
    firsts = np.cumsum([0, *(len(table) for table in tables[:-1])])
    shapes = np.column_stack([firsts, np.array(sizes)]).astype(np.int64)
    return LightTables(np.concatenate(tables).astype(np.float32), shapes, axes)


def _pyramid(light: Float64s) -> tuple[Float64s, Int64s]:
    """Return rows (light, solid angle, direction, radius) of all levels, finest first, and their shapes."""
    rows: list[Float64s] = []
    levels: list[tuple[int, int, int]] = []
    first = 0
    height, width = light.shape[:2]
    ends = np.sin(np.pi * (0.5 - np.arange(height + 1) / height))
    solid = np.broadcast_to(((ends[:-1] - ends[1:]) * 2 * np.pi / width)[:, None], (height, width))
    middle = _directions(height, width)
    least = 1e-3 * light.mean() + 1e-30  # makes directions of dark texels the directions of their centres
    while True:
        height, width = light.shape[:2]
        reach = np.full((height, width), 0.5 * np.hypot(np.pi / height, 2 * np.pi / width))
        columns = light, solid[..., None], middle, reach[..., None]
        rows.append(np.concatenate(columns, axis=2).reshape(-1, 8))
        levels.append((first, height, width))
        first += height * width
        if height == _ROWS or width == 2 * _ROWS:
            return np.concatenate(rows), np.array(levels, np.int64)
        middle = _of_four(middle * ((light.mean(axis=2) + least) * solid)[..., None])
        middle /= np.linalg.norm(middle, axis=2, keepdims=True)
        light, solid = _of_four(light * solid[..., None]), _of_four(solid[..., None])[..., 0]
        light /= solid[..., None]


def _of_four(values: Float64s) -> Float64s:
    """Return the sums of 2 × 2 texels (height, width, k)."""
    height, width, parts = values.shape
    return np.asarray(values.reshape(height // 2, 2, width // 2, 2, parts).sum(axis=(1, 3)))


@kernel
def _gather(pyramid: Float64s, levels: Int64s, directions: Float64s, alpha: float, out: Float64s) -> None:
    """Average light around directions (n, 3) by GGX, or by the cosine if alpha is 0 (Barnes & Hut 1986)."""
    coarsest = len(levels) - 1
    stack = np.empty((256, 2), np.int64)
    lobe = min(2.0 * alpha, _WIDEST_LOBE) if alpha > 0.0 else _WIDEST_LOBE
    for n in range(len(directions)):
        x, y, z = directions[n, 0], directions[n, 1], directions[n, 2]
        red = green = blue = total = 0.0
        for start in range(levels[coarsest, 1] * levels[coarsest, 2]):
            count = 1
            stack[0, 0], stack[0, 1] = coarsest, start
            while count > 0:
                count -= 1
                level, texel = stack[count, 0], stack[count, 1]
                at = levels[level, 0] + texel
                dx, dy, dz = pyramid[at, 4] - x, pyramid[at, 5] - y, pyramid[at, 6] - z
                square = dx * dx + dy * dy + dz * dz
                if level > 0 and pyramid[at, 7] > _SMALL * (np.sqrt(square) + lobe):
                    row, column = texel // levels[level, 2], texel % levels[level, 2]
                    wide = levels[level - 1, 2]
                    for part in range(4):
                        stack[count, 0] = level - 1
                        stack[count, 1] = (2 * row + (part >> 1)) * wide + 2 * column + (part & 1)
                        count += 1
                    continue
                cosine = 1.0 - square / 2.0
                if cosine <= 0.0:
                    continue
                weight = cosine * pyramid[at, 3]
                if alpha > 0.0:
                    # n·h where the view direction is the normal: its square is 1 − square / 4.
                    spread = square / 4.0 + alpha * alpha * (1.0 - square / 4.0)
                    weight /= spread * spread
                red += weight * pyramid[at, 0]
                green += weight * pyramid[at, 1]
                blue += weight * pyramid[at, 2]
                total += weight
        out[n, 0], out[n, 1], out[n, 2] = red / total, green / total, blue / total


@kernel
def _read_all(tables: LightTables, directions: Float64s, level: float, out: Float64s) -> None:
    for n in range(len(directions)):
        x, y, z = directions[n, 0], directions[n, 1], directions[n, 2]
        if level < 0.0:
            red, green, blue = matte_light(tables, x, y, z)
        else:
            red, green, blue = glossy_light(tables, level / _STEPS, x, y, z)
        out[n, 0], out[n, 1], out[n, 2] = red, green, blue  # assigning whole rows compiles 3 s longer


@inlined
def glossy_light(
    tables: LightTables, roughness: float, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """Return prefiltered light around a unit direction for a roughness."""
    level = roughness * _STEPS
    below = min(int(level), _STEPS - 1)
    part = level - below
    a, b, c = _texel(tables, below, x, y, z)
    if part == 0.0:
        return a, b, c
    d, e, f = _texel(tables, below + 1, x, y, z)
    return a + (d - a) * part, b + (e - b) * part, c + (f - c) * part


@inlined
def matte_light(tables: LightTables, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return irradiance over π for a unit normal: the light that a white matte surface reflects."""
    return _texel(tables, _STEPS + 1, x, y, z)


@inlined
def _texel(tables: LightTables, table: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a table's light in a direction, interpolated between four texels."""
    axes, light = tables.axes, tables.light
    right = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
    up = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
    ahead = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
    first, high, wide = tables.shapes[table, 0], tables.shapes[table, 1], tables.shapes[table, 2]
    column = (0.5 - np.arctan2(right, ahead) / (2.0 * np.pi)) * wide - 0.5
    row = (0.5 - np.arcsin(min(max(up, -1.0), 1.0)) / np.pi) * high - 0.5
    row = min(max(row, 0.0), high - 1.0)
    left, top = int(np.floor(column)), int(row)
    across, down = column - left, row - top
    below = min(top + 1, high - 1)
    next_left, left = (left + 1) % wide, left % wide
    red = green = blue = 0.0
    for corner in range(4):
        weight = (across if corner & 1 else 1.0 - across) * (down if corner & 2 else 1.0 - down)
        at = first + (below if corner & 2 else top) * wide + (next_left if corner & 1 else left)
        red += weight * light[at, 0]
        green += weight * light[at, 1]
        blue += weight * light[at, 2]
    return red, green, blue
