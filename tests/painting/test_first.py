"""New textures of one colour: random surfaces, cameras, masks and options leave no other colour anywhere."""

import numpy as np
import pytest
import trimesh

import octex
from octex.channels import srgb_to_linear
from tests.conftest import needs_jit
from tests.make.same import assert_same

CODES = np.array([200, 100, 50], np.uint8)
#: What a look may differ by: one code of 255 in light areas.
CODE = 0.006


def mesh_of(random):
    made = [
        lambda: trimesh.creation.box((1.0, random.uniform(0.01, 1.0), 1.0)),
        lambda: trimesh.creation.icosphere(2),
        lambda: trimesh.creation.torus(1.0, random.uniform(0.1, 0.3), major_sections=24, minor_sections=12),
    ]
    return made[random.integers(len(made))]()


def image_of(surface, random, size):
    shape = size, size + int(random.integers(9))
    camera = octex.Camera.fitted(surface.vertices, direction=random.normal(size=3), size=shape)
    camera = camera.zoomed(random.uniform(1.0, 4.0)) if random.random() < 0.4 else camera
    masks = [
        np.full(shape[::-1], 255),
        random.integers(0, 2, shape[::-1]) * 255,
        random.integers(0, 256, shape[::-1]),
    ]
    mask = masks[random.integers(3)]
    return octex.Projection(
        np.dstack([np.broadcast_to(CODES, (*mask.shape, 3)), mask]).astype(np.uint8), camera
    )


@needs_jit
@pytest.mark.parametrize("seed", range(24))
def test_one_colour_is_seen_at_all_widths_by_all_filters(seed):
    random = np.random.default_rng(seed)
    mesh = mesh_of(random)
    surface = octex.Surface.from_arrays(mesh.vertices, mesh.faces)
    size = int(random.choice([16, 40, 90]))
    images = [image_of(surface, random, size) for _ in range(random.integers(1, 5))]
    options = {name: bool(random.integers(2)) for name in ("coverage", "fit", "back_faces")}
    if random.random() < 0.4:
        options["max_depth"] = int(random.integers(3, 8))
    if len(images) > 2:
        options["pictures"] = str(random.choice(["average", "robust", "best"]))
    texture = octex.paint(None, surface, images, **options)
    assert texture.tree.n_leaves
    hits, wanted = surface.scatter(2000, seed=seed), srgb_to_linear(CODES / 255)
    for normals in (None, hits.rest_normals):
        for width in (0.0, 0.02, 0.3, 5.0):
            for shape in ("nearest", "linear", "quadratic"):
                found = texture.sample(hits.rest, width=width, normals=normals, filter=shape)
                assert np.abs(found - wanted).max() < CODE, (options, normals is None, width, shape)


def test_the_first_layer_of_a_new_texture_has_nothing_to_blend_with():
    mesh = trimesh.creation.icosphere(2)
    surface = octex.Surface.from_arrays(mesh.vertices, mesh.faces)
    image = np.random.default_rng(0).integers(0, 256, (40, 40, 3), np.uint8)
    camera = octex.Camera.fitted(surface.vertices, direction=(0.3, 0.5, 1.0), size=(40, 40))
    opaque = octex.paint(None, surface, octex.Projection(image, camera))
    for options in ({"opacity": 0.3}, {"blend": "multiply"}, {"blend": "add", "opacity": 0.5}):
        assert_same(octex.paint(None, surface, octex.Projection(image, camera, **options)), opaque)
