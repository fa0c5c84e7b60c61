"""Adaptive conversions of random surfaces and sources: they keep what ``max_error`` promises."""

import numpy as np

import octex
from octex.channels import ALPHA, linear_to_srgb
from tests.make.painted import halved_quads
from tests.make.small_surfaces import turned

#: By how many codes more than ``max_error`` and what the full tree is off a texture may be off its source.
SLACK = 2.0
POINTS = 6000


def check(seed):
    """Raise AssertionError if an adaptive texture is farther off its source than it may be."""
    random = np.random.default_rng(seed)
    surface, depth = _surface(random), int(random.integers(4, 7))
    options = {"fit": bool(random.random() < 0.85)}
    if random.random() < 0.15:
        half = float(np.median(surface.vertices[:, 0]))
        options["detail"] = lambda points: np.where(points[:, 0] < half, depth - 1, depth)
    most = float(random.choice([0.0, 0.5, 1.0, 2.0, 2.0, 2.0, 4.0, 8.0]))
    full = octex.convert(surface, depth, **options)
    texture = octex.convert(surface, depth, max_error=most, **options)
    texture.validate()
    points = surface.scatter(POINTS, seed)
    names = list(full.channels)
    for normals in (None, points.normals):
        wanted, found = (each.sample(points.rest, names, normals=normals) for each in (full, texture))
        covered = wanted[ALPHA.name] if ALPHA.name in names else np.ones((POINTS, 1))
        for name in names:
            space = full.channels[name].format.space
            given, before, after = (
                _codes(values, space)
                for values in (surface.evaluate(points, name), wanted[name], found[name])
            )
            beyond = np.abs(after - given) - np.abs(before - given)
            beyond = (beyond * (covered if name != ALPHA.name else 1.0)).max(axis=1)
            worst = int(beyond.argmax())
            assert beyond[worst] <= most + SLACK, (
                f"seed {seed}: {name} {'without' if normals is None else 'with'} normals is "
                f"{beyond[worst]:.2f} codes farther off than the full tree at {points.rest[worst].tolist()}; "
                f"max_error {most:g}, depth {depth}, {options}"
            )


def _codes(values, space):
    """Values on the scale of 8-bit codes: light on sRGB's curve, a logarithm from 1 on."""
    values = values.astype(np.float64)
    if space in ("srgb", "linear"):
        slope = 1.055 / 2.4
        light = linear_to_srgb(np.clip(values, 0.0, 1.0)) + slope * np.log(np.maximum(values, 1.0))
        return np.asarray(255 * light)
    return values * (127.5 if space == "direction" else 255.0)


def _surface(random):
    shape = random.choice(["sphere", "box", "sheet", "wave"])
    if shape == "sphere":
        vertices, triangles, uv = _ball(int(random.integers(6, 24)))
    elif shape == "box":
        vertices, triangles, uv = _box(random.uniform(0.1, 1, 3))
    elif shape == "sheet":
        vertices, triangles, uv = _sheet(float(random.choice([0.005, 0.02, 0.05, 0.2])), 0.0)
    else:
        vertices, triangles, uv = _sheet(float(random.choice([0.01, 0.04, 0.1])), random.uniform(0.05, 0.3))
    turn = turned(int(random.integers(0, 1 << 16)) if random.random() < 0.7 else 0)
    surface = octex.Surface.from_arrays(
        vertices @ turn.T + random.normal(size=3),
        triangles,
        uv=uv,
        image=_image(random),
        wrap="clamp",
        mag_filter=str(random.choice(["linear", "nearest"])),
    )
    sources = {}
    middle, size = surface.vertices[random.integers(len(vertices))], random.uniform(0.02, 0.3)
    if random.random() < 0.2:
        sources["roughness"] = lambda points: np.exp(-np.sum((points - middle) ** 2, axis=1) / size**2)
    if random.random() < 0.15:
        bright = random.uniform(0.5, 20)
        sources["emissive"] = lambda points: (
            np.where(np.linalg.norm(points - middle, axis=1)[:, None] < size, bright, 0.02) * np.ones(3)
        )
    if random.random() < 0.15:
        rate = random.uniform(1, 30)
        sources["normal"] = lambda points, normals: _unit(normals + 0.4 * np.sin(rate * points))
    return surface.with_sources(sources) if sources else surface


def _unit(vectors):
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)


def _image(random):
    """Ramps, edges, dots, checkers, waves or noise, and at times an alpha of such a kind."""
    image = np.stack([_pattern(random)] * 3, axis=-1) * random.uniform(0.3, 1, 3)
    if random.random() < 0.4:  # a dot on whatever it is
        x, y, size = *random.integers(0, len(image), 2), int(random.integers(1, 4))
        image[x : x + size, y : y + size] = random.random(3)
    if random.random() < 0.2:
        alpha = _pattern(random)
        alpha = np.resize(alpha.repeat(4, axis=0).repeat(4, axis=1), image.shape[:2])
        image = np.concatenate([image, alpha[..., None]], axis=-1)
    return np.rint(255 * image).astype(np.uint8)


def _pattern(random):
    size = int(random.choice([8, 32, 96, 192]))
    x, y = np.meshgrid(*[(np.arange(size) + 0.5) / size] * 2)
    low, high = random.random(2)
    a, b = random.normal(size=2)
    kinds = {
        "flat": lambda: np.zeros_like(x),
        "ramp": lambda: np.clip(0.5 + a * (x - 0.5) + b * (y - 0.5), 0, 1),
        "edge": lambda: (a * (x - 0.5) + b * (y - 0.5) > 0.2 * (random.random() - 0.5)).astype(np.float64),
        "checkers": lambda: np.floor(np.array([x, y]) * random.integers(2, size + 1)).sum(axis=0) % 2.0,
        "waves": lambda: 0.5 + 0.5 * np.sin(10 * a * x + 3) * np.cos(10 * b * y),
        "noise": lambda: random.random(x.shape),
        "dots": lambda: (random.random(x.shape) < 3 / size**2).astype(np.float64),
    }
    values = kinds[random.choice(list(kinds))]()
    return low + (high - low) * values


def _ball(count):
    """A sphere of 2 · ``count`` by ``count`` faces."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 2 * count + 1), np.linspace(0, 1, count)))
    turn, rise = 2 * np.pi * u, np.pi * v
    vertices = np.column_stack([np.cos(turn) * np.sin(rise), np.sin(turn) * np.sin(rise), np.cos(rise)])
    return vertices, halved_quads(count, 2 * count + 1)[:, ::-1], np.column_stack([u, v])


def _box(size):
    """A box, each side of which shows a sixth of the image."""
    vertices, triangles, uv = [], [], []
    for side in range(6):
        axis, end = side >> 1, side & 1
        a, b = np.meshgrid([0.0, 1.0], [0.0, 1.0])
        corners = np.empty((4, 3))
        corners[:, axis] = end
        corners[:, (axis + 1) % 3], corners[:, (axis + 2) % 3] = a.ravel(), b.ravel()
        faces = np.array([[0, 1, 3], [0, 3, 2]])
        triangles.append((faces if end else faces[:, ::-1]) + 4 * side)
        vertices.append(corners * size)
        uv.append(np.column_stack([(a.ravel() + side % 3) / 3, (b.ravel() + side // 3) / 2]))
    return np.concatenate(vertices), np.concatenate(triangles), np.concatenate(uv)


def _sheet(thickness, bend):
    """A square of two sides, each with half of the image, flat or in waves of a height ``bend``."""
    count = 2 if bend == 0 else 17
    u, v = (grid.ravel() for grid in np.meshgrid(*[np.linspace(0, 1, count)] * 2))
    front = np.column_stack([u, v, bend * np.sin(5 * u) * np.cos(4 * v)])
    faces = halved_quads(count, count)
    uv = np.concatenate([np.column_stack([u / 2 + half / 2, v]) for half in range(2)])
    back = front - [0, 0, thickness]
    return np.concatenate([front, back]), np.concatenate([faces, faces[:, ::-1] + len(u)]), uv
