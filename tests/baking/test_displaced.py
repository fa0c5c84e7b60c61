"""Surfaces displaced by a channel of their texture."""

import numpy as np
import pytest

import octex
from octex.baking.tessellation import edges_of, tessellated
from octex.errors import ArgumentError
from tests.conftest import needs_jit
from tests.make.fixtures import OBJ_SQUARE, SQUARE, SQUARE_TRIANGLES, obj
from tests.make.small_surfaces import OCTAHEDRON, OCTAHEDRON_FACES

FACES = OCTAHEDRON_FACES.astype(np.int64)


def ball(levels):
    """A sphere of radius 1."""
    edges = edges_of(FACES)
    parts = tessellated(FACES, np.full(len(edges[0]), levels), edges)
    points = parts.spread(OCTAHEDRON[FACES])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return octex.Surface.from_arrays(points, parts.triangles, name="ball")


def height(at):
    return np.asarray(0.5 + 0.25 * np.sin(5 * at[:, 0]) * np.cos(4 * at[:, 1]))


@pytest.mark.parametrize("seed", range(5))
def test_parts_of_triangles_meet_at_vertices_and_fill_their_parents(seed):
    random = np.random.default_rng(seed)
    edges = edges_of(FACES)
    parts = tessellated(FACES, random.integers(0, 4, len(edges[0])), edges)
    points = parts.spread(OCTAHEDRON[FACES])
    areas = np.linalg.norm(
        np.cross(*(points[parts.triangles[:, k]] - points[parts.triangles[:, 0]] for k in (1, 2))), axis=1
    )
    per_parent = np.bincount(parts.parents, areas)
    np.testing.assert_allclose(per_parent, 3**0.5)
    assert len(np.unique(parts.triangles)) == parts.vertices
    ends, _ = edges_of(parts.triangles.astype(np.int64))
    assert parts.vertices - len(ends) + len(parts.triangles) == 2  # closed: Euler
    crossed = np.einsum("mkc,mcx->mkx", parts.shares, OCTAHEDRON[FACES][parts.parents])
    np.testing.assert_allclose(crossed, points[parts.triangles], atol=1e-12)


@needs_jit
@pytest.mark.parametrize(("scale", "degrees"), [(0.5, 1.0), (2.0, 1.1)])  # slopes up to 32 and 71 degrees
def test_a_displaced_sphere_is_its_formula(scale, degrees):
    surface = ball(6).with_sources({"occlusion": height})
    texture = octex.convert(surface, 7, dtype="float32")
    cell = texture.placement.size / 2**7
    made = octex.displace(texture, surface, "occlusion", scale, middle=0.5)
    assert np.linalg.norm(np.diff(made.rest[made.triangles[:, :2]], axis=1), axis=2).max() <= cell
    assert np.linalg.norm(made.rest, axis=1) == pytest.approx(1, abs=1e-3)

    def formula(at):
        unit = at / np.linalg.norm(at, axis=1, keepdims=True)
        return unit * (1 + scale * (height(unit) - 0.5))[:, None]

    off = np.linalg.norm(made.vertices - formula(made.rest), axis=1)
    assert off.max() < 0.1 * cell
    up = made.rest / np.linalg.norm(made.rest, axis=1, keepdims=True)
    right = np.cross(up, np.where(np.abs(up[:, :1]) < 0.9, [1.0, 0, 0], [0, 1.0, 0]))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    ways = [formula(up + 1e-5 * way) - formula(up - 1e-5 * way) for way in (right, np.cross(up, right))]
    normals = np.cross(*ways)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    frames = made.posed_frames()
    cosines = np.einsum("mkc,mkc->mk", frames.normals.values[frames.normals.rows], normals[made.triangles])
    assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).max() < degrees
    samples = made.scatter(1000)
    np.testing.assert_allclose(made.evaluate(samples, "occlusion")[:, 0], height(samples.rest), atol=1e-6)


@needs_jit
@pytest.mark.parametrize("channel", ["base_color", "roughness"])
def test_a_flat_sheet_moves_in_its_pose_and_keeps_its_rest(channel):
    turned = SQUARE[:, [1, 2, 0]] + 3.0  # faces along x
    given = {"base_color": (0.25, 0.25, 0.25), "roughness": 0.25}
    surface = octex.Surface.from_arrays(turned, SQUARE_TRIANGLES, rest=SQUARE, uv=SQUARE[:, :2]).with_sources(
        given
    )
    texture = octex.convert(surface, 4, dtype="float32")
    made = octex.displace(texture, surface, channel, -2.0, middle=0.75)
    np.testing.assert_allclose(made.rest[:, 2], 0, atol=1e-12)
    # Twice a half along the normal, whichever way that is.
    side = surface.scatter(1).normals[0]
    np.testing.assert_allclose(made.vertices, made.rest[:, [1, 2, 0]] + 3.0 + side, atol=1e-5)
    corners = made.uv.values[made.uv.rows]
    np.testing.assert_allclose(corners[..., 0], made.rest[made.triangles][..., 0], atol=1e-6)
    np.testing.assert_allclose(1 - corners[..., 1], made.rest[made.triangles][..., 1], atol=1e-6)


@needs_jit
def test_triangles_without_area_are_displaced_beside_others():
    vertices = np.concatenate([SQUARE, [[2.0, 0, 0], [2, 0, 0], [2, 0, 0]]])
    triangles = np.concatenate([SQUARE_TRIANGLES, [[4, 5, 6]]]).astype(np.int32)
    surface = octex.Surface.from_arrays(vertices, triangles).with_sources({"roughness": 0.25})
    made = octex.displace(octex.convert(surface, 4), surface, "roughness", 0.1)
    frames = made.posed_frames()
    assert np.isfinite(frames.normals.values).all() and np.isfinite(frames.tangents.values).all()
    assert np.isfinite(made.vertices).all()


@needs_jit
def test_what_cannot_be_displaced_is_refused():
    surface = ball(1).with_sources({"occlusion": height})
    texture = octex.convert(surface, 3, dtype="float16")
    cases = [
        ({"channel": "height"}, "unknown channel of the texture 'height'; there are: occlusion|base_color"),
        ({"scale": np.nan}, "scale must be from"),
        ({"middle": np.inf}, "middle must be from"),
        ({"cell": 0.0}, "cell must be finite and above zero"),
        ({"cell": 1e-9}, "would need too many triangles, 4\\^"),
        ({"most_triangles": 5}, "would need too many triangles, [0-9]+; give a larger cell"),
        (
            {"scale": 1e30, "middle": -5.0},
            "occlusion displaces a vertex to a position that is not finite, at",
        ),
    ]
    for change, message in cases:
        arguments = {"channel": "occlusion", "scale": 0.1} | change
        with pytest.raises(ArgumentError, match=message):
            octex.displace(texture, surface, **arguments)
    with pytest.raises(ArgumentError, match="surface must be"):
        octex.displace(texture, texture, "occlusion", 1.0)


@needs_jit
def test_a_channel_that_is_not_finite_is_refused():
    surface = ball(1).with_sources({"emissive": (1.0, 1.0, 1.0)})
    texture = octex.convert(surface, 2, dtype="float32", channels=["emissive"])
    values = texture.channels["emissive"].values.copy()
    values[:] = np.inf
    channel = texture.channels["emissive"]._replace(values=values)
    broken = octex.OctreeTexture(texture.tree, {"emissive": channel}, texture.placement, texture.bounds)
    with pytest.raises(ArgumentError, match="emissive displaces a vertex to a position that is not finite"):
        octex.displace(broken, surface, "emissive", 0.1)


@needs_jit
def test_bake_displaces(tmp_path, cli):
    model, texture = obj(tmp_path / "a.obj", OBJ_SQUARE + "f 1/1 2/2 3/3 4/4\n"), tmp_path / "a.octex"
    octex.convert(model, 4, sources={"base_color": (0.5, 0.5, 0.5)}).save(texture)
    words = ["--quiet", "--displace", "base_color=-0.5,0.25"]
    cli.result("bake", texture, model, tmp_path / "a.ply", *words)
    made = octex.load_surface(tmp_path / "a.ply")
    np.testing.assert_allclose(made.vertices[:, 2], -0.125, atol=2e-3)
    assert len(made.triangles) > 200
