"""One texture over several surfaces."""

import json

import numpy as np
import pytest

import octex
from octex.channels import ALPHA
from octex.errors import ArgumentError
from octex.source.surface import Surface
from tests.make.painted import plain, square
from tests.make.small_surfaces import FACES, TETRAHEDRON, FaceSource, tetrahedron, whole


def test_each_surface_keeps_its_own_values_in_one_texture():
    one = tetrahedron(name="one")
    other = Surface.from_arrays(
        TETRAHEDRON + np.array([2, 0, 0]), FACES, colors=np.full((4, 3), 0.5), name="other"
    )
    texture = octex.convert([one, other], 6)
    texture.validate()
    for surface in (one, other):
        samples = surface.scatter(300)
        assert texture.contains(samples.rest).all()
        assert np.abs(texture.sample(samples.rest) - surface.evaluate(samples)).mean() < 0.01
    assert json.loads(texture.metadata["sources"]) == ["one", "other"]


def test_joined_is_what_the_same_triangles_are_as_one_surface():
    a, b = plain(square(0.0)), plain(square(0.5))
    together = octex.convert([a, b], 5)
    vertices = np.concatenate([a.vertices, b.vertices])
    faces = np.concatenate([a.triangles, b.triangles + len(a.vertices)])
    whole_surface = octex.convert(plain((vertices, faces)), 5)
    assert np.array_equal(together.tree.arrays.groups, whole_surface.tree.arrays.groups)
    assert np.array_equal(together.channels["base_color"].values, whole_surface.channels["base_color"].values)


def test_channels_that_a_surface_does_not_state_are_what_materials_give():
    bare, rich = tetrahedron(), whole()
    made = Surface.joined([bare, rich])
    assert [form.name for form in made.channels] == [form.name for form in rich.channels]
    samples = made.scatter(200)
    first = samples.triangles < len(bare.triangles)
    assert (made.evaluate(samples, "roughness")[first] == 1).all()
    assert (made.evaluate(samples, "emissive")[first] == 0).all()
    np.testing.assert_allclose(made.evaluate(samples, "normal")[first], samples.normals[first], atol=1e-6)
    own = samples._replace(
        triangles=samples.triangles[~first] - np.int32(len(bare.triangles)),
        barycentric=samples.barycentric[~first],
    )
    for form in rich.channels:
        np.testing.assert_allclose(
            made.evaluate(samples, form.name)[~first], rich.evaluate(own, form.name), atol=1e-6
        )
    only = made.with_channels(["roughness"])
    assert (only.evaluate(samples, "roughness") == made.evaluate(samples, "roughness")).all()


def test_rest_positions_and_filters_reach_every_part():
    a, b = tetrahedron(), tetrahedron(rest=TETRAHEDRON + np.array([3.0, 0.0, 0.0]))
    made = Surface.joined([a, b]).with_filter("nearest")
    assert np.array_equal(made.rest, np.concatenate([a.rest, b.rest]))
    moved = made.with_rest(made.rest * 2)
    samples = moved.scatter(20)
    assert np.allclose(moved.evaluate(samples), made.evaluate(samples))
    assert (made.source.texel_edges(np.array([0, 5], np.int32)) == np.inf).all()


def test_a_part_with_gaps_leaves_the_others_whole():
    source = FaceSource((ALPHA,), np.zeros((4, 1)))
    clear = Surface(TETRAHEDRON, FACES, source)
    near = octex.Transfer(tetrahedron(), distance=0.1)
    far = Surface.from_arrays(TETRAHEDRON + np.array([9, 0, 0]), FACES).with_sources(near.sources)
    texture = octex.convert([tetrahedron(), far], 5)
    assert texture.contains(tetrahedron().scatter(100).rest).all()
    assert not texture.contains(far.scatter(100).rest).any()
    assert Surface.joined([tetrahedron(), clear]).source.has_gaps is False


def test_nothing_to_join_is_refused():
    with pytest.raises(ArgumentError, match="surface to join is missing"):
        Surface.joined([])


@pytest.mark.parametrize(
    ("model", "complaint"),
    [
        (3, "not 3"),
        ([3], "not a list with 3"),
        ([tetrahedron(), octex.PointCloud(np.eye(3), np.eye(3))], "not a list with <PointCloud"),
    ],
)
def test_what_is_no_model_is_refused(model, complaint):
    with pytest.raises(ArgumentError, match=complaint):
        octex.convert(model, 3)
