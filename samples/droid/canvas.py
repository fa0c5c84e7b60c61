"""A map to paint on: every texel knows the surface point under it, so that charts' borders do not show.

Colours are sRGB codes as fractions of 1, as a painter picks them; lengths are model units.
"""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw, ImageFilter, ImageFont

from .model import HEAD
from .solids import Array, Model
from .unwrap import Unwrap, bake


def lattice() -> Array:
    """Hash 64³ places to fractions of 1, the same on every machine."""
    h = np.arange(64**3, dtype=np.uint32) * np.uint32(374761393)
    for shift, factor in ((15, 2246822519), (13, 3266489917), (16, 668265263)):
        h ^= h >> np.uint32(shift)
        h *= np.uint32(factor)
    return ((h ^ (h >> np.uint32(15))) >> np.uint32(8)).astype(np.float32) / np.float32(2**24)


LATTICE = lattice()


def noise(points: Array, size: float, seed: int) -> Array:
    """Return value noise (n,) in 0…1 with features of a size."""
    place = (points / size + seed * np.array([7.3, 3.1, 5.7])).astype(np.float32)
    blocks = np.array_split(place, len(place) // 16384 + 1)  # a block's intermediates stay in the cache
    return np.concatenate([_noise(np.ascontiguousarray(block.T)) for block in blocks])


def _noise(p: Array) -> Array:
    cell = np.floor(p)
    f = p - cell
    x, y, z = f * f * (3 - 2 * f)
    low = cell.astype(np.int32) & 63
    shift = np.array([[12], [6], [0]], np.int32)
    (i, j, k), (i1, j1, k1) = low << shift, ((low + 1) & 63) << shift

    def along_z(column: Array) -> Array:
        a = LATTICE[column + k]
        return a + z * (LATTICE[column + k1] - a)

    a, b = along_z(i + j), along_z(i1 + j)
    a += y * (along_z(i + j1) - a)
    b += y * (along_z(i1 + j1) - b)
    return a + x * (b - a)


def clouds(points: Array, size: float, seed: int, octaves: int = 4) -> Array:
    """Return octaves of noise (n,) in 0…1, each half as large and as strong as the one before."""
    total = sum(noise(points, size / 2**i, seed + i) / 2**i for i in range(octaves))
    return total / (2 - 2 ** (1 - octaves))


def ramp(x: Array, low: float, high: float) -> Array:
    """Rise smoothly from 0 below ``low`` to 1 above ``high``."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def nearest_angle(angle: Array, to: float) -> Array:
    """Return angles from ``to``, in −π…π."""
    return np.angle(np.exp(1j * (angle - to)))


def offset(x: Array, every: float) -> Array:
    """Return how far numbers are from the nearest multiple."""
    return x - every * np.round(x / every)


def lettering(text: str, stencil: bool = False) -> Image.Image:
    """Draw white text on black; a stencil has a bridge down its middle."""
    font = ImageFont.load_default(96)
    advance = [font.getlength(letter) + 9 for letter in text]
    image = Image.new("L", (int(sum(advance)), 110))
    draw = ImageDraw.Draw(image)
    for letter, x in zip(text, np.cumsum([4, *advance]), strict=False):
        draw.text((float(x), 0), letter, 255, font, stroke_width=4)
    image = image.crop(image.getbbox())
    if stencil:
        draw = ImageDraw.Draw(image)
        draw.rectangle((image.width / 2 - 4, 0, image.width / 2 + 4, image.height), 0)
    return image


class Canvas:
    """The n texels of one map: where they are, and what is painted on them.

    points, normals (n, 3)      on the surface; local, facing: in the frame of the texel's part;
                                head, head_normal: in the frame of the skull
    color (n, 3)                paint
    relief, bare (n,)           what darkens or lightens it; how readily metal shows through
    edges, creases (n,)         how near a convex and a concave edge is, 0…1
    """

    def __init__(self, model: Model, unwrapped: Unwrap, name: str) -> None:
        self.size = unwrapped.maps[name]
        self.texels = bake(model, unwrapped, name)
        self.points = self.texels.points
        self.normals = model.normals[self.texels.triangle]
        self.skin = model.skin[self.texels.triangle]
        self.finish = model.of("finish")[self.texels.triangle]
        n = len(self.points)
        self.color, self.relief, self.bare = np.ones((n, 3)), np.ones(n), np.ones(n)
        self.local, self.facing = np.zeros((n, 3)), np.zeros((n, 3))
        for number in np.unique(self.skin):
            mine, skin = self.skin == number, model.skins[number]
            self.local[mine] = skin.to_local(self.points[mine])
            self.facing[mine] = skin.turn_local(self.normals[mine])
        self.head = (self.points - HEAD[:, 3]) @ HEAD[:, :3]
        self.head_normal = self.normals @ HEAD[:, :3]
        self.edges, self.creases = self._draw_edges(model, unwrapped.uv, model.of("map") == name)

    def around(self, k: Array) -> tuple[Array, Array, Array]:
        """Return the angle, radius and height of texels of turned parts."""
        x, y, z = self.local[k].T
        return np.arctan2(y, x), np.hypot(x, y), z

    def soft(self, distance: Array) -> Array:
        """Return 1 where a signed distance is negative, 0 elsewhere, with an edge one texel soft."""
        return np.clip(0.5 - distance * self.size.density, 0, 1)

    def line(self, distance: Array, width: float) -> Array:
        """Return 1 on a line, with edges one texel soft."""
        return self.soft(np.abs(distance) - width / 2)

    def lay(self, k: Array, color: Array, amount: Array | float = 1.0) -> None:
        """Paint over the texels k."""
        self.color[k] += np.broadcast_to(amount, len(k))[:, None] * (color - self.color[k])

    def shade(self, k: Array, factor: float, amount: Array | float = 1.0) -> None:
        """Darken or lighten whatever is there."""
        self.relief[k] *= 1 + (factor - 1) * amount

    def print(
        self,
        k: Array,
        u: Array,
        v: Array,
        image: Image.Image,
        at: tuple[float, float],
        height: float,
        ink: Array,
    ) -> None:
        """Print an image, centred at ``at``, on texels with plane coordinates u (right) and v (up)."""
        scale = image.height / height
        blur = (max(scale / self.size.density, 1) - 1) / 2
        amount = np.asarray(image.filter(ImageFilter.BoxBlur(blur)), np.float32) / 255
        x = (u - at[0]) * scale + image.width / 2
        y = (at[1] - v) * scale + image.height / 2
        hit = (x >= 0) & (x < image.width) & (y >= 0) & (y < image.height)
        self.lay(k[hit], ink, amount[y[hit].astype(int), x[hit].astype(int)])

    def rivets(self, k: Array, u: Array, v: Array, radius: float) -> None:
        """Paint round heads: u, v are measured from the nearest one's centre."""
        self.shade(k, 0.62, self.line(np.hypot(u, v) - radius, 0.0011))
        self.shade(k, 1.16, self.soft(np.hypot(u + 0.3 * radius, v - 0.4 * radius) - 0.45 * radius))

    def _draw_edges(self, model: Model, uv: Array, mine: Array) -> tuple[Array, Array]:
        t = model.triangles
        ends = np.sort(np.stack([t, np.roll(t, -1, axis=1)], -1).reshape(-1, 2), axis=1)
        one, other = np.lexsort(ends.T).reshape(-1, 2).T  # a watertight surface has every edge twice
        a, b = one // 3, other // 3
        normals, middle = model.normals, model.corners.mean(1)
        sharp = (normals[a] * normals[b]).sum(1) < np.cos(np.radians(36))
        convex = ((middle[b] - middle[a]) * normals[a]).sum(1) < 0
        drawn = []
        for kind, spread in ((convex, 1.3), (~convex, 2.6)):
            image = Image.new("L", self.size[:2])
            draw = ImageDraw.Draw(image)
            for half in np.concatenate([one[sharp & kind], other[sharp & kind]]):
                triangle, corner = divmod(int(half), 3)
                if mine[triangle]:
                    draw.line(
                        (uv[triangle][[corner, (corner + 1) % 3]] * self.size[:2]).ravel().tolist(), 255, 2
                    )
            blurred = np.asarray(image.filter(ImageFilter.GaussianBlur(spread)), np.float32) / 255
            drawn.append(np.clip(1.6 * blurred, 0, 1)[self.texels.rows, self.texels.columns])
        return drawn[0], drawn[1]
