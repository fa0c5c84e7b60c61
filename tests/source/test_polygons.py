"""The polygons of files, remembered by the triangles that they were cut into."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex.errors import ArgumentError, ModelError, ModelWarning
from octex.source.corners import Polygons
from octex.source.load import load_surface
from octex.source.mesh import Mesh
from octex.source.surface import Surface
from tests.make.fixtures import obj, obj_lines, ply

# A triangle, a quad, a line of no area's worth of corners, a concave pentagon, a hexagon.
PLACES = [(x, y, (x * y) % 2) for y in range(3) for x in range(4)]
FACES = [[0, 1, 5], [5, 4, 8, 9], [2, 3], [1, 2, 6, 5, 2], [10, 9, 5, 6, 7, 11]]
CORNERS_OF = {number: face for number, face in enumerate(FACES) if len(face) > 2}


def file_faces(path):
    """The vertices of each face of an OBJ file, by its number among them, in plain Python."""
    faces = {}
    vertices = number = 0
    for line in path.read_text("latin-1").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices += 1
        elif words[:1] == ["f"]:
            given = [int(word.split("/")[0]) for word in words[1:]]
            if len(given) > 2:
                faces[number] = [place - 1 if place > 0 else vertices + place for place in given]
            number += 1
    return faces


def loops_of(mesh):
    """The vertices of each polygon, by its number."""
    numbers, sizes, vertices = mesh.loops()
    assert len(vertices) == sizes.sum()
    parts = np.split(vertices, np.cumsum(sizes)[:-1])
    return {number: part.tolist() for number, part in zip(numbers.tolist(), parts, strict=True)}


def written(folder, kind):
    """The faces above as a file."""
    if kind == "obj":
        return obj(folder / "a.obj", obj_lines(PLACES, FACES))
    if kind == "off":
        path = folder / "a.off"
        lines = [f"OFF\n{len(PLACES)} {len(FACES)} 0", *(f"{x} {y} {z}" for x, y, z in PLACES)]
        path.write_text("\n".join([*lines, *(f"{len(f)} {' '.join(map(str, f))}" for f in FACES)]))
        return path
    elements = {
        "vertex": {axis: ("float", [place[i] for place in PLACES]) for i, axis in enumerate("xyz")},
        "face": {"vertex_indices": ("list uchar int", FACES)},
    }
    return ply(folder / "a.ply", elements, encoding=kind)


@pytest.mark.parametrize("kind", ["obj", "off", "ascii", "binary_little_endian", "binary_big_endian"])
def test_every_file_keeps_its_polygons_with_their_corners_in_order(tmp_path, kind):
    surface = load_surface(written(tmp_path, kind))
    assert loops_of(surface) == CORNERS_OF
    numbers, corners = surface.polygons or pytest.fail("no polygons")
    assert numbers.dtype == corners.dtype == np.int32
    assert numbers.tolist() == [number for number, face in CORNERS_OF.items() for _ in face[2:]]
    for number, places, vertices in zip(numbers, corners, surface.triangles, strict=True):
        assert [FACES[number][place] for place in places] == vertices.tolist()


def test_real_polygons_are_those_that_their_files_list(models):
    cut = 0
    for path in sorted(models.rglob("*.obj")):
        try:
            surface = load_surface(path, channels=["alpha"], sources={"alpha": 1.0})
        except (ModelError, ModelWarning):
            continue
        assert loops_of(surface) == file_faces(path), path
        cut += surface.polygons is not None
    assert cut > 0


def test_each_triangle_of_a_mesh_of_triangles_is_a_polygon(tmp_path):
    surface = load_surface(obj(tmp_path / "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 4 3 2\n"))
    assert surface.polygons is None
    assert loops_of(surface) == {0: [0, 1, 2], 1: [3, 2, 1]}


def test_what_is_made_of_a_surface_keeps_its_polygons_also_parts_moved_apart(tmp_path):
    surface = load_surface(written(tmp_path, "obj"))
    moved = surface.with_rest(surface.rest + 1.0)
    for other in (moved, surface.with_sources({"roughness": 0.5})):
        assert loops_of(other) == CORNERS_OF
    lines = "".join(f"v {x} {y} {z}\n" for z in (0, 0.01) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
    surface = load_surface(obj(tmp_path / "a.obj", lines + "f 1 2 3 4\nf 5 6 7 8\n"))
    apart = surface.separated(0.1)
    assert not np.array_equal(apart.rest, surface.rest)
    assert loops_of(apart) == {0: [0, 1, 2, 3], 1: [4, 5, 6, 7]}


def test_joined_surfaces_number_their_polygons_on(tmp_path):
    surface = load_surface(written(tmp_path, "obj"))
    plain = Surface.from_arrays(np.eye(3), [[0, 1, 2]])
    assert Surface.joined([plain, plain]).polygons is None
    expected = {0: [0, 1, 2]}
    expected |= {1 + number: [3 + vertex for vertex in face] for number, face in CORNERS_OF.items()}
    expected |= {6: [15, 16, 17]}
    assert loops_of(Surface.joined([plain, surface, plain])) == expected


@given(st.data())
def test_some_triangles_keep_the_numbers_of_their_polygons(data):
    sizes = data.draw(st.lists(st.integers(3, 7), min_size=1, max_size=6))
    numbers = np.repeat(np.arange(len(sizes)), np.array(sizes) - 2)
    fans = [(0, i + 1, i + 2) for size in sizes for i in range(size - 2)]
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    first = np.cumsum(sizes) - sizes
    names = rng.permutation(sum(sizes))
    mesh = Mesh(
        rng.random((len(names), 3)),
        names[first[numbers][:, None] + fans],
        polygons=Polygons(numbers.astype(np.int32), np.array(fans, np.int32)),
    )
    chosen = data.draw(st.lists(st.integers(0, len(fans) - 1), min_size=1))
    picked, _, vertices = mesh.picked(chosen)
    expected = {}
    for triangle in chosen:
        expected.setdefault(int(numbers[triangle]), set()).update(fans[triangle])
    assert {number: vertices[loop].tolist() for number, loop in loops_of(picked).items()} == {
        number: names[first[number] + sorted(corners)].tolist() for number, corners in expected.items()
    }


@pytest.mark.parametrize(
    "polygons",
    [
        np.zeros(1),
        Polygons(np.zeros(2, np.int32), np.zeros((1, 3), np.int32)),
        Polygons(np.zeros(1, np.int32), np.zeros(3, np.int32)),
        Polygons(np.zeros(1, np.float32), np.zeros((1, 3), np.int32)),
        Polygons(np.full(1, -1, np.int32), np.zeros((1, 3), np.int32)),
    ],
)
def test_polygons_that_do_not_fit_are_refused(polygons):
    with pytest.raises(ArgumentError, match="surface: polygons must be"):
        Mesh(np.eye(3), [[0, 1, 2]], polygons=polygons)
