"""What scripts of random edits are made of: surfaces, images, cameras."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import octex
from octex.channels import ALPHA, BASE_COLOR, NORMAL, ROUGHNESS
from octex.source.base import Source
from octex.source.surface import Surface
from tests.make.painted import ball, square, together
from tests.make.small_surfaces import sheet, turned
from tests.make.solids import cube

Random = np.random.Generator


DTYPES = ("uint8", "uint16", "float16", "float32")


MESHES = ("triangle", "sheet", "open", "planes", "overlapping", "sphere", "cube", "flat")


#: The images of every third seed are ramps: the spline that reads images overshoots at edges of others,
#: and the averages of what it clamps are no longer the means of the leaves.
RAMP = 2


def mesh(kind, seed):
    """A surface of fewer than 200 triangles."""
    turn, box = turned(seed), cube((0, 0, 0))
    if kind in ("sheet", "sphere"):
        return sheet(turn, (0.3, 0.02, 0.0)[seed % 3]) if kind == "sheet" else ball(8)
    points, triangles = {
        "triangle": lambda: (np.random.default_rng(seed).normal(size=(3, 3)), np.array([[0, 1, 2]])),
        "open": lambda: (box[0] @ turn.T, box[1][3:]),
        "planes": lambda: together(square(0.0, 1.0, 3), square(8 / 3 / 13, 1.0, 3)),  # of cells at depth 4
        "overlapping": lambda: together(cube((0, 0, 0), 0.6), cube((0.4, 0.3, 0.2), 0.5)),
        "cube": lambda: (box[0] @ turn.T, box[1]),
        "flat": lambda: square(0.0, 1.0, 2),
    }[kind]()
    return Surface.from_arrays(points, triangles, factor=(0.6, 0.5, 0.4))


class Waves(Source):
    """Channels that waves and edges over the surface give; alpha and roughness are 0 and 1 in places."""

    def __init__(self, surface, names, seed):
        forms = {form.name: form for form in (BASE_COLOR, ALPHA, ROUGHNESS, NORMAL)}
        self._channels = tuple(forms[name] for name in names)
        self._mesh = surface.rest, surface.triangles
        self._seed = seed
        self._low, high = surface.bounds
        self._size = float((high - self._low).max()) or 1.0

    @property
    def channels(self):
        return self._channels

    def evaluate(self, triangles, barycentric, widths):  # noqa: ARG002
        rest, faces = self._mesh
        points = np.einsum("nc,ncx->nx", barycentric, rest[faces[triangles]])
        places = (points - self._low) / self._size
        found = []
        for number, form in enumerate(self._channels):
            random = np.random.default_rng([self._seed, number])
            pitch, phase = random.normal(size=(2, 3, form.components)) * [[[9.0]], [[3.0]]]
            waves = np.sin(places @ pitch + phase[0])
            if form.space == "direction":
                lengths = np.linalg.norm(waves, axis=1, keepdims=True)
                found.append(np.where(lengths > 0, waves / np.maximum(lengths, 1e-9), 1 / np.sqrt(3)))
            else:  # over half of it as steep as may be
                found.append(np.clip(0.5 + random.choice([0.4, 1.0, 20.0]) * waves, 0, 1))
        return np.concatenate(found, axis=1).astype(np.float32)


def waved(kind, shape, names, seed):
    """A mesh with such channels."""
    surface = mesh(kind, shape)
    return Surface(surface.vertices, surface.triangles, Waves(surface, names, seed), rest=surface.rest)


def cloud(surface, seed, normals=True):
    """Points on a surface, its vertices among them."""
    found = surface.scatter(300, seed)
    points = np.concatenate([surface.rest, found.rest])
    colors = np.random.default_rng(seed).random((len(points), 3)).astype(np.float32)
    facing = np.concatenate([np.zeros_like(surface.rest), found.normals]) if normals else None
    return octex.PointCloud(points, colors, facing)


def random_image(seed, width, height, translucent=False):
    """Noise, patches of few colours, or a ramp; if translucent with a disc of alpha that falls off."""
    random = np.random.default_rng(seed)
    image = random.integers(0, 256, (height, width, 4), dtype=np.uint8)
    if seed % 3 == RAMP:
        ramp = np.linspace(30, 220, height)[:, None] * np.ones(width)
        image[..., :3] = np.stack([ramp, 250 - ramp, np.full_like(ramp, 128)], axis=-1)
    elif seed % 3 == 1:
        image[:] = random.integers(0, 2, (height // 4 + 1, width // 4 + 1, 4)).repeat(4, 0).repeat(4, 1)[
            :height, :width
        ] * np.uint8(255)
    image[..., 3] = 255
    if translucent:
        y, x = np.mgrid[:height, :width]
        away = np.hypot((x - width / 2) / width, (y - height / 2) / height)
        image[..., 3] = np.clip(2.0 - 6 * away, 0, 1) * 255
    return image


def stroke(seed, width, height):
    """A layer of a paint program: a mark in one colour, soft or hard, and nothing else."""
    random = np.random.default_rng(seed)
    image = np.zeros((height, width, 4), np.uint8)
    y, x = np.mgrid[:height, :width]
    away = np.hypot(x - random.uniform(0, width), y - random.uniform(0, height))
    radius = random.uniform(1, 6)
    image[..., :3] = random.integers(0, 256, 3)
    image[..., 3] = 255 * np.clip((radius - away) / random.choice([0.01, 2.0]), 0, 1)
    image[image[..., 3] == 0] = 0
    return image


def drawn_on(image, seed):
    """An image with such a mark on it."""
    mark = stroke(seed, image.shape[1], image.shape[0])
    part = mark[..., 3:] / 255
    found = image.copy()
    found[..., :3] = np.rint(image[..., :3] * (1 - part) + mark[..., :3] * part)
    return found


def camera(surface, seed, width, height):
    """A camera that looks at a surface from somewhere."""
    random = np.random.default_rng(seed)
    direction = random.normal(size=3)
    if seed % 3 == 0:
        direction = np.eye(3)[seed % 9 // 3]
    if seed % 4 == 0:
        fitted = octex.Camera.fitted(surface.vertices, direction, size=(width, height))
        extent = float(np.ptp(surface.vertices, axis=0).max())
        scale = min(width, height) / extent * random.uniform(0.6, 1.5)
        return octex.Camera.orthographic(
            (width, height), pose=fitted.world_to_camera, convention="opencv", pixels_per_unit=scale
        )
    points = surface.vertices
    if seed % 5 == 1:  # a part that may lie within one triangle
        reach = float(np.ptp(points, axis=0).max()) * random.uniform(0.1, 0.4)
        points = surface.scatter(1, seed=seed).points + reach * (np.array(list(np.ndindex(2, 2, 2))) - 0.5)
    return octex.Camera.fitted(
        points, direction, size=(width, height), fov=random.uniform(15, 90), margin=random.uniform(0, 0.3)
    )


def beyond(axis, place, width):
    """What lies beyond a place along an axis, and half of it ``width`` before."""
    return lambda points: np.clip(1 + (points[:, axis] - place) / max(width, 1e-9), 0, 1)


def reopened(texture):
    """The same texture, mapped from a file."""
    with TemporaryDirectory(prefix="octex-edits-") as folder:
        texture.save(Path(folder) / "texture.octex")
        return octex.open(Path(folder) / "texture.octex")


def vars_of_scripts():
    names = globals()
    made = "mesh waved cloud random_image stroke drawn_on camera beyond reopened np octex"
    return {name: names[name] for name in made.split()}
