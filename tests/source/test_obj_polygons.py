"""Polygons of OBJ files are cut into triangles."""

import numpy as np
import pytest

from octex.errors import ModelError
from octex.source.load import load_surface
from tests.make.agreement import assert_agrees
from tests.make.fixtures import obj


def test_convex_polygons_become_fans(tmp_path):
    lines = "v 0 0 0\nv 2 0 0\nv 3 1 0\nv 2 2 0\nv 0 2 0\nf 1 2 3 4 5\nf 1 2 4 5\nf 1 2\nf 1\n"
    surface = assert_agrees(obj(tmp_path / "a.obj", lines))
    np.testing.assert_array_equal(surface.triangles, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 1, 3], [0, 3, 4]])


def crescent(corners):
    """A "C" of so many corners, whose opening is to the right."""
    angles = np.linspace(0.15, 1.85, corners // 2) * np.pi
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([ring, 0.5 * ring[::-1]])


def shoelace(ring):
    """The area of a polygon without holes."""
    after = np.roll(ring, -1, axis=0)
    return float(abs((ring[:, 0] * after[:, 1] - ring[:, 1] * after[:, 0]).sum()) / 2)


@pytest.mark.parametrize(
    "ring",
    [
        np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)]),
        np.array([(0, 0), (4, 2), (0, 4), (1, 2)])[::-1],
        np.array([(0, 0), (4, 0), (4, 4), (3, 1), (2, 4), (1, 1), (0, 4)]),
        crescent(514),
        crescent(3000)[::-1],
        # Corners twice; a hole reached by a slit; two parts that touch at a corner; a spike of no area.
        np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 1), (1, 1), (1, 3), (0, 3), (0, 3)]),
        np.array([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)]),
        np.array([(0, 0), (2, 0), (1, 1), (2, 2), (0, 2), (1, 1)]),
        np.array([(0, 0), (3, 0), (3, 3), (5, 5), (3, 3), (0, 3)]),
    ],
    ids=["L", "dart", "crown", "C of 514", "C of 3000", "repeated", "hole", "touching", "spike"],
)
@pytest.mark.parametrize("turned", [0, 1, 2, 3, 4, 5])
def test_a_polygon_of_any_size_and_form_is_covered_once(tmp_path, ring, turned):
    ring = np.roll(ring, turned, axis=0)
    lines = "".join(f"v {x!r} {y!r} {2 * x!r}\n" for x, y in ring.tolist())
    path = obj(tmp_path / "a.obj", lines + "f " + " ".join(str(i + 1) for i in range(len(ring))) + "\n")
    surface = load_surface(path)
    assert len(surface.triangles) == len(ring) - 2
    np.testing.assert_allclose(surface.areas().sum(), shoelace(ring) * 5**0.5, rtol=1e-9)


def test_a_polygon_that_is_not_flat_is_cut_along_its_area_vector(tmp_path):
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1) * (1 + 0.3 * np.cos(5 * angles))[:, None]
    lines = "".join(f"v {x} {y} {0.1 * np.cos(2 * a)}\n" for (x, y), a in zip(ring, angles, strict=True))
    surface = load_surface(obj(tmp_path / "a.obj", lines + f"f {' '.join(map(str, range(1, 41)))}\n"))
    seen = np.cross(*np.moveaxis(np.diff(surface.vertices[surface.triangles], axis=1), 1, 0))[:, 2] / 2
    assert (seen >= 0).all()
    np.testing.assert_allclose(seen.sum(), shoelace(ring))


def test_large_polygons_that_are_not_finite_are_refused(tmp_path):
    lines = "v nan 0 0\n" + "".join(f"v {x} {y} 0\n" for x, y in crescent(600))
    with pytest.raises(ModelError, match="not all finite"):
        load_surface(obj(tmp_path / "a.obj", lines + f"f {' '.join(map(str, range(1, 601)))}\n"))


def test_polygons_that_cross_themselves_still_give_their_triangles(tmp_path):
    lines = "v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 1 0\nv 2 2 0\nf 1 2 3 4\nf 1 2 3 4 5\nf 1 1 1 1 1\n"
    assert len(load_surface(obj(tmp_path / "a.obj", lines)).triangles) == 2 + 3 + 3
