"""Subdivision surfaces: their levels, their limits, and what they take along of a cage."""

import numpy as np
import pytest

import octex
from octex.errors import ArgumentError, ModelError
from octex.source.corners import Polygons
from octex.source.subdivision import base_level, divided, limits
from tests.make.fixtures import obj_lines
from tests.oracles.naive_subdivision import base, next_level

CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
#: An open fan of a triangle, a quad and a pentagon about vertex 0, and a second sheet.
MIXED = [(0, 1, 2), (0, 2, 3, 4), (0, 4, 5, 6, 7), (7, 6, 8), (1, 0, 7, 9)]
TRIANGLES = [(a, b, c) for q in QUADS for a, b, c in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))]


def level_of(points, faces, creases=None, spikes=None):
    creases, spikes = creases or {}, spikes or {}
    corners = np.concatenate([np.array(each) for each in faces]).astype(np.int64)
    sizes = np.array([len(each) for each in faces], np.int64)
    edges = np.array(list(creases), np.int64).reshape(-1, 2)
    return base_level(
        points, corners, sizes, np.zeros((len(corners), 2)),
        (edges, np.array(list(creases.values()), np.float64)),
        (np.array(list(spikes), np.int64), np.array(list(spikes.values()), np.float64)),
    )  # fmt: skip


def cage_of(points, faces):
    """A surface of polygons cut into fans."""
    triangles, numbers, corners = [], [], []
    for number, face in enumerate(faces):
        for k in range(1, len(face) - 1):
            triangles.append((face[0], face[k], face[k + 1]))
            numbers.append(number)
            corners.append((0, k, k + 1))
    surface = octex.Surface.from_arrays(points, triangles, colors=np.clip((points + 1) / 2, 0, 1))
    polygons = Polygons(np.array(numbers, np.int32), np.array(corners, np.int32))
    return octex.Surface(
        surface.vertices, surface.triangles, surface.source, polygons=polygons, name="cage"
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("scheme", ["catmull-clark", "loop"])
def test_levels_are_the_naive_ones(scheme, seed):
    random = np.random.default_rng(seed)
    if seed % 2:
        faces, count = (TRIANGLES if scheme == "loop" else QUADS), 8
    else:
        faces, count = ([f for f in TRIANGLES if 7 not in f] if scheme == "loop" else MIXED), 10
        count = 7 if scheme == "loop" else count
    points = random.normal(size=(count, 3))
    pairs = {tuple(sorted(e)) for f in faces for e in zip(f, f[1:] + f[:1], strict=True)}
    chosen = [each for each in sorted(pairs) if random.random() < 0.5]
    creases = {each: float(random.choice([0.3, 0.8, 1.0, 1.7, 2.5, 10.0])) for each in chosen}
    spikes = {0: 1.4} if seed > 2 else {}
    naive = base(points, faces, creases, spikes)
    level = level_of(points, faces, creases, spikes)
    for _ in range(3):
        naive, level = next_level(naive, scheme == "loop"), divided(level, scheme)
        np.testing.assert_allclose(level.values[:count], naive[0][:count], atol=1e-12)
        found = {tuple(np.round(each, 9)) for each in level.values}
        assert found == {tuple(np.round(each, 9)) for each in naive[0]}
        assert len(level.sizes) == len(naive[1])


def double_fan(n, scheme):
    """The faces of a closed mesh of two vertices with n edges each: triangles, or quads that interlock."""
    if scheme == "loop":
        ring = [(2 + i, 2 + (i + 1) % n) for i in range(n)]
        return n + 2, [(a, b, 0) for a, b in ring] + [(b, a, 1) for a, b in ring]
    ring = [[2 + (2 * i + k) % (2 * n) for k in range(4)] for i in range(n)]
    return 2 * n + 2, [(0, *r[:3]) for r in ring] + [(1, *r[:0:-1]) for r in ring]


@pytest.mark.parametrize("n", [0, 3, 5, 8])
@pytest.mark.parametrize("scheme", ["catmull-clark", "loop"])
def test_a_limit_is_the_same_from_every_level(scheme, n):
    random = np.random.default_rng(3)
    count, faces = double_fan(n, scheme) if n else (8, TRIANGLES if scheme == "loop" else QUADS)
    # Of the cube, a line for good, one that fades, and one that ends: a dart.
    creases = {} if n else {(0, 1): 10.0, (1, 3): 10.0, (4, 6): 2.3, (5, 7): 0.6, (2, 6): 10.0}
    points = random.normal(size=(count, 3))
    level = divided(level_of(points, faces, creases, {} if n else {5: 1.5}), scheme)
    count, first = len(level.values), limits(level, scheme)
    for _ in range(4):
        level = divided(level, scheme)
        np.testing.assert_allclose(limits(level, scheme)[:count], first, atol=1e-9)
    for _ in range(3):
        level = divided(level, scheme)
    np.testing.assert_allclose(level.values[:count], first, atol=2e-3)


@pytest.mark.parametrize("faces", [QUADS, [f for f in QUADS if 7 not in f], TRIANGLES, MIXED])
def test_hull_coordinates_lie_on_the_cage_and_take_its_source_along(faces):
    points = CUBE if faces is not MIXED else np.random.default_rng(1).normal(size=(10, 3))
    if faces is MIXED:
        points[:, 2] = 0  # pentagons that are flat
    cage = cage_of(points, faces)
    made = octex.subdivide(cage, 2)
    samples = made.scatter(300)
    near, place, _ = nearest(cage, samples.rest)
    np.testing.assert_allclose(place, samples.rest, atol=1e-9)
    if faces is not MIXED:
        colors = np.clip((samples.rest + 1) / 2, 0, 1)
        np.testing.assert_allclose(made.evaluate(samples), colors, atol=1e-6)
    assert made.polygons is None or len(np.unique(made.polygons.numbers)) == len(made.triangles) / 2
    assert made.bounds[0] == pytest.approx(cage.bounds[0])
    limit = octex.subdivide(cage, 2, rest="limit")
    assert limit.rest is limit.vertices
    np.testing.assert_array_equal(limit.vertices, made.vertices)
    np.testing.assert_allclose(limit.evaluate(limit.scatter(300)), made.evaluate(samples), atol=1e-6)
    assert len(near)


def nearest(cage, points):
    """The triangle nearest to each point, where on it, and how far, one by one."""
    best = np.full(len(points), np.inf)
    place, number = points.copy(), np.zeros(len(points), int)
    for t, triangle in enumerate(cage.rest[cage.triangles]):
        a, sides = triangle[0], (triangle[1:] - triangle[0]).T
        shares = (points - a) @ np.linalg.pinv(sides).T
        shares = np.clip(shares, 0, 1)
        shares /= np.maximum(shares.sum(axis=1, keepdims=True), 1)
        found = a + shares @ sides.T
        distance = np.linalg.norm(found - points, axis=1)
        closer = distance < best
        best[closer], place[closer], number[closer] = distance[closer], found[closer], t
    return number, place, best


def test_texture_coordinates_go_along_linearly(tmp_path):
    lines = [f"v {x} {y} {z}" for x, y, z in CUBE] + [f"vt {0.2 * n} {n % 3}" for n in range(5)]
    lines += [f"f {' '.join(f'{v + 1}/{(v + k) % 5 + 1}' for k, v in enumerate(q))}" for q in QUADS]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    cage = octex.load_surface(tmp_path / "a.obj")
    made = octex.subdivide(cage, 3)
    samples = made.scatter(200)
    found = made.uv.at(samples.triangles, samples.barycentric)
    number, place, _ = nearest(cage, samples.rest)
    corners = cage.rest[cage.triangles[number]]
    shares = np.linalg.solve(corners.transpose(0, 2, 1) + 1e-13, place[..., None])[..., 0]
    np.testing.assert_allclose(found, cage.uv.at(number, shares), atol=1e-5)


def test_a_posed_cage_keeps_its_own_rest_positions():
    cage = cage_of(CUBE, QUADS)
    posed = octex.Surface(
        2 * CUBE, cage.triangles, cage.source, rest=CUBE, polygons=cage.polygons, name="posed"
    )
    hull, limit = (octex.subdivide(posed, 2, rest=rest) for rest in ("hull", "limit"))
    np.testing.assert_allclose(hull.rest, octex.subdivide(cage, 2).rest, atol=1e-12)
    np.testing.assert_allclose(limit.vertices, 2 * limit.rest, atol=1e-12)


def test_creases_come_from_tags_and_may_be_given(tmp_path):
    tags = ["t crease 2/1/0 0 1 2.5", "t interpolateboundary 1/0/0 2", "t corner 1/1/0 7 10.0"]
    path = tmp_path / "a.obj"
    path.write_text(obj_lines(CUBE, QUADS) + "\n".join(tags))
    cage = octex.load_surface(path)
    assert cage.creases.edges.tolist() == [[0, 1]]
    sharp = octex.subdivide(cage, 3)
    np.testing.assert_allclose(sharp.vertices[7], CUBE[7])
    naive = level_of(CUBE, QUADS, {(0, 1): 2.5}, {7: 10.0})
    for _ in range(3):
        naive = divided(naive, "catmull-clark")
    np.testing.assert_allclose(sharp.vertices, limits(naive, "catmull-clark"), atol=1e-12)
    none = octex.Creases(
        np.empty((0, 2), np.int32), np.empty(0, np.float32), np.empty(0, np.int32), np.empty(0, np.float32)
    )
    smooth = octex.subdivide(cage, 3, creases=none)
    np.testing.assert_allclose(smooth.vertices, octex.subdivide(cage_of(CUBE, QUADS), 3).vertices, atol=1e-12)
    some = cage.part([0, 1])
    assert len(some.creases.edges) == 1
    assert len(some.creases.vertices) == 0
    for tag in (
        "crease 2/1/0 0 99 1",
        "crease 2/1/0 0 1",
        "crease 2/1 0 1 1",
        "corner 1/1/0 x 1",
        "corner 1/1/0 1 nan",
    ):
        path.write_text(obj_lines(CUBE, QUADS) + f"t {tag}")
        with pytest.raises(ModelError, match="is not a crease tag"):
            octex.load_surface(path)


def test_what_cannot_be_subdivided_is_refused():
    cage = cage_of(CUBE, QUADS)
    for arguments, message in (
        ({"levels": 0}, "levels must be a whole number from 1 to 10"),
        ({"levels": 1, "rest": "cage"}, "unknown rest 'cage'; there are: hull, limit"),
        ({"levels": 1, "scheme": "bilinear"}, "unknown scheme"),
        ({"levels": 1, "creases": [1]}, "creases must be"),
    ):
        with pytest.raises(ArgumentError, match=message):
            octex.subdivide(cage, **arguments)
    with pytest.raises(ArgumentError, match=r"mesh must be an octex\.Surface"):
        octex.subdivide(CUBE, 1)
    with pytest.raises(ModelError, match="which Loop's scheme does not support"):
        octex.subdivide(cage, 1, scheme="loop")
    wide = octex.Surface.from_arrays(np.eye(3), np.tile([[0, 1, 2]], (1000, 1)))
    with pytest.raises(ModelError, match="10 levels make more than"):
        octex.subdivide(wide, 10)
    nothing = np.empty(0)
    for edges in ([[0, 9]], [[0, -1]], [[0, 0.5]], [[0]]):
        wrong = octex.Creases(np.array(edges), np.ones(1), nothing, nothing)
        with pytest.raises(ArgumentError, match=r"creases"):
            octex.subdivide(cage, 1, creases=wrong)
    spiky = octex.Creases(np.empty((0, 2)), nothing, np.array([3]), np.array([np.nan]))
    with pytest.raises(ArgumentError, match="sharpness of vertices"):
        octex.subdivide(cage, 1, creases=spiky)


def test_levels_are_those_of_opensubdiv(models):
    folder = models / "opensubdiv-cages"
    cage = octex.load_surface(folder / "obj" / "catmark_cube_creases0.obj")
    reference = octex.load_surface(folder / "catmark_cube_creases0_level4.obj").vertices
    creases = {
        (int(a), int(b)): float(s)
        for (a, b), s in zip(cage.creases.edges, cage.creases.sharpness, strict=True)
    }
    known, sizes, vertices = cage.loops()
    faces = [tuple(each) for each in np.split(vertices, np.cumsum(sizes)[:-1])]
    level = level_of(cage.vertices, faces, creases)
    for _ in range(5):
        level = divided(level, "catmull-clark")
    found = level.values[np.lexsort(np.round(level.values, 4).T)]
    wanted = reference[np.lexsort(np.round(reference, 4).T)]
    distances = [np.abs(level.values - each).max(axis=1).min() for each in wanted[::7]]
    assert len(found) == len(wanted)
    assert max(distances) < 1e-6
    assert len(known)


def test_subdiv_levels_is_an_option(tmp_path, cli):
    path, out = tmp_path / "a.obj", tmp_path / "a.octex"
    path.write_text(obj_lines(CUBE, QUADS))
    cli.result(path, out, "--subdiv", "2,limit", "--depth", 3)
    expected = octex.convert(octex.subdivide(octex.load_surface(path), 2, rest="limit"), 3)
    assert octex.open(out).tree.n_leaves == expected.tree.n_leaves
