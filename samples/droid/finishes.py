"""The paint of every part: colour blocks, lines, rivets, lettering."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .canvas import Canvas, clouds, lettering, nearest_angle, noise, offset, ramp
from .solids import Array

IVORY = np.array([222, 211, 186]) / 255
ORANGE = np.array([211, 88, 30]) / 255
SLATE = np.array([50, 63, 77]) / 255
GUNMETAL = np.array([84, 89, 94]) / 255
STEEL = np.array([150, 153, 154]) / 255
DARK = np.array([33, 35, 39]) / 255
BRASS = np.array([172, 130, 66]) / 255
YELLOW = np.array([228, 172, 38]) / 255
RED = np.array([176, 32, 24]) / 255
WHITE = np.array([238, 235, 226]) / 255


def shell(c: Canvas, k: Array) -> None:
    """Paint the skull: ivory with an orange blaze and chevrons, slate nape, jaw and snout; stencils."""
    x, y, z = c.head[k].T
    nx, ny, _ = c.head_normal[k].T
    flank, above = np.abs(nx) > 0.55, ny > 0.5
    slant = z + 0.445 * y - 0.0689  # 0 in the seam behind the eyes
    jaw = y + 0.022 + 0.0559 * (z - 0.318)  # 0 in the jaw's seam
    cranium = slant < 0
    ear = np.hypot(y - 0.011, z + 0.053)

    c.lay(k, IVORY)
    blaze = np.abs(x) - np.where(cranium, 0.0235, 0.0132 - 0.012 * z)
    on_top = (above | (y > 0.045)) & (z > -0.104)
    c.lay(k, ORANGE, c.soft(blaze) * on_top)
    c.lay(k, SLATE, c.line(blaze - 0.0027, 0.0013) * on_top)
    chevron = cranium * c.soft(y - 0.052)
    c.lay(k, ORANGE, c.line(slant + 0.0165, 0.0125) * chevron)
    c.lay(k, SLATE, c.line(slant + 0.0262, 0.0034) * chevron)
    c.lay(k, SLATE, (z < -0.106) | ((jaw < 0) & ~cranium))
    c.lay(k, YELLOW, c.line(jaw + 0.0056, 0.0016) * ~cranium)
    c.lay(k, SLATE, c.soft(0.284 - z) * (jaw >= 0))
    c.lay(k, ORANGE, c.line(z - 0.2795, 0.0042) * (jaw >= 0))
    shell_seams(c, k, [(z + 0.106, z < 0), (slant / 1.095, z > -0.02), (jaw, ~cranium)])

    flat = cranium & (z > -0.104)
    for distance, where in [
        (z + 0.0065, flat & (flank | above) & (y > 0.043)),
        (y - 0.047, flat & flank & (z < -0.0065)),
        (ear - 0.0468, flat & flank),
        (y + 0.036, flat & (np.abs(nx) > 0.3) & (ear > 0.0468)),
        (slant + 0.034, cranium & flank & (y < 0.047)),
        (z - 0.150, ~cranium & (jaw > 0)),
        (z - 0.245, ~cranium & (jaw < 0)),
        (z - 0.125, ~cranium & (jaw < 0)),
        (np.abs(x) - 0.030, flat & (ny < -0.5)),
    ]:
        c.shade(k, 0.42, c.line(distance, 0.0015) * where)
        c.shade(k, 1.10, c.line(distance + 0.0014, 0.0010) * where)
    for distance, along, where in [
        (slant + 0.0062, y, cranium & flank),
        (slant - 0.0062, y, ~cranium & flank & (jaw > 0.004)),
        (z + 0.1000, np.where(flank, y, x), cranium & (z > -0.106)),
        (jaw - 0.0052, z, ~cranium & flank & (z < 0.275)),
        (y - 0.0508, z, flat & flank & (z < -0.010)),
        (ear - 0.0498, np.arctan2(y - 0.011, z + 0.053) * 0.0498, flat & flank),
    ]:
        c.rivets(k[where], distance[where], offset(along[where], 0.0092), 0.0017)
    for side in (1, -1):
        mine = flank & (nx * side > 0)
        shell_decals(c, k[mine], -side * z[mine], y[mine], side)
    c.print(k[above], x[above], -z[above], lettering("07"), (0.0, -0.170), 0.012, WHITE)


def shell_seams(c: Canvas, k: Array, seams: list[tuple[Array, Array]]) -> None:
    """Paint the gaps between plates: dark, with lips that chip."""
    for distance, where in seams:
        gap = c.line(distance, 0.0028) * where
        c.lay(k, DARK * 0.55, gap)
        c.shade(k, 1.12, c.line(np.abs(distance) - 0.0021, 0.0010) * where)
        lip = 0.62 * ramp(0.0040 - np.abs(distance), 0.0, 0.0022) * (1 - gap) * where
        c.edges[k] = np.maximum(c.edges[k], lip)
        c.bare[k] *= 1 - gap


def shell_decals(c: Canvas, k: Array, u: Array, v: Array, side: int) -> None:
    """Letter one flank of the skull; u runs right as seen from there, forward is −side."""
    for text, ahead, up, height, ink in [
        ("OX", 0.0065, 0.0290, 0.0115, SLATE),
        ("SURVEY", 0.0300, -0.0295, 0.0042, SLATE),
        ("NO STEP", 0.0055, 0.0435, 0.0033, RED),
        ("LIFT  HERE", 0.1050, -0.0300, 0.0036, WHITE),
        ("EXHAUST", 0.2620, -0.0005, 0.0030, RED),
        ("JAW  24 V", 0.1650, -0.0330, 0.0040, WHITE),
    ]:
        c.print(k, u, v, lettering(text), (-side * ahead, up), height, ink)
    c.print(k, u, v, lettering("8", stencil=True), (-side * 0.0145, -0.0035), 0.036, SLATE)
    warning_label(c, k, u - side * 0.0835, v + 0.0310)
    x, y = u + side * 0.128, v - 0.0055  # a calibration target on the cheek
    r = np.hypot(x, y)
    c.lay(k, WHITE, c.soft(r - 0.0082))
    c.lay(k, DARK, c.soft(r - 0.0070) * (x * y > 0))
    c.lay(k, DARK, c.line(r - 0.0076, 0.0010))


def warning_label(c: Canvas, k: Array, x: Array, y: Array) -> None:
    """Stick on a yellow label with a triangle and small print."""
    c.lay(k, DARK, c.soft(np.maximum(np.abs(x) - 0.0160, np.abs(y) - 0.0068)))
    c.lay(k, YELLOW, c.soft(np.maximum(np.abs(x) - 0.0152, np.abs(y) - 0.0060)))
    c.lay(k, DARK, c.soft(np.maximum(-0.0042 - y, np.abs(x + 0.0095) * 0.87 + (y - 0.0046) * 0.5)))
    c.print(k, x, y, lettering("!"), (-0.0095, -0.0010), 0.0056, YELLOW)
    c.print(k, x, y, lettering("CAUTION"), (0.0048, 0.0030), 0.0032, DARK)
    for i in range(3):
        words = ramp(noise(np.column_stack([x, 0 * x + i, 0 * x]), 0.0012, 7), 0.3, 0.5)
        c.lay(k, DARK, c.line(y + 0.0006 + 0.0019 * i, 0.0009) * words * (np.abs(x - 0.0048) < 0.0085))


def crest(c: Canvas, k: Array) -> None:
    """Paint the plate on the crown: orange, chevrons ahead."""
    ahead, left, _ = c.local[k].T
    top = c.facing[k][:, 2] > 0.7
    c.lay(k, ORANGE)
    c.lay(k, WHITE, c.line(np.abs(left) - 0.0088, 0.0014) * top * (ahead < 0.024))
    stripe = np.abs((ahead + np.abs(left)) % 0.012 - 0.006) - 0.0028
    c.lay(k, SLATE, c.soft(stripe) * top * c.soft(0.024 - ahead))
    c.shade(k, 0.45, c.line(np.abs(ahead + 0.044) - 0.022, 0.0015))
    c.rivets(k[top], (np.abs(left) - 0.0125)[top], (np.abs(ahead + 0.027) - 0.0435)[top], 0.0014)
    c.print(k[top], -ahead[top], -left[top], lettering("OCTEX"), (-0.001, 0.0), 0.0085, WHITE)


def brow(c: Canvas, k: Array) -> None:
    """Paint the eyes' shades: orange with white stripes."""
    _, r, z = c.around(k)
    c.lay(k, ORANGE)
    c.lay(k, WHITE, c.line(z - 0.006, 0.0035))
    c.lay(k, WHITE, c.line(z - 0.0115, 0.0014))
    c.lay(k, SLATE, c.soft(0.002 + z))
    c.lay(k, DARK, r < 0.0235)
    c.rivets(k, z - 0.040, np.abs(c.local[k][:, 0]) - 0.012, 0.0015)


def barrel(c: Canvas, k: Array) -> None:
    """Paint the eyes' barrels: a knurled ring, white engraving."""
    angle, r, z = c.around(k)
    c.lay(k, SLATE * 0.8)
    c.lay(k, DARK, c.line(z - 0.007, 0.0060))
    c.shade(k, 1.5, (np.sin(angle * 46) > 0) * c.line(z + 0.004, 0.0090))
    c.lay(k, GUNMETAL, c.soft(0.0283 - z))
    c.lay(k, ORANGE, c.line(z - 0.0235, 0.0020) * (r > 0.022))
    c.lay(k, DARK, c.soft(0.0380 - z) * (r < 0.0262))
    for turn in (-2, 0, 2):
        u = nearest_angle(angle, np.pi / 2 + turn) * r
        for text, at, up, height, ink in [
            ("8.0", -0.0145, 0.0165, 0.0052, WHITE),
            ("5.6", -0.0030, 0.0165, 0.0052, WHITE),
            ("4", 0.0060, 0.0165, 0.0052, ORANGE),
            ("OCTEX  f=35", 0.0, 0.0330, 0.0045, WHITE),
        ]:
            c.print(k, u, z, lettering(text), (at, up), height, ink)
    c.lay(k, WHITE, c.line(offset(angle * r, 0.004), 0.0008) * c.line(z - 0.0120, 0.0020))


def bezel(c: Canvas, k: Array) -> None:
    """Paint the funnel before a lens: grooved brass, dark within."""
    z = c.local[k][:, 2]
    c.lay(k, BRASS)
    c.lay(k, DARK, c.soft(z - 0.0300))
    c.shade(k, 0.6, (np.sin(z * 2 * np.pi / 0.0022) > 0) * c.line(z - 0.0340, 0.0070))


def dial(c: Canvas, k: Array) -> None:
    """Paint the ears: a bearing with degrees on its rim, slate and orange rings, and a hub."""
    angle, r, z = c.around(k)
    rim = (r > 0.031) & (z > 0.0155)
    c.lay(k, GUNMETAL)
    c.lay(k, IVORY, r > 0.0302)
    for degrees, inner, width in ((5, 0.0352, 0.0007), (30, 0.0334, 0.0012)):
        tick = c.line(offset(angle, np.radians(degrees)) * r, width)
        c.lay(k, DARK, tick * c.soft(inner - r) * rim)
    c.lay(k, DARK, c.line(r - 0.0283, 0.0034) * (z < 0.0155))
    c.lay(k, ORANGE, c.line(r - 0.0235, 0.0036))
    c.lay(k, SLATE, c.soft(r - 0.0163))
    c.rivets(k, r - 0.0192, offset(angle, np.pi / 3) * r, 0.0015)
    c.lay(k, STEEL, c.soft(r - 0.0100))
    c.lay(k, ORANGE, c.soft(r - 0.0085) * (z > 0.0325))
    c.shade(k, 0.5, c.line(r - 0.0045, 0.0012) * (z > 0.0325))
    flank = (r > 0.0388) & (z > 0.0085) & (z < 0.0135)
    c.lay(k, SLATE, flank)
    c.shade(k, 0.55, flank & (np.sin(angle * 60) > 0.1) & (z < 0.0130))


def nose(c: Canvas, k: Array) -> None:
    """Paint the nose: steel, a dark well, a red eye."""
    angle, r, z = c.around(k)
    c.lay(k, STEEL * 0.9)
    c.lay(k, DARK, c.soft(r - 0.0098) * (z < 0.0055))
    c.lay(k, RED, c.soft(r - 0.0051))
    c.shade(k, 0.45, (np.sin(angle * 24) > 0) & (r > 0.0145) & (z > -0.004) & (z < 0.003))


def lamp(c: Canvas, k: Array) -> None:
    """Paint the lamp on the crown: red glass in a steel collar."""
    _, r, z = c.around(k)
    glass = c.soft(0.0044 - z) * (r < 0.0092)
    c.lay(k, STEEL * 0.8)
    c.lay(k, RED * 0.75, glass)
    c.lay(k, np.array([0.93, 0.35, 0.22]), glass * ramp(z, 0.006, 0.0135))
    c.bare[k] = 0.2


def fin(c: Canvas, k: Array) -> None:
    """Paint the cooling fins: brushed steel, tempered brown and blue by heat."""
    reach = -c.head[k][:, 2]
    c.lay(k, STEEL * 0.86)
    c.shade(k, 1.14, noise(c.local[k] * [0.12, 1.0, 1.0], 0.0012, 90))
    c.lay(k, np.array([0.32, 0.30, 0.42]), 0.75 * ramp(reach, 0.136, 0.150))
    c.lay(k, np.array([0.55, 0.40, 0.22]), 0.55 * ramp(reach, 0.128, 0.136) * (1 - ramp(reach, 0.138, 0.146)))
    c.bare[k] = 0.4


def vertebra(c: Canvas, k: Array) -> None:
    """Paint the vertebrae: ivory, the first and the last slate, numbered."""
    angle, r, z = c.around(k)
    numbers, order = np.unique(c.skin[k], return_inverse=True)
    outside = r > 0.020
    c.lay(k, IVORY)
    last = (order == 0) | (order == len(numbers) - 1)
    c.lay(k, SLATE, last)
    c.lay(k, ORANGE, c.line(z - 0.0125, 0.0042) * outside)
    c.lay(k, DARK, c.line(z, 0.0072) * outside)
    c.lay(k, GUNMETAL, np.abs(c.facing[k][:, 2]) > 0.8)
    ahead = nearest_angle(angle, -np.pi / 2)
    gap = np.abs(offset(ahead, np.pi / 2)) * r
    c.shade(k, 0.45, c.line(gap - 0.0135, 0.0014) * outside)
    c.rivets(k, np.abs(z) - 0.0118, gap - 0.0110, 0.0014)
    for i in range(len(numbers)):
        ink = IVORY if i in (0, len(numbers) - 1) else SLATE
        mine = order == i
        for text, turn, height in (
            (f"C{i + 1}", 0, 0.0098),
            ("OX-8", -np.pi / 2, 0.0050),
            ("OX-8", np.pi / 2, 0.0050),
        ):
            u = nearest_angle(ahead[mine], turn) * r[mine]
            c.print(k[mine], u, z[mine], lettering(text), (0.0, -0.0105), height, ink)


def spine(c: Canvas, k: Array) -> None:
    """Paint the vertebrae's spines: orange, a slate band."""
    c.lay(k, ORANGE)
    c.lay(k, SLATE, c.line(c.local[k][:, 2], 0.0056))


def hose(c: Canvas, k: Array) -> None:
    """Paint the neck's hose: rubber with ribs."""
    c.lay(k, DARK * 1.15)
    c.shade(k, 0.55, ramp(np.sin(c.points[k][:, 1] * (2 * np.pi / 0.0058)), -0.2, 0.6))
    c.shade(k, 1.5, ramp(clouds(c.points[k], 0.006, 50), 0.55, 0.8))
    c.bare[k] = 0.0


def yoke(c: Canvas, k: Array) -> None:
    """Paint the pivot: gunmetal, steel drums with an orange ring."""
    angle, r, z = c.around(k)
    z = np.abs(z)
    c.lay(k, GUNMETAL)
    c.lay(k, STEEL, c.line(z - 0.026, 0.019) * (r > 0.0215))
    c.lay(k, ORANGE, c.line(z - 0.0235, 0.0030) * (r > 0.0215))
    c.shade(k, 0.5, c.line(z - 0.0330, 0.0012))
    c.shade(k, 0.6, (np.sin(angle * 30) > 0) * c.line(z - 0.0435, 0.0044))


def antenna(c: Canvas, k: Array) -> None:
    """Paint the antennas: dark rods, a striped foot, orange and white bands at the end."""
    angle, r, z = c.around(k)
    c.lay(k, GUNMETAL * 0.62)
    c.lay(k, STEEL, (r > 0.0043) & (z > 0.05))
    foot = c.soft(z - 0.015)
    c.lay(k, YELLOW, foot)
    c.lay(k, DARK, foot * c.line((z + angle * 0.0026) % 0.0082 - 0.0041, 0.0040))
    _, order = np.unique(c.skin[k], return_inverse=True)
    end = np.array([z[order == i].max() for i in range(order.max() + 1)])[order]
    for i in range(5):
        c.lay(k, WHITE if i % 2 else ORANGE, c.line(z - (end - 0.022 - 0.016 * i), 0.016))
    c.lay(k, RED, c.soft(end - 0.0135 - z))


def piston(c: Canvas, k: Array) -> None:
    """Paint the pistons: bright rods, slate sleeves with hazard stripes and lettering."""
    angle, r, z = c.around(k)
    c.lay(k, STEEL * 1.06)
    c.shade(k, 0.8, noise(np.column_stack([angle * 0.004, z * 0.02, r]), 0.0010, 31))
    sleeve, hazard = c.soft(z - 0.2105), c.line(z - 0.165, 0.0240)
    c.lay(k, SLATE, sleeve)
    c.lay(k, YELLOW, hazard)
    c.lay(k, DARK, hazard * c.line((z + angle * 0.0064) % 0.0201 - 0.01005, 0.0100))
    c.lay(k, GUNMETAL, c.line(z - 0.200, 0.0170))
    c.lay(k, ORANGE, c.line(z - 0.045, 0.004) * sleeve)
    for turn in (-np.pi / 2, np.pi / 2):
        v = -nearest_angle(angle, turn) * r
        c.print(k, z, v, lettering("NECK  DRIVE  350 BAR"), (0.100, 0.0), 0.0056, IVORY)
    c.lay(k, GUNMETAL, c.soft(z.max() - 0.040 - z))


def bolt(c: Canvas, k: Array) -> None:
    """Paint bolt heads: steel, a socket."""
    _, r, _ = c.around(k)
    c.lay(k, STEEL * 0.95)
    c.shade(k, 0.4, c.soft(r - 0.0019) * (c.facing[k][:, 2] > 0.7))


def plug(c: Canvas, k: Array) -> None:
    """Paint the cables' plugs: knurled brass."""
    angle, _, z = c.around(k)
    c.lay(k, BRASS)
    c.shade(k, 0.62, (np.sin(angle * 12) > 0) * c.line(z + 0.002, 0.0120))


def flange(c: Canvas, k: Array) -> None:
    """Paint the flange: slate, hazard stripes and name plates around the rim."""
    angle, r, z = c.around(k)
    x, y, _ = c.local[k].T
    facing = c.facing[k][:, 2]
    number = np.round((angle - np.pi / 8) / (np.pi / 4))
    face = number * np.pi / 4 + np.pi / 8
    along, across = y * np.cos(face) - x * np.sin(face), x * np.cos(face) + y * np.sin(face)
    side = (np.abs(facing) < 0.5) & (r > 0.06)
    c.lay(k, GUNMETAL)
    c.lay(k, YELLOW, side)
    c.lay(k, DARK, side * c.line((along + z) % 0.0157 - 0.00785, 0.0078))
    named = side & (number % 2 == 0)
    for color, width, height in ((DARK, 0.023, 0.0062), (IVORY, 0.0222, 0.0054)):
        c.lay(k, color, named * c.soft(np.maximum(np.abs(along) - width, np.abs(z - 0.012) - height)))
    c.print(k[named], along[named], z[named], lettering("OX-8 SURVEY"), (0.0, 0.0120), 0.0048, DARK)
    top = (facing > 0.7) & (z > 0.02)
    c.lay(k, SLATE, top)
    c.shade(k, 0.45, c.line(across - 0.0560, 0.0014) * top)
    c.lay(k, ORANGE, c.line(across - 0.0715, 0.0026) * top)
    c.shade(k, 0.5, c.line(np.hypot(along, across - 0.0640) - 0.0078, 0.0013) * top)
    c.rivets(k[top], (np.abs(along) - 0.0170)[top], (across - 0.0640)[top], 0.0017)


def turret(c: Canvas, k: Array) -> None:
    """Paint the turret: a ring with degrees, an orange band, gunmetal plates."""
    angle, r, z = c.around(k)
    ring = (z < 0.0293) & (r > 0.050)
    c.lay(k, GUNMETAL)
    c.lay(k, IVORY, ring)
    for degrees, height, width in ((5, 0.0018, 0.0007), (15, 0.0030, 0.0011)):
        tick = c.line(offset(angle, np.radians(degrees)) * r, width)
        c.lay(k, DARK, tick * c.soft(z - 0.0222 - height) * ring)
    c.lay(k, IVORY, c.soft(0.0530 - z))
    c.lay(k, SLATE, c.soft(0.0622 - z))
    c.lay(k, STEEL, c.line(r - 0.0290, 0.0030) * (z > 0.062))
    c.lay(k, ORANGE, c.line(z - 0.0575, 0.0040) * (r > 0.03))
    eighth = offset(angle, np.pi / 4) * r
    c.rivets(k, z - 0.0460, eighth, 0.0018)
    c.shade(k, 0.5, c.line(z - 0.0505, 0.0012))
    c.shade(k, 0.5, c.line(np.abs(eighth) - 0.0135 + 0.2 * (z - 0.032), 0.0012) * (z > 0.034) * (z < 0.050))
    for i, text in enumerate("BABA"):
        c.print(k, nearest_angle(angle, i * np.pi / 2) * r, z, lettering(text), (0.0, 0.0415), 0.0060, YELLOW)


_PAINTS = (
    *(shell, crest, brow, barrel, bezel, dial, nose, lamp, fin, vertebra),
    *(spine, hose, yoke, antenna, piston, bolt, plug, flange, turret),
)
FINISHES: dict[str, Callable[[Canvas, Array], None]] = {paint.__name__: paint for paint in _PAINTS}
