"""Random sequences of edits of small textures, each a script that a person can run.

A step is lines of Python, and claims of what has become of the texture. What fails is told as the shortest
script found that fails alike.
"""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

import octex
from octex.channels import ALPHA, BASE_COLOR, NORMAL, ROUGHNESS
from octex.errors import OctexError
from octex.painting.picture import BLENDS
from octex.source.base import Source
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.tree.layout import KEPT
from tests.make.painted import ball, square, together
from tests.make.small_surfaces import sheet, turned
from tests.make.solids import cube
from tests.oracles.naive_edits import assert_averages
from tests.properties import edit_claims as claims

Random = np.random.Generator

DTYPES = ("uint8", "uint16", "float16", "float32")
MESHES = ("triangle", "sheet", "open", "planes", "overlapping", "sphere", "cube", "flat")
#: The pictures of every third seed are ramps: the spline that reads pictures overshoots at edges of others,
#: and the averages of what it clamps are no longer the means of the leaves.
RAMP = 2
#: Larger textures take too long to be looked at after every step.
MOST_CELLS = 40_000
#: Averages of more are not compared with those made the slow way.
MOST_AVERAGED = 3_000

#: What is large there is small here: pixels around a stroke's paint, cells that are merged at once, and how
#: much the pieces may have in common.
SMALL = (
    ("octex.painting.paint.AROUND", 8),
    ("octex.painting.merge.WHOLE", 500),
    ("octex.painting.merge.PIECE", 500),
    ("octex.painting.merge.MOST", 1000.0),
)

#: Refusals of what cannot be done, and why; any other error of octex's is a fault.
ALLOWED = (
    "no leaf of the texture meets the box",  # a crop beside the surface
    "which uint8 cannot hold",  # floats above 1 or below 0, cast
    "which uint16 cannot hold",
    "its source has no value anywhere on it",  # a source with a limit, and nothing within it
    "cells apart into depth",  # too coarse to separate
    "belongs to another model",  # a cloud's root cell need not hold the surface
)


# --- what scripts are made of


def mesh(kind, seed):
    """A surface of fewer than 200 triangles."""
    turn = turned(seed)
    if kind == "triangle":
        points, triangles = np.random.default_rng(seed).normal(size=(3, 3)), np.array([[0, 1, 2]])
    elif kind == "sheet":
        return sheet(turn, (0.3, 0.02, 0.0)[seed % 3])
    elif kind == "open":
        points, triangles = cube((0, 0, 0))
        points, triangles = points @ turn.T, triangles[3:]
    elif kind == "planes":  # at depth 4 both squares lie in planes of cells
        points, triangles = together(square(0.0, 1.0, 3), square(8 / 3 / 13, 1.0, 3))
    elif kind == "overlapping":
        points, triangles = together(cube((0, 0, 0), 0.6), cube((0.4, 0.3, 0.2), 0.5))
    elif kind == "sphere":
        return ball(8)
    elif kind == "cube":
        points, triangles = cube((0, 0, 0))
        points = points @ turn.T
    else:
        points, triangles = square(0.0, 1.0, 2)
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


def picture(seed, width, height, translucent=False):
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
    """A picture with such a mark on it."""
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


# --- steps


Claim = Callable[["Run", OctreeTexture, OctreeTexture], None]


class Step(NamedTuple):
    lines: tuple[str, ...]  # the last one makes ``texture``
    claim: Claim | None = None
    fits: bool = False  # leaves become coefficients: averages are not their means, and floats leave 0 … 1
    leaves_range: bool = False  # floats may leave 0 … 1
    has_gaps: bool = False  # alpha of nodes counts surface where nothing is stored
    is_exact: bool = False  # averages are known also where leaves are coefficients
    turns: bool = False  # residuals are not kept, but mapped or rounded
    layers: tuple[str, ...] = ()  # other textures, whose averages may differ from means too


class Run:
    """A texture and what has been done to it."""

    def __init__(self, dtypes, folder, points):
        self.names: dict[str, Any] = dict(vars_of_scripts())
        self.dtypes, self.folder, self.points = dtypes, folder, points
        self.steps: list[Step] = []
        self.is_fitted = self.is_free = False

    @property
    def texture(self):
        return self.names["texture"]

    @property
    def surface(self):
        return self.names["surface"]

    def take(self, step):
        """Do a step and look at what has become of the texture; say whether it could be done."""
        before = self.names.get("texture")
        was = None if before is None else claims.digest(before)
        self.steps.append(step)
        try:
            for line in step.lines:
                exec(line, self.names)
        except OctexError as error:
            if any(text in str(error) for text in ALLOWED):
                self.steps.pop()
                self.names["texture"] = before
                return False
            raise
        self.is_fitted |= step.fits
        self.is_free |= step.leaves_range
        after = self.texture
        count = len(self.steps)
        claims.assert_sound(after, self.folder, count, self.points)
        if not self.is_fitted:
            claims.assert_in_unit_range(after, None if not self.is_free else ["alpha"])
        if before is None and not self.is_fitted:
            names = [name for name in after.channels if name != "alpha" or not step.has_gaps]
            claims.assert_averaged(after, names, 2.0)
        if before is not None:
            if after.tree.n_cells < MOST_AVERAGED and (step.is_exact or not (self.is_fitted or step.turns)):
                layers = [eval(code, {**self.names, "texture": before}) for code in step.layers]
                assert_averages(before, after, layers)
            assert claims.digest(before) == was, "the texture that was given has changed"
            assert after.placement == before.placement, "the root cell has moved"
            if step.claim is not None:
                step.claim(self, before, after)
        return True

    def script(self):
        return [line for step in self.steps for line in step.lines]


def vars_of_scripts():
    names = globals()
    made = "mesh waved cloud picture stroke drawn_on camera beyond reopened np octex"
    return {name: names[name] for name in made.split()}


def some(random, low, high):
    return round(float(random.uniform(low, high)), 3)


def one_of(random, values):
    return values[int(random.integers(len(values)))]


def call(function, *arguments, **options):
    """Write a call; strings stand for themselves, so that those that are meant as such come quoted."""
    given = [str(each) for each in arguments]
    given += [f"{name}={value}" for name, value in options.items() if value is not None]
    return f"{function}({', '.join(given)})"


def color_of(random, components):
    return tuple(float(each) for each in random.choice([0.0, 1.0, 0.2, 0.7], components))


def place_on(random, run):
    """Somewhere on the surface at rest."""
    rest = run.surface.placed_in(run.texture).scatter(1, int(random.integers(1 << 30))).rest[0]
    x, y, z = (round(float(each), 3) for each in rest)
    return x, y, z


def extent_of(run):
    return float(np.ptp(run.texture.bounds, axis=0).max()) or 1.0


# --- the first texture


def first_steps(random, run, small):
    kind = one_of(random, ("triangle", "flat", "planes") if small else MESHES)
    shape = int(random.integers(20))
    dtype = one_of(random, run.dtypes)
    depth = int(random.integers(2, 4 if small else 6))
    names = ["base_color"]
    if random.random() < 0.5:
        names.append("alpha")
    if random.random() < 0.3:
        names.append("roughness")
    if random.random() < 0.15:
        names.append("normal")
    surface = call("surface = waved", repr(kind), shape, names, int(random.integers(100)))
    fit = random.random() < 0.4
    options = {"dtype": repr(dtype), "fit": None if fit else False}
    how = random.random()
    if how < 0.15 and not small:
        options["max_error"] = one_of(random, (1, 4, 20))
    elif how < 0.3 and not small:
        options["detail"] = call("lambda points: 1 + points[:, 0] * 3 % 1 *", depth - 1)
    if kind == "overlapping" and random.random() < 0.5:
        options["separate"] = 1.0
    start = random.random()
    if start < 0.12 and not small:
        half = "surface.part(range(len(surface.triangles) // 2))"
        source = f"octex.Transfer({half}, distance={some(random, 0.05, 0.5)})"
        if "alpha" in names:  # the other model's own
            source += ".sources"
        else:
            source = f"{{'base_color': {source}}}"
        options["sources"] = source
        if kind == "triangle":
            del options["sources"]
    elif start < 0.2 and not small:
        points = f"cloud(surface, {shape}, {shape % 2 > 0})"
        line = call("texture = octex.convert", points, depth, dtype=repr(dtype))
        return [Step((surface, line))]
    elif start < 0.3 and not small:
        place = call("octex.Sphere", "surface.rest[0]", some(random, 0.2, 1.0))
        line = call("texture = octex.fill", "None", "surface", place, color_of(random, 3), max_depth=depth)
        return [Step((surface, line))]
    elif start < 0.36 and not small:
        fit = random.random() < 0.5
        shot = projection(random)
        line = call("texture = octex.paint", "None", "surface", shot, max_depth=depth, fit=fit)
        return [Step((surface, line), fits=fit or overshoots(shot))]
    line = call("texture = octex.convert", "surface", depth, **options)
    return [Step((surface, line), fits=fit, has_gaps="sources" in options)]


# --- painting


def projection(random, blend=None):
    width, height = (int(each) for each in random.integers(8, 40, 2))
    seed = int(random.integers(1000))
    image = call("picture", seed, width, height, random.random() < 0.5)
    options = {}
    how = random.random()
    if how < 0.2:
        image = call("stroke", seed, width, height)
    elif how < 0.4:
        options["since"] = image
        image = call("drawn_on", image, seed)
    if random.random() < 0.5:
        options["opacity"] = one_of(random, (0.5, 0.25, 0.9))
    blend = blend or one_of(random, (*BLENDS, "over", "over"))
    if blend != "over":
        options["blend"] = repr(blend)
    seen = call("camera", "surface", int(random.integers(1000)), width, height)
    return call("octex.Projection", image, seen, **options)


def overshoots(pictures):
    """Whether any picture is no ramp."""
    seeds = re.findall(r"picture\((\d+)", pictures)
    return "stroke(" in pictures or "drawn_on(" in pictures or any(int(seed) % 3 != RAMP for seed in seeds)


def paint_options(random, run):
    depth = run.texture.tree.max_depth
    options = {"max_depth": int(np.clip(depth + random.integers(-1, 3), 1, 6))}
    if random.random() < 0.5:
        options["fit"] = False
    if random.random() < 0.2:
        options["edge_feather"] = some(random, 0.5, 4)
    if random.random() < 0.2:
        options["back_faces"] = True
    if random.random() < 0.15:
        options["hidden"] = True
    if random.random() < 0.15:
        options["region"] = f"np.arange({len(run.surface.triangles)}) % 3 > 0"
    if random.random() < 0.3:
        options["max_angle"] = one_of(random, (90.0, 30.0, 180.0))
        options["run"] = "octex.Run(memory=1)"  # byte: pictures lie in files meanwhile
    paintable = [name for name, each in run.texture.channels.items() if name not in ("alpha", "normal")]
    name = one_of(random, paintable)
    if name != "base_color":
        options["channel"] = repr(name)
    return options


def near(region):
    """Nothing moves but what is within a cell of paint: in the field two, with normals also beside leaves."""

    def claim(run, before, after):
        where = region(run, before)
        claims.assert_far_cells_stay(before, after, where, 1.01, run.surface)
        claims.assert_far_field_stays(before, after, run.surface, where, 2.01, len(run.steps))

    return claim


def draw_paint(random, run):
    options = paint_options(random, run)
    blend = one_of(random, (*BLENDS, "over"))
    shots = [projection(random, blend) for _ in range(int(random.integers(1, 4)))]
    if len(shots) > 1 and "hidden" not in options and random.random() < 0.3:
        options["balance"] = one_of(random, ("'gain'", "'full'"))
    pictures = shots[0] if len(shots) == 1 else f"[{', '.join(shots)}]"
    line = call("texture = octex.paint", "texture", "surface", "pictures", **options)
    code = call("octex.project", "surface", "pictures", like="texture", **options)

    def painted(run, before):
        layer = eval(code, {**run.names, "texture": before})
        if "balance" in options:
            most = max(claims.largest(layer, name) for name in layer.channels)
            assert most < claims.LARGEST_GAIN, f"pictures that were made to agree are as bright as {most}"
        return claims.painted_boxes(layer)

    fits = "fit" not in options
    lines = f"pictures = {pictures}", line
    return Step(lines, near(painted), fits=fits, leaves_range=True, is_exact=True, layers=(code,))


def draw_layer(random, run):
    options = paint_options(random, run)
    shots = [projection(random, "over") for _ in range(int(random.integers(1, 3)))]
    pictures = shots[0] if len(shots) == 1 else f"[{', '.join(shots)}]"
    line = call("layer = octex.project", "surface", pictures, like="texture", **options)
    return merged(random, (line,), fits="fit" not in options)


def merged(random, lines, fits):
    """Merge the layer that there is."""
    how = {"opacity": one_of(random, (1.0, 0.5, 0.3)), "blend": repr(one_of(random, BLENDS))}
    line = call("texture = octex.merge", "texture", "layer", "surface", **how)
    claim = near(lambda run, _before: claims.painted_boxes(run.names["layer"]))
    return Step((*lines, line), claim, fits=fits, leaves_range=True, is_exact=True, layers=("layer",))


def draw_again(random, run):
    """Merge a layer once more."""
    layer = run.names.get("layer")
    if layer is None or not set(layer.channels) - {"alpha"} <= set(run.texture.channels):
        return draw_layer(random, run)
    return merged(random, (), fits=True)


def draw_fill(random, run):
    texture, size = run.texture, extent_of(run)
    depth = int(np.clip(texture.tree.max_depth + random.integers(-1, 3), 1, 6))
    edge = texture.placement.size / 2**depth
    names = [name for name in texture.channels if name != "alpha"]
    name = one_of(random, names)
    components = texture.channels[name].format.components
    color = (0.0, 0.0, 1.0) if name == "normal" else color_of(random, components)
    blend = one_of(random, (*BLENDS, "over", "erase"))
    opacity = one_of(random, (1.0, 1.0, 0.5, 0.2))
    options = {
        "channel": None if name == "base_color" else repr(name),
        "opacity": None if opacity == 1.0 else opacity,
        "blend": None if blend == "over" else repr(blend),
        "max_depth": depth,
    }
    kind = one_of(random, ("sphere", "sphere", "box", "triangles", "function"))
    soft = one_of(random, (0.0, 0.0, round(0.1 * size, 3)))
    center = np.array(place_on(random, run))
    radius = round(size * one_of(random, (0.05, 0.15, 0.4, 2.0)), 3)
    if kind == "sphere":
        region = call("octex.Sphere", tuple(center.tolist()), radius, soft=soft or None)
        where = claims.Ball(tuple(center.tolist()), radius, edge)
    elif kind == "box":
        low, high = ((center + sign * radius).round(3) for sign in (-1, 1))
        region = call("octex.Box", tuple(low.tolist()), tuple(high.tolist()), soft=soft or None)
        where = claims.Boxes(low[None], high[None], np.array([edge]), 1.0)
    elif kind == "triangles":
        count = len(run.surface.triangles)
        chosen = sorted({int(each) for each in random.integers(0, count, 2)})
        corners = run.surface.placed_in(texture).rest[run.surface.triangles[chosen]]
        region = str(chosen)
        where = claims.Boxes(corners.min(axis=1), corners.max(axis=1), np.full(len(chosen), edge), 1.0)
    else:
        axis, width = int(random.integers(3)), round(0.1 * size, 3)
        region = call("beyond", axis, round(float(center[axis]), 3), width)
        low, high = np.full((2, 3), [[-1e9], [1e9]])
        low[axis] = center[axis] - width
        where = claims.Boxes(low[None], high[None], np.array([edge]), 1.0)
    line = call("texture = octex.fill", "texture", "surface", region, color, **options)

    def claim(run, before, after):
        if run.surface.placed_in(before) is not run.surface:
            return  # parts were moved, the region is where they were
        near(lambda _run, _before: where)(run, before, after)
        claims.assert_other_channels_stay(before, after, run.surface, name, len(run.steps))
        if kind in ("sphere", "box") and not soft:
            assert_filled(run, before, after, where, name, color, blend, opacity)

    free = blend in ("add", "screen") or name == "normal"
    return Step((line,), claim, leaves_range=free, is_exact=True)


def assert_filled(run, before, after, where, name, color, blend, opacity):
    """Deep inside a region the field is what blending says of it as it was."""
    texture_name = "alpha" if blend == "erase" else name
    if blend == "add" and after.channels[name].format.dtype.startswith("u"):
        return  # which clamp
    if claims.adds_leaves(before, after):
        return  # where there was nothing paint is opaque
    has_alpha = "alpha" in before.channels
    if has_alpha and blend != "erase" and (opacity < 1 or blend in ("multiply", "screen", "add")):
        return  # colours weigh by alphas that were other ones
    samples = run.surface.placed_in(before).scatter(300, len(run.steps))
    is_stored = before.contains(samples.rest)
    points, facing = samples.rest[is_stored], samples.normals[is_stored]
    edge = where.edge if isinstance(where, claims.Ball) else where.edges[0]
    # A node that keeps a coefficient keeps the old one where unpainted surface is in or beside it. Cells off
    # the surface are refined from it, level by level to half a cell beyond, and reach as far as the spline.
    kept = claims.kept_edge(after)
    is_deep = where.depths(points) > max(4.0 * edge, 3.0 * kept + 0.5 * edge if kept else 0.0)
    points, facing = points[is_deep], facing[is_deep]
    if not len(points):
        return
    form = after.channels[texture_name].format
    if texture_name in before.channels:
        was = before.sample(points, texture_name, normalize=False).astype(float)
    else:
        was = np.ones((len(points), 1))
    paint = np.broadcast_to(np.asarray(color, float), (len(points), len(color)))
    paint = {
        "multiply": lambda: was * paint,
        "screen": lambda: 1 - (1 - was) * (1 - paint),
        "erase": lambda: np.zeros_like(was),
    }.get(blend, lambda: paint)()
    part = 1.0 if blend == "replace" else opacity
    wanted = was + part * paint if blend == "add" else was + part * (paint - was)
    slack = 1.5 * claims.code_width(form, claims.largest(after, texture_name)) + 2e-5
    for normals in (None, facing) if blend in ("over", "replace") and part == 1.0 else (None,):
        found = after.sample(points, texture_name, normals=normals, normalize=False)
        apart = np.abs(found - wanted).max(axis=1)
        worst = int(apart.argmax())
        assert apart[worst] <= slack, (
            f"inside the region {texture_name} with{'out' if normals is None else ''} normals at "
            f"{points[worst].tolist()} was {was[worst].tolist()}, is {found[worst].tolist()}, should be "
            f"{wanted[worst].tolist()}"
        )


# --- processing


def draw_fill_all(random, run):
    """Paint one colour over everything."""
    texture = run.texture
    depth = int(np.clip(texture.tree.max_depth + random.integers(-1, 2), 1, 6))
    name = one_of(random, [each for each in texture.channels if each not in ("alpha", "normal")])
    color = color_of(random, texture.channels[name].format.components)
    options = {
        "channel": None if name == "base_color" else repr(name),
        "blend": one_of(random, (None, "'replace'")),
        "max_depth": one_of(random, (None, depth)),
    }
    region = "np.ones(len(surface.triangles), bool)"
    line = call("texture = octex.fill", "texture", "surface", region, color, **options)

    def claim(run, before, after):
        claims.assert_other_channels_stay(before, after, run.surface, name, len(run.steps))
        # What a resize has made off the surface, where no paint is, counts in averages. What others have left
        # of it is not told from surface.
        script = "\n".join(run.script())
        is_divided = "octex.resize" in script
        if is_divided and any(f"octex.{each}" in script for each in ("crop", "mix", "combine")):
            return
        claims.assert_one_color(after, run.surface, name, color, len(run.steps), averages=not is_divided)

    return Step((line,), claim, is_exact=True)


def draw_session(random, run):
    """Paint in a session, forth and back: textures that it gives stay; it ends as a single call does.

    Pictures may be of another pose.
    """
    step, other = one_of(random, (draw_paint, draw_fill))(random, run), draw_fill(random, run).lines[-1]
    *first, single = (line.replace(", run=octex.Run(memory=1)", "") for line in step.lines)
    painted, passing = (
        re.sub(r"^texture = octex\.(\w+)\(texture, surface, ", r"painter.\1(", line)
        for line in (single, other)
    )
    stretches = [some(random, 0.6, 1.5) for _ in range(3)]
    is_posed = painted.startswith("painter.paint") and random.random() < 0.5
    if is_posed:
        painted = f"{painted[:-1]}, pose=posed)"
        single = single.replace("(texture, surface, ", "(texture, posed, ")
    passing += " and painter.undo()"  # what paints nothing is no stroke
    lines = (
        *first,
        f"posed = surface.with_pose(surface.vertices * {stretches})",
        "painter = octex.Painter(texture, surface)",
        *(passing, f"changes = {painted}", "held = painter.texture()", passing),
        *("changes and painter.undo()", "undone = painter.texture()", "changes and painter.redo()"),
        *(passing, "texture = painter.texture()"),
    )

    def claim(run, before, after):
        names = {**run.names, "texture": before}
        exec(single, names)
        for texture in after, run.names["held"]:
            assert claims.digest(texture) == claims.digest(names["texture"]), "a session ends otherwise"
        assert claims.digest(run.names["undone"]) == claims.digest(before), "a session undoes otherwise"
        if step.claim is not None and not is_posed:
            step.claim(run, before, after)

    seen = "(posed, " if is_posed else "(surface, "
    return step._replace(
        lines=lines, claim=claim, layers=tuple(code.replace("(surface, ", seen) for code in step.layers)
    )


def draw_layers(random, run):
    """Paint in two layers, hide and show the upper one, undo all and redo all: each brings back what was."""
    steps = draw_fill(random, run), draw_paint(random, run)
    lines = []
    for step, name in zip(steps, ("low", "high"), strict=True):
        *first, single = (line.replace(", run=octex.Run(memory=1)", "") for line in step.lines)
        blend, opacity = one_of(random, ("over", "multiply", "screen")), one_of(random, (1.0, 0.6))
        lines += [*first, f"{name} = layers.add_layer(blend={blend!r}, opacity={opacity}).number"]
        lines += [re.sub(r"^texture = octex\.(\w+)\(texture, surface, ", r"layers.\1(", single)]
        lines += [f"with_{name} = layers.texture()"]
    lines.insert(0, "layers = octex.Layers(texture, surface)")
    lines += ["layers.change_layer(high, is_visible=False)", "layers.change_layer(high, is_visible=True)"]
    lines += ["again = layers.texture()", "count = len(layers.strokes)"]
    lines += ["for _ in range(count): layers.undo()", "undone = layers.texture()"]
    lines += ["for _ in range(count): layers.redo()", "texture = layers.texture()"]

    def claim(run, before, after):
        names = run.names
        assert claims.digest(names["undone"]) == claims.digest(before), "layers undo otherwise"
        for each in after, names["again"]:
            assert claims.digest(each) == claims.digest(names["with_high"]), "layers are shown otherwise"

    return Step(tuple(lines), claim, fits=True, leaves_range=True)


def draw_map(random, run):
    name = one_of(random, [each for each in run.texture.channels if each != "normal"])
    scale, shift = one_of(random, ((0.5, 0.25), (-1.0, 1.0), (1.0, 0.0), (0.25, 0.0)))
    line = call("texture = octex.map", "texture", f"lambda values: {scale} * values + {shift}", repr(name))

    def claim(run, before, after):
        same_tree(run, before, after)
        if name == "alpha" or "alpha" in before.channels:
            return
        points = run.surface.placed_in(before).scatter(100, 1).rest
        points = points[before.contains(points)]
        if not len(points):
            return
        was, found = (each.sample(points, name) for each in (before, after))
        form = after.channels[name].format
        stored = claims.decode(before.channels[name].values, form.space)
        if stored.min() * scale + shift < 0 or stored.max() * scale + shift > 1:
            return
        slack = 1.5 * claims.code_width(form, float(np.abs(was).max())) + 1e-5
        assert np.abs(scale * was + shift - found).max() <= slack, "the field is not mapped as its values are"

    return Step((line,), claim, turns=scale < 0)


def same_tree(_run, before, after):
    for one, other in zip(
        [*before.tree.arrays, *before.tree.split, *before.tree.kept],
        [*after.tree.arrays, *after.tree.split, *after.tree.kept],
        strict=True,
    ):
        np.testing.assert_array_equal(one, other, "the tree has changed")


def draw_levels(random, run):
    names = [each for each in run.texture.channels if each != "normal"]
    options = {
        "black": one_of(random, (0.0, 0.2)),
        "white": one_of(random, (1.0, 0.7)),
        "gamma": one_of(random, (1.0, 2.2, 0.5)),
    }
    chosen = names if random.random() < 0.3 else [one_of(random, names)]
    line = call("texture = octex.levels", "texture", chosen, **options)
    return Step((line,), same_tree, turns=True, leaves_range=True)


def other_texture(random, run):
    """Lines that make another texture of the same root cell."""
    how = random.random()
    if how < 0.3:
        return (call("other = octex.map", "texture", "lambda values: 1 - values"),)
    if how < 0.5:
        depth = run.texture.tree.max_depth
        return (call("other = octex.resize", "texture", int(np.clip(depth + random.integers(-2, 2), 1, 5))),)
    if how < 0.7:
        low, high = box_of(random, run)
        return (call("other = octex.crop", "texture", low, high),)
    step = draw_fill(random, run) if random.random() < 0.5 else draw_paint(random, run)
    return (*step.lines[:-1], step.lines[-1].replace("texture = ", "other = ", 1))


def box_of(random, run):
    center = np.array(place_on(random, run))
    radius = extent_of(run) * one_of(random, (0.1, 0.3, 0.6))
    return (center - radius).round(3).tolist(), (center + radius).round(3).tolist()


def draw_mix(random, run):
    lines = other_texture(random, run)
    how = random.random()
    amount = str(one_of(random, (0.0, 1.0, 0.3, 0.5, 0.8)))
    claim = None
    if how < 0.3:
        axis = int(random.integers(3))
        amount = call("beyond", axis, round(place_on(random, run)[axis], 3), one_of(random, (0.0, 0.2)))
    elif how < 0.4 and "roughness" in run.texture.channels:
        amount = "octex.cast(texture, channels=['roughness'])"
    if amount in ("0.0", "1.0"):

        def claim(run, before, after):
            pair = before, run.names["other"]
            claims.assert_prevails(after, *(pair if amount == "0.0" else pair[::-1]), run.surface)

    line = call("texture = octex.mix", "texture", "other", amount)
    return Step((*lines, line), claim, fits=fits_of(lines), leaves_range=True, layers=("other",))


def fits_of(lines):
    return any("octex.paint" in line and "fit=False" not in line for line in lines)


def draw_combine(random, run):
    lines = other_texture(random, run)
    over = random.random() < 0.5
    line = call("texture = octex.combine", "texture", "other", over=over or None)

    def claim(run, before, after):
        other = claims.cells_of(run.names["other"])
        leaves = other.is_leaf
        where = claims.Boxes(other.low[leaves], other.high[leaves], other.edges[leaves])
        if not before.tree.n_leaves:
            return
        claims.assert_far_cells_stay(before, after, where, 0.01)
        if not over:
            claims.assert_prevails(after, run.names["other"], before, run.surface)

    return Step((*lines, line), claim, fits=fits_of(lines), leaves_range=True, layers=("other",))


def draw_blur(random, run):
    width = round(run.texture.placement.size / 2 ** one_of(random, (0.5, 1.5, 2.5, 4, 6, 9)), 4)
    name = one_of(random, [None, None, *run.texture.channels])
    chosen = [] if name is None else [repr(name)]
    line = call("texture = octex.blur", "texture", width, *chosen)
    return Step((line,), same_tree, turns=True)


def draw_crop(random, run):
    low, high = box_of(random, run)
    line = call("texture = octex.crop", "texture", low, high)

    def claim(run, before, after):
        cells, left = claims.cells_of(before), claims.cells_of(after)
        gone = cells.is_leaf & ~np.isin(cells.keys, left.keys)
        leaves = np.isin(cells.keys, left.keys) & cells.is_leaf
        rows = np.searchsorted(left.keys, cells.keys[leaves])
        for name, channel in before.channels.items():
            own = after.channels[name].values[rows]
            np.testing.assert_array_equal(channel.values[leaves], own, f"leaves of {name} after a crop")
        inside = (cells.low[leaves] <= high).all(axis=1) & (cells.high[leaves] > low).all(axis=1)
        assert inside.all(), "leaves outside the box are left"
        lost = (cells.low[gone] < np.array(high) - 1e-9).all(axis=1)
        lost &= (cells.high[gone] > np.array(low) + 1e-9).all(axis=1)
        assert not lost.any(), "leaves in the box are gone"
        # Where a node is gone the field spreads anew; one that keeps a coefficient faces other ways.
        gone |= ~np.isin(cells.keys, left.keys)
        lost = gone
        while lost.any():
            lost = np.isin(cells.keys, cells.keys[lost] >> 3)
            gone |= lost & (before.tree.arrays.flags & KEPT != 0)
        where = claims.Boxes(cells.low[gone], cells.high[gone], cells.edges[gone])
        claims.assert_far_cells_stay(before, after, where, 0.01)
        claims.assert_far_field_stays(before, after, run.surface, where, 1.01, len(run.steps))

    return Step((line,), claim, is_exact=True)


def draw_resize(random, run):
    depth = int(np.clip(run.texture.tree.max_depth + random.integers(-2, 2), 0, 5))
    line = call("texture = octex.resize", "texture", depth)

    def claim(run, before, after):
        if depth < before.tree.max_depth:
            before = before.level(depth)
        points = run.surface.placed_in(before).scatter(200, len(run.steps)).rest
        claims.assert_same_field(before, after, points[before.contains(points)], None)

    return Step((line,), claim)


def draw_cast(random, run):
    dtype = one_of(random, run.dtypes)
    names = list(run.texture.channels)
    kept = names if random.random() < 0.7 else ["base_color", *(["alpha"] if "alpha" in names else [])]
    options = {"dtype": repr(dtype), "channels": None if kept == names else str(kept)}
    line = call("texture = octex.cast", "texture", **options)

    def claim(run, before, after):
        same_tree(run, before, after)
        points = run.surface.placed_in(before).scatter(100, 1).rest
        claims.assert_same_field(before, after, points, None)

    return Step((line,), claim, turns=True)


def draw_level(random, run):
    level = int(np.clip(run.texture.tree.max_depth - random.integers(0, 3), 0, 21))
    line = f"texture = texture.level({level})"

    def claim(run, before, after):  # noqa: ARG001
        count = after.tree.n_cells
        for name, channel in before.channels.items():
            np.testing.assert_array_equal(channel.values[:count], after.channels[name].values, "a level")

    return Step((line,), claim)


def draw_reopened(random, run):  # noqa: ARG001
    return Step(("texture = reopened(texture)",), is_exact=True)


def draw_curves(random, run):
    name = one_of(random, [each for each in run.texture.channels if each != "normal"])
    points = one_of(random, ([(0, 0.2), (0.5, 0.9), (1, 1)], [(0, 1), (1, 0)], [(0.3, 0), (0.6, 1)]))
    line = call("texture = octex.curves", "texture", repr(name), points)
    return Step((line,), same_tree, turns=True)


STEPS = (
    (draw_fill, 6), (draw_fill_all, 1), (draw_paint, 4), (draw_session, 2), (draw_layers, 2),
    (draw_layer, 2), (draw_again, 1), (draw_map, 2), (draw_levels, 1), (draw_mix, 3), (draw_combine, 2),
    (draw_blur, 2), (draw_crop, 2), (draw_resize, 2), (draw_cast, 2), (draw_level, 1), (draw_curves, 1),
    (draw_reopened, 1),
)  # fmt: skip
LARGE = draw_paint, draw_session, draw_layers, draw_layer, draw_again, draw_mix, draw_combine
LARGE += draw_curves, draw_reopened
SMALL_STEPS = tuple(pair for pair in STEPS if pair[0] not in LARGE)


# --- sequences


@contextmanager
def small_sizes():
    """Have small what is in SMALL until the end of the block."""
    with ExitStack() as patches:
        for name, value in SMALL:
            patches.enter_context(mock.patch(name, value))
        yield


def check(seed, dtypes=DTYPES, *, small=False, shrinks=True):
    """Do a random sequence of edits; raise AssertionError, with a script that repeats it, for what fails.

    ``small`` ones are of few cells and without pictures.
    """
    with TemporaryDirectory(prefix="octex-edits-") as folder, small_sizes():
        run = Run(dtypes, Path(folder), 16 if small else 120)
        try:
            _drawn(np.random.default_rng(seed), run, small)
            return
        except Exception as error:
            failed = error
        steps = _shrunk(run, failed) if shrinks else run.steps
        lines = [f"from tests.properties.random_edits import {', '.join(sorted(vars_of_scripts()))}"]
        lines += [f"import {name.rpartition('.')[0]}; {name} = {value}" for name, value in SMALL]
        script = "\n".join(lines + [line for step in steps for line in step.lines])
        where = _where(failed)
    raise AssertionError(f"edits, seed {seed}: {failed}\n{where}\n\n{script}") from failed


def _drawn(random, run, small):
    steps = SMALL_STEPS if small else STEPS
    draws, shares = [draw for draw, _ in steps], np.array([share for _, share in steps], float)
    for step in first_steps(random, run, small):
        if not run.take(step):
            return
    for _ in range(int(random.integers(1, 4 if small else 7))):
        if not 1 <= run.texture.tree.n_leaves <= MOST_CELLS:
            return
        run.take(draws[random.choice(len(draws), p=shares / shares.sum())](random, run))


def kind_of(error):
    """What an error is, without its numbers: the same for those that have one cause."""
    return f"{type(error).__name__} {re.sub(r'[-+.]*[0-9][-+.e0-9]*', '#', str(error))[:50]}"


def _where(error):
    """The place in octex, or else in the tests, where an error was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [each for each in frames if "/octex/" in each.filename.replace("\\", "/")] or frames
    return f"{type(error).__name__} at {Path(own[-1].filename).name}:{own[-1].name}"


def _fails(steps, run, kind):
    again = Run(run.dtypes, run.folder, run.points)
    try:
        for step in steps:
            if not again.take(step):
                return False
    except Exception as error:
        return kind_of(error) == kind
    return False


def _shrunk(run, error):
    """Leave out steps as long as the rest fails alike."""
    steps, kind = list(run.steps), kind_of(error)
    at = len(steps) - 2
    while at > 0:
        fewer = steps[:at] + steps[at + 1 :]
        if _fails(fewer, run, kind):
            steps = fewer
        at -= 1
    return steps
