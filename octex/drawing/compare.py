"""Measures how two textures, or a texture and a model, differ over the surface.

Light is compared as sRGB codes: 255 · the sRGB curve of its linear value, continued above 1. Data are
compared unchanged, directions by component and by angle. Where both sides have alpha, their light is first
multiplied by it: invisible colours do not differ.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Floats, Int32s
from octex.baking.coordinates import areas_of, cell_of
from octex.channels import ChannelFormat, ColorSpace, linear_to_srgb
from octex.checks import as_choice, as_names, as_number, as_whole
from octex.errors import ArgumentError
from octex.parallel import Progress, as_progress
from octex.source.base import by_channel
from octex.source.parts import SEPARATION
from octex.source.surface import Surface
from octex.texture import FILTERS, OctreeTexture
from octex.tree.areas import AREAS
from octex.tree.morton import decode_cells
from octex.tree.octree import walk_leaves

_MOST_POINTS = 1 << 40
_WIDEST = 1e30
_BLOCK = 1 << 16
_LIGHT = ("srgb", "linear")
#: The unit of a channel's differences, by colour space.
MEASURES = {"srgb": "sRGB, 1/255", "linear": "sRGB, 1/255", "data": "0 to 1", "direction": "components"}
_ANGLE = "degrees"
#: The PSNR peak of each unit: the largest ordinary difference.
PEAKS = {"sRGB, 1/255": 255.0, "0 to 1": 1.0, "components": 2.0, _ANGLE: 180.0}
# Percentiles come from a histogram over the top 18 bits of a float32 after the sign: bins 0.1 % wide.
_CUT_BITS, _BINS = 13, 1 << 18


class Difference(NamedTuple):
    """The difference of one channel between a and b.

    The root mean square is over all components. The 99th percentile (to 0.1 %) and the maximum take the
    component that differs most at each point.
    """

    measure: str  # "sRGB, 1/255", "0 to 1", "components" (of directions) or "degrees"
    rms: float
    psnr: float  # 20 · log10(peak / rms) in dB, with the unit's peak (PEAKS); infinite for no difference
    p99: float
    maximum: float
    where: tuple[float, float, float]  # rest position of the maximum; the first of equal ones
    a: tuple[float, ...]  # the values there, in the unit ``measure``
    b: tuple[float, ...]
    angle: Difference | None = None  # of a direction channel: the angle between a and b


class Differences(dict[str, Difference]):
    """Differences by channel, and coverage.

    points        number of points compared
    width         averaging width at each point, in rest units; None without a model
    filter        the filter of the texture lookups
    unmatched     channels that only a has, and channels that only b has
    areas         rest areas of a and b, in square units; stored areas of textures are off by some percent
    uncovered     part of a's area where b has no surface, and the reverse; None for the part of a
                  texture's area that a model lacks: compare the areas instead
    """

    points: int
    width: float | None
    filter: str
    unmatched: tuple[tuple[str, ...], tuple[str, ...]]
    areas: tuple[float, float]
    uncovered: tuple[float | None, float | None]


class ComparedPoints(NamedTuple):
    """Points of a surface."""

    rest: Float64s  # (n, 3)   rest positions
    triangles: Int32s | None = None  # (n,)   triangles of the model, if there is one
    barycentric: Float64s | None = None  # (n, 3)

    def only(self, chosen: Bools) -> ComparedPoints:
        """Return the points that a mask selects."""
        return ComparedPoints(*(None if array is None else array[chosen] for array in self))  # type: ignore[arg-type]


#: A batch: the side that it samples (0 or 1), its points, the area that each represents (n,), and whether the
#: other side has a surface there (n,).
_Visit = tuple[int, ComparedPoints, Float64s, Bools]
Side = OctreeTexture | Surface
#: Returns values (n, components) of points by channel, in their units of comparison.
Reader = Callable[[ComparedPoints], dict[str, Float64s]]


def difference(
    a: Side,
    b: Side,
    *,
    channels: Sequence[str] | None = None,
    points: int = 1_000_000,
    width: float | None = None,
    filter: str = "quadratic",
    seed: int = 0,
    progress: Progress | None = None,
) -> Differences:
    """Measure how two textures, or a texture and a model, differ over the surface, channel by channel.

    a, b        two textures, or a texture and a model, in either order
    channels    names; default: all that both have
    points      with a model: number of points on it, uniform by posed area, the same for each ``seed``
    width       with a model: averaging width at each point, in rest units; default: the edge of the texture's
                finest cells, which blurs no lookup; 0: no averaging
    filter      filter of texture lookups, see ``OctreeTexture.sample``; ``nearest`` compares stored values

    Two textures are compared at the centre of every leaf of both, weighted by its area; they may differ in
    placement and depth. Values are compared only where both have a surface (within a finest cell);
    ``Differences.uncovered`` is the part left out.

    Memory does not grow with the number of points and leaves. Raises ArgumentError for two models, for an
    unknown filter, and for channels that one side lacks or that differ in meaning. Also for surfaces without
    a common part, and for textures whose parts were separated differently.
    """
    report = as_progress(progress)
    points = as_whole(points, "points", 1, _MOST_POINTS)
    seed = as_whole(seed, "seed", 0, _MOST_POINTS)
    for side in (a, b):
        if not isinstance(side, (Surface, OctreeTexture)):
            raise ArgumentError(f"compare octex.OctreeTexture and octex.Surface, not {side!r}")
    sides = placed(a, b)
    textures = [side for side in sides if isinstance(side, OctreeTexture)]
    models = [number for number, side in enumerate(sides) if isinstance(side, Surface)]
    if not textures:
        raise ArgumentError("two models cannot be compared with each other; convert one of them first")
    width = cell_of(textures[0]) if width is None else as_number(width, "width", 0.0, _WIDEST)
    width = width if models else 0.0
    spaces, readers = readers_of(sides, channels, width, filter)
    total = points if models else sum(texture.tree.n_leaves for texture in textures)
    batches = _model_visits(sides, models[0], points, seed) if models else _leaf_visits(textures)

    sums = {name: _DifferenceSums(MEASURES[space]) for name, space in spaces.items()}
    angles = {name: _DifferenceSums(_ANGLE) for name, space in spaces.items() if space == "direction"}
    areas, uncovered = np.zeros(2), np.zeros(2)
    done = compared = 0
    report("compare", 0, total)
    for number, batch, weights, covered in batches:
        areas[number] += weights.sum()
        uncovered[number] += weights[~covered].sum()
        common, common_weights = batch.only(covered), weights[covered]
        if len(common_weights):
            values_a, values_b = (read(common) for read in readers)
            for name, u in values_a.items():
                v = values_b[name]
                if not np.isfinite(v - u).all():
                    raise ArgumentError(
                        f"channel {name!r} has values that are not finite; validate the textures"
                    )
                sums[name].add(common.rest, common_weights, v - u, u, v)
                if name in angles:
                    angles[name].add(common.rest, common_weights, degrees_between(u, v)[:, None], u, v)
        compared += len(common_weights)
        done += len(weights)
        report("compare", done, total)
    if not compared:
        raise ArgumentError("the surfaces do not overlap: do they have the same rest positions?")

    results = Differences()
    for name in spaces:
        angle = angles[name].result() if name in angles else None
        results[name] = sums[name].result()._replace(angle=angle)
    results.points, results.width, results.filter = compared, width if models else None, filter
    formats_a, formats_b = (formats_of(side) for side in sides)
    results.unmatched = (
        tuple(name for name in formats_a if name not in formats_b),
        tuple(name for name in formats_b if name not in formats_a),
    )
    parts = [float(uncovered[n] / areas[n]) if not models or n in models else None for n in (0, 1)]
    results.uncovered = parts[0], parts[1]
    if models:
        areas = np.array([_area(side) for side in sides])
    results.areas = float(areas[0]), float(areas[1])
    return results


def formats_of(side: Side) -> dict[str, ChannelFormat]:
    """Return the channel formats of a texture or a model, by name."""
    if isinstance(side, Surface):
        return {channel.name: channel for channel in side.channels}
    return {name: channel.format for name, channel in side.channels.items()}


def reader_of(side: Side, spaces: dict[str, ColorSpace], fades: bool, width: float, filter: str) -> Reader:
    """Return a reader of a side's channels, light multiplied by alpha if it ``fades``."""
    names = [*spaces, *(["alpha"] if fades and "alpha" not in spaces else [])]
    if isinstance(side, Surface):
        side = side.with_channels(names)

    def read(points: ComparedPoints) -> dict[str, Float64s]:
        values: Mapping[str, Float32s]
        if isinstance(side, OctreeTexture):
            footprint = width if width > cell_of(side) else None  # no lookup is sharper
            values = side.sample(points.rest, names, filter, width=footprint, normalize=False)
        else:
            assert points.triangles is not None and points.barycentric is not None
            widths = np.full(len(points.rest), width, np.float32)
            rows = side.evaluate_all(points.triangles, points.barycentric, widths)
            values = by_channel(side.channels, rows)
        measured = {}
        for name, space in spaces.items():
            measured[name] = np.asarray(values[name], np.float64)
            if space in _LIGHT:
                light = measured[name] * values["alpha"] if fades else measured[name]
                measured[name] = 255 * linear_to_srgb(light)
        return measured

    return read


def placed(a: Side, b: Side) -> tuple[Side, Side]:
    """Return both sides, with a model in the texture's rest pose; refuse parts separated differently."""
    if isinstance(a, Surface):
        return (a.placed_in(b), b) if isinstance(b, OctreeTexture) else (a, b)
    if isinstance(b, Surface):
        return a, b.placed_in(a)
    if a.metadata.get(SEPARATION) != b.metadata.get(SEPARATION):
        raise ArgumentError(
            "parts of these textures' surfaces were separated by different distances; compare each with its "
            "model"
        )
    return a, b


def in_common(a: Side, b: Side) -> tuple[Side, Side]:
    """Return both sides reduced to their common channels; refuse sides without one."""
    names = [name for name in formats_of(a) if name in formats_of(b)]

    def restricted(side: Side) -> Side:
        if isinstance(side, Surface):
            return side.with_channels(names)
        return side.with_cells(side.tree, {name: side.channels[name] for name in names})

    return restricted(a), restricted(b)


def readers_of(
    sides: tuple[Side, Side], channels: Sequence[str] | None, width: float, filter: str
) -> tuple[dict[str, ColorSpace], list[Reader]]:
    """Return the colour spaces of channels, by default all common ones, and a reader of each side.

    Values are averaged over ``width``.
    """
    as_choice(filter, FILTERS, "filter")
    formats_a, formats_b = (formats_of(side) for side in sides)
    common = [name for name in formats_a if name in formats_b]
    names = common if channels is None else as_names(channels, "channels")
    if not common or not names:
        raise ArgumentError(
            f"no channel to compare: one has {', '.join(formats_a) or 'none'}, "
            f"the other {', '.join(formats_b) or 'none'}"
        )
    spaces: dict[str, ColorSpace] = {}
    for name in names:
        as_choice(name, common, "channel in both")
        meanings = [(MEASURES[form.space], form.components) for form in (formats_a[name], formats_b[name])]
        if meanings[0] != meanings[1]:
            one, other = (f"{components} components ({measure})" for measure, components in meanings)
            raise ArgumentError(f"channel {name!r} has {one} on one side and {other} on the other")
        spaces[name] = formats_a[name].space
    fades = "alpha" in common and any(space in _LIGHT for space in spaces.values())
    return spaces, [reader_of(side, spaces, fades, width, filter) for side in sides]


def _model_visits(sides: tuple[Side, Side], number: int, points: int, seed: int) -> Iterator[_Visit]:
    """Yield batches of points on the model, uniform by posed area."""
    surface, texture = sides[number], sides[1 - number]
    assert isinstance(surface, Surface) and isinstance(texture, OctreeTexture)
    lies_on = inside_cells(texture)
    for first in range(0, points, _BLOCK):
        block_seed = int(np.random.SeedSequence([seed, first]).generate_state(1, np.uint64)[0])
        samples = surface.scatter(min(_BLOCK, points - first), block_seed)
        covered = lies_on(samples.rest)
        on_model = ComparedPoints(samples.rest, samples.triangles, samples.barycentric)
        yield number, on_model, np.ones(len(samples.rest)), covered


def _leaf_visits(textures: Sequence[OctreeTexture]) -> Iterator[_Visit]:
    for number in (0, 1):
        lies_on = inside_cells(textures[1 - number])
        for centres, edges, areas in _leaves(textures[number]):
            yield number, ComparedPoints(centres), areas, lies_on(centres, edges)


def _leaves(texture: OctreeTexture) -> Iterator[tuple[Float64s, Float64s, Float64s]]:
    """Yield centres (n, 3), edges (n,) and areas (n,) of all leaves, in rest units."""
    for cells, codes, depths in walk_leaves(texture.tree.arrays, _BLOCK):
        edges = np.ldexp(1.0, -depths.astype(np.int32))
        centres = texture.placement.to_rest((decode_cells(codes) + 0.5) * edges[:, None])
        edges *= texture.placement.size
        yield centres, edges, AREAS[texture.tree.arrays.areas[cells]] * edges**2


def _area(side: Side) -> float:
    if isinstance(side, Surface):
        return float(areas_of(side).sum())
    return sum(float(areas.sum()) for _, _, areas in _leaves(side))


def inside_cells(texture: OctreeTexture) -> Callable[..., Bools]:
    """Return a function that tells which cubes, by default finest cells, meet a leaf."""
    level_of = cache(texture.level)
    # Shrink cubes by this much, so that rounding does not move upper corners into the next cell.
    inset = texture.placement.size * 2.0**-29

    def lies_on(centres: Floats, edges: Floats | None = None) -> Bools:
        meets_leaf = np.zeros(len(centres), np.bool_)
        edges = np.full(len(centres), cell_of(texture)) if edges is None else edges
        for edge in np.unique(edges):
            # A cell that meets a cube, and is no smaller, holds one of the cube's corners.
            level = int(np.clip(np.floor(np.log2(texture.placement.size / edge) + 1e-9), 0, 21))
            coarse = level_of(min(level, texture.tree.max_depth))
            rows = np.flatnonzero(edges == edge)
            for corner in np.ndindex(2, 2, 2):
                offset = (np.array(corner) - 0.5) * (edge - 2 * inset)
                is_in_leaf = coarse.contains(centres[rows] + offset)
                meets_leaf[rows[is_in_leaf]] = True
                rows = rows[~is_in_leaf]
        return meets_leaf

    return lies_on


def degrees_between(a: Floats, b: Floats) -> Float64s:
    """Return the angles (n,) between directions (n, 3) of any length; 0 for a zero vector."""
    across = np.linalg.norm(np.cross(a, b), axis=1)
    return np.asarray(np.degrees(np.arctan2(across, (a * b).sum(axis=1))))


class _DifferenceSums:
    """Accumulates the differences of a channel."""

    def __init__(self, measure: str) -> None:
        self.measure = measure
        self.squares = self.weight = 0.0
        self.histogram = np.zeros(_BINS)
        self.maximum = -1.0
        self.at: tuple[Floats, Floats, Floats]

    def add(self, rest: Floats, weights: Floats, differences: Floats, a: Floats, b: Floats) -> None:
        """Add points (n, 3) with weights (n,), differences and values (n, components)."""
        self.weight += float(weights.sum())
        self.squares += float(weights @ (differences**2).mean(axis=1))
        largest = np.abs(differences).max(axis=1)
        bins = largest.astype(np.float32).view(np.uint32) >> _CUT_BITS
        self.histogram += np.bincount(bins, weights, _BINS)
        n = int(largest.argmax())
        if largest[n] > self.maximum:
            self.maximum = float(largest[n])
            self.at = rest[n].copy(), a[n].copy(), b[n].copy()

    def result(self) -> Difference:
        rms = float(np.sqrt(self.squares / self.weight))
        # The first bin where the cumulative weight reaches 99 %.
        reached = np.searchsorted(np.cumsum(self.histogram), 0.99 * self.histogram.sum())
        p99 = np.array([reached << _CUT_BITS], np.uint32).view(np.float32)[0]
        x, y, z = self.at[0].tolist()
        return Difference(
            self.measure,
            rms,
            float(20 * np.log10(PEAKS[self.measure] / rms)) if rms > 0 else np.inf,
            float(p99),
            self.maximum,
            (x, y, z),
            tuple(self.at[1].tolist()),
            tuple(self.at[2].tolist()),
        )
