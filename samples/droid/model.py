"""The head of a survey droid: a skull with binocular eyes, on a neck of vertebrae and a base to bolt down.

World axes are glTF's: x left, y up, z forward. The base stands at y = 0, the whip antenna ends near y = 1.
Walls and gaps are no narrower than about four thousandths; finer detail is paint.
"""

from __future__ import annotations

import numpy as np
from manifold3d import CrossSection, Manifold

from .solids import (
    Array,
    Assembly,
    Model,
    Profile,
    box,
    inside,
    place,
    prism,
    smooth_curve,
    stack,
    tube,
    union,
)
from .unwrap import Map

SKULL, NECK, BODY, THIN = "skull", "neck", "body", "thin"
MAPS = {  # the sizes in the paper's figure 6
    SKULL: Map(1024, 512, 1614),
    NECK: Map(256, 1024, 1674),
    BODY: Map(256, 1024, 1320),
    THIN: Map(128, 1024, 1212),
}
WORLD = np.eye(3, 4)
HEAD = place((0, 0.520, 0.0), (0, -0.1, 0.995))  # the skull looks slightly down
NECK_FOOT, NECK_TOP = 0.05, 0.505
SIDES = (1, -1)  # left, right

SKULL_CURVE = [  # z, half width, top, bottom, exponent of the superellipse
    (-0.142, 0.024, 0.027, -0.011, 2.4),
    (-0.133, 0.038, 0.046, -0.026, 2.7),
    (-0.108, 0.052, 0.064, -0.040, 3.2),
    (-0.068, 0.059, 0.074, -0.047, 3.8),
    (-0.009, 0.060, 0.077, -0.049, 4.2),
    (0.045, 0.057, 0.073, -0.050, 4.2),
    (0.086, 0.050, 0.060, -0.049, 4.0),
    (0.135, 0.041, 0.039, -0.046, 3.8),
    (0.194, 0.034, 0.023, -0.042, 3.6),
    (0.257, 0.028, 0.009, -0.037, 3.4),
    (0.297, 0.0245, 0.000, -0.0335, 3.2),
    (0.311, 0.019, -0.006, -0.028, 2.8),
]
PLATES = [  # what lies beyond these planes is unwrapped apart; the rest is the cranium
    ("nape", (0, 0, -1), 0.106),
    ("front", (0, 0.407, 0.914), 0.0630),
]


def loft(stations: int, around: int) -> Manifold:
    """Draw superellipses along z: the skull."""
    z = np.linspace(SKULL_CURVE[0][0], SKULL_CURVE[-1][0], stations)
    w, top, bottom, n = smooth_curve(SKULL_CURVE, z).T[:, :, None]
    t = 2 * np.pi * (np.arange(around) + 0.5) / around
    c, s = np.cos(t), np.sin(t)
    x = w * np.sign(c) * np.abs(c) ** (2 / n)
    y = (top + bottom) / 2 + (top - bottom) / 2 * np.sign(s) * np.abs(s) ** (2 / n)
    return stack(np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], -1))


def dome(radius: float, height: float, rise: float, steps: int) -> Profile:
    """Return a quarter ellipse from the rim (radius, height) to the axis."""
    return [(radius * np.cos(t), height + rise * np.sin(t)) for t in np.linspace(0, np.pi / 2, steps)]


def ring(n: int, offset: float = 0.0) -> Array:
    """Return n directions (n, 3) around z."""
    t = 2 * np.pi * (np.arange(n) + offset) / n
    return np.column_stack([np.cos(t), np.sin(t), np.zeros(n)])


def build_skull(a: Assembly) -> None:
    """Add the shell with its gills, the crest, the fins, the lamp and the nose."""
    rest = loft(26, 36).trim_by_plane((0, -1, 0), -0.072)
    plates = []
    for name, normal, offset in PLATES:
        plate, rest = rest.split_by_plane(normal, offset)
        plates.append(a.solid(plate, name, SKULL, "shell", HEAD))
    shell = union([*plates, a.solid(rest, "cranium", SKULL, "shell", HEAD)])
    gill = box((0.025, 0.0068, 0.032), 0.0022)
    for side in SIDES:
        for i in range(5):
            at = (side * 0.036, -0.0005 - 0.0031 * i, 0.178 + 0.0155 * i)
            frame = inside(HEAD, place(at, (side, 0, 0), (0, 0.95, -0.3)))
            shell -= a.solid(gill, "gill", None, "gasket", frame, crease=100)
    a.add(shell)

    crest = [
        (-0.077, 0.016),
        (-0.077, -0.016),
        (0.027, -0.016),
        (0.056, -0.009),
        (0.056, 0.009),
        (0.027, 0.016),
    ]
    frame = inside(HEAD, place((0, 0.0695, 0), (0, 1, 0), (0, 0, 1)))
    a.add(a.solid(prism(crest, 0.020, 0.004), "crest", SKULL, "crest", frame))
    for i in range(4):
        fin = box((0.056 - 0.004 * i, 0.040, 0.0045), 0.001)
        frame = inside(HEAD, place((0, 0.044 - 0.0125 * i, -0.131 - 0.0022 * i), (0, 1, 0.12)))
        a.add(a.solid(fin, "fin", BODY, "fin", frame, share=f"fin {i}"))
    lamp = [
        (0.0115, -0.012),
        (0.0115, 0.002),
        (0.010, 0.004),
        (0.0088, 0.004),
        *dome(0.0088, 0.0046, 0.0088, 5),
    ]
    a.add(
        a.turned(
            lamp, 16, "lamp", BODY, "lamp", inside(HEAD, place((0, 0.080, -0.047), (0, 1, 0), (0, 0, 1)))
        )
    )
    nose = [(0.0150, -0.02), (0.0150, 0.004), (0.0132, 0.006), (0.0105, 0.006), (0.0095, 0.001)]
    nose += [(0.0050, 0.001), (0.0042, 0.005), (0.0, 0.006)]
    frame = inside(HEAD, place((0, -0.0168, 0.3145), (0, -0.06, 1)))
    a.add(a.turned(nose, 20, "nose", BODY, "nose", frame))


def build_eyes(a: Assembly) -> None:
    """Add two barrels, each with a brow, a bezel and a lens deep inside."""
    barrel = [(0.017, -0.055), (0.023, -0.045), (0.023, 0.003), (0.0214, 0.0045), (0.0214, 0.008)]
    barrel += [(0.023, 0.0095), (0.023, 0.026), (0.0252, 0.0285), (0.0252, 0.038), (0.0240, 0.0395)]
    bore = [(0.0, 0.024), (0.0138, 0.0245), (0.0150, 0.0300), (0.0168, 0.0325), (0.0188, 0.040)]
    lens = [(0.0142, 0.020), *dome(0.0142, 0.0242, 0.0080, 7)]
    t = np.radians(np.linspace(20, 150, 12))
    arc = np.column_stack([np.cos(t), np.sin(t)])
    section = np.concatenate([0.0296 * arc, 0.0225 * arc[::-1]])
    for side in SIDES:
        eye = inside(HEAD, place((side * 0.0455, 0.0425, 0.096), (side * 0.24, -0.06, 1)))
        a.add(a.turned(barrel, 26, "barrel", BODY, "barrel", eye))
        a.cut(a.turned(bore, 26, "bezel", BODY, "bezel", eye))
        a.add_after(a.turned(lens, 20, "lens", None, "lens", eye))
        brow = Manifold.extrude(CrossSection([(section * [side, 1])[::side]]), 0.057).translate(
            (0, 0, -0.008)
        )
        a.add(a.solid(brow.trim_by_plane((0, 0.35, -1), -0.038), "brow", SKULL, "brow", eye))


def build_ears(a: Assembly) -> None:
    """Add a dial on either side, with six bolts and a hub that carries an antenna."""
    dial = [(0.040, -0.02), (0.040, 0.0145), (0.0375, 0.017), (0.031, 0.017), (0.030, 0.014), (0.0265, 0.014)]
    dial += [
        (0.0255, 0.019),
        (0.0165, 0.021),
        (0.0135, 0.0185),
        (0.0095, 0.0185),
        (0.0085, 0.034),
        (0, 0.035),
    ]
    for side, length in zip(SIDES, (0.472, 0.165), strict=True):
        ear = inside(HEAD, place((side * 0.047, 0.011, -0.053), (side, 0, 0), (0, 1, 0)))
        a.add(a.turned(dial, 28, "dial", BODY, "dial", ear, share="dial"))
        for radial in ring(6, 0.5):
            frame = inside(ear, place(0.0343 * radial + [0, 0, 0.017], (0, 0, 1), radial))
            a.add(bolt(a, frame, 0.0034, 0.003))
        whip = [(0.0054, -0.009), (0.0062, -0.007), (0.0062, 0.014), (0.0052, 0.016), (0.0052, 0.024)]
        whip += [(0.0060, 0.025), (0.0060, 0.031), (0.0044, 0.034), (0.0038, 0.036)]
        for z in np.arange(0.15, length - 0.08, 0.12):
            whip += [(0.0035, z), (0.0048, z + 0.002), (0.0048, z + 0.012), (0.0033, z + 0.014)]
        whip += [(0.0026, length - 0.015), (0.0046, length - 0.011), (0.0052, length - 0.006)]
        whip += [(0.0036, length - 0.001), (0.0, length)]
        foot = inside(HEAD, place((side * 0.0790, 0.006, -0.053), (side * 0.02, 1, -0.14)))
        a.add(a.turned(whip, 10, "antenna", THIN, "antenna", foot))


def bolt(a: Assembly, frame: Array, radius: float, height: float) -> Manifold:
    """Make a bolt head that stands on the frame's plane z = 0."""
    shape = prism(radius * ring(6)[:, :2], 2 * height)
    return a.solid(shape, "bolt", THIN, "bolt", frame, share=f"bolt {radius}")


def neck_line(t: Array) -> Array:
    """Return points (n, 3) of the neck's S, from the base (t = 0) to the skull (t = 1)."""
    y = NECK_FOOT + (NECK_TOP - NECK_FOOT) * t
    return np.stack([0 * t, y, -0.022 - 0.022 * np.sin(2 * np.pi * (t * 0.92 + 0.04)) + 0.010 * t], -1)


def build_neck(a: Assembly) -> None:
    """Add a hose inside vertebrae, each with a spine behind."""
    line = neck_line(np.linspace(0, 1, 36))
    hose = {"unwrap": "swept", "profile": line, "radius": 0.0165}
    a.add(a.solid(tube(line, 0.0165, 14), "hose", THIN, "hose", WORLD, **hose))
    for i, t in enumerate(np.linspace(0.12, 0.90, 7)):
        ahead, at, behind = neck_line(np.array([t + 0.01, t, t - 0.01]))
        bone = place(at, ahead - behind)
        r, h = 0.0285 - 0.0050 * np.sin(np.pi * i / 6), 0.0205
        half = [(0.013, -h), (r - 0.004, -h), (r, -h + 0.004), (r, -0.0040), (r - 0.0026, -0.0020)]
        whole = half + [(radius, -z) for radius, z in half[::-1]]
        a.add(a.turned(whole, 18, "vertebra", NECK, "vertebra", bone))
        spine = inside(bone, place((0, r + 0.003, 0)))
        a.add(a.solid(box((0.0085, 0.024, 0.024), 0.003), "spine", NECK, "spine", spine, share="spine"))


def build_pistons(a: Assembly) -> None:
    """Add two pistons in front of the neck, from the base to the jaw."""
    for side in SIDES:
        low, high = np.array([side * 0.0207, 0.046, 0.042]), np.array([side * 0.0220, NECK_TOP - 0.02, 0.042])
        end = float(np.linalg.norm(high - low))
        sleeve = [(0.0070, -0.022), (0.0080, 0.0), (0.0080, 0.190), (0.0098, 0.192), (0.0098, 0.208)]
        rod = [
            (0.0060, 0.211),
            (0.0045, 0.211),
            (0.0045, end - 0.03),
            (0.0072, end - 0.027),
            (0.0072, end + 0.01),
        ]
        frame = place(low, high - low)
        a.add(a.turned(sleeve + rod, 14, "piston", THIN, "piston", frame, share="piston"))


def build_cables(a: Assembly) -> None:
    """Add two cables from the base to the nape: plain rubber without a map, with brass plugs."""
    knots = [(0, 0.027, 0.024, -0.040), (0.1, 0.029, 0.070, -0.053), (0.35, 0.044, 0.19, -0.082)]
    knots += [(0.67, 0.037, 0.36, -0.056), (1, 0.027, 0.520, -0.100)]
    plug = [(0.0070, -0.012), (0.0080, -0.010), (0.0080, 0.006), (0.0064, 0.011), (0.0055, 0.016)]
    for side in SIDES:
        line = smooth_curve(knots, np.linspace(0, 1, 22)) * [side, 1, 1]
        a.add(a.solid(tube(line, 0.0046, 10), "cable", None, "cable", WORLD))
        for at, toward in ((line[2], line[3] - line[1]), (line[-3], line[-4] - line[-2])):
            a.add(a.turned(plug, 10, "plug", THIN, "plug", place(at, toward), share="plug"))


def build_yoke(a: Assembly) -> None:
    """Add the pivot under the skull."""
    half = [
        (0.0, -0.051),
        (0.015, -0.050),
        (0.017, -0.047),
        (0.017, -0.040),
        (0.024, -0.038),
        (0.024, -0.014),
    ]
    half += [(0.020, -0.012)]
    drum = half + [(radius, -z) for radius, z in half[::-1]]
    frame = inside(HEAD, place((0, -0.046, -0.004), (1, 0, 0), (0, 1, 0)))
    a.add(a.turned(drum, 24, "yoke", NECK, "yoke", frame))


def build_base(a: Assembly) -> None:
    """Add an octagonal flange with eight bolts, bored from below, and a turret."""
    ground = place((0, 0, -0.008), (0, 1, 0), (np.tan(np.pi / 8), 0, 1))  # a flat side ahead
    octagon = prism(0.082 * ring(8)[:, :2], 0.024, 0.004).translate((0, 0, 0.012))
    rim = np.array([(0.078, 0.0), (0.082, 0.004), (0.082, 0.020), (0.078, 0.024)])
    turned = {"unwrap": "turned", "profile": rim, "radius": 0.080, "crease": 30}
    flange = a.solid(octagon, "flange", BODY, "flange", ground, **turned)
    a.add(flange - a.turned([(0.050, -0.01), (0.046, 0.007)], 32, "bore", None, "gasket", ground))
    turret = [(0.052, 0.022), (0.052, 0.029), (0.049, 0.032), (0.043, 0.032), (0.040, 0.038), (0.035, 0.052)]
    turret += [(0.037, 0.054), (0.037, 0.061), (0.035, 0.063), (0.0, 0.063)]
    a.add(a.turned(turret, 30, "turret", BODY, "turret", ground))
    for radial in ring(8, 0.5):
        frame = inside(ground, place(0.0640 * radial + [0, 0, 0.024], (0, 0, 1), radial))
        a.add(bolt(a, frame, 0.0054, 0.0045))


def build() -> Model:
    """Return the whole part as one watertight surface."""
    a = Assembly()
    build_skull(a)
    build_eyes(a)
    build_ears(a)
    build_neck(a)
    build_pistons(a)
    build_cables(a)
    build_yoke(a)
    build_base(a)
    return a.finish()
