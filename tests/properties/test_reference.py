"""Every channel of glTF models against the slow reference, read from the surface and from octrees."""

import warnings
from typing import NamedTuple

import numpy as np
import pytest

import octex
from octex.errors import ModelWarning
from tests.conftest import needs_jit
from tests.make.fixtures import CLAMP, LINEAR, MIRROR, NEAREST, REPEAT, Gltf, png, random_image
from tests.oracles.naive_gltf import Reference
from tests.oracles.naive_sheets import clipped

CODE = 1 / 255


class Difference(NamedTuple):
    """How far octex is from the reference in one channel, in the measure of codes, 0 … 1."""

    largest: float
    points: int  # that were compared


def as_codes(values, channel):
    """Light on the sRGB curve, unit vectors as (x + 1) / 2, the rest as it is."""
    values = np.asarray(values, float)
    if channel.name == "normal":
        return (values / np.linalg.norm(values, axis=1, keepdims=True) + 1) / 2
    if channel.name in ("base_color", "emissive", "specular"):
        return np.where(
            values <= 0.0031308, 12.92 * values, 1.055 * np.maximum(values, 0) ** (1 / 2.4) - 0.055
        )
    return values


def difference(found, expected, smooth):
    known = smooth & ~np.isnan(expected).any(axis=1)
    largest = np.abs(found - expected)[known].max(initial=0.0)
    return Difference(float(largest), int(known.sum()))


def differences(path, points):
    """Point lookups beside the reference; points on the edge of a step do not count."""
    surface, reference = octex.load_surface(path), Reference(path)
    np.testing.assert_allclose(reference.positions, surface.vertices[surface.triangles], rtol=1e-6, atol=1e-9)
    samples = surface.scatter(points)
    triangles, barycentric = samples.triangles.astype(np.int64), samples.barycentric
    found = {}
    for channel in surface.channels:
        expected = as_codes(reference.values(channel.name, triangles, barycentric), channel)
        smooth = np.ones(points, bool)
        for aside in 1e-5 * np.array([[1, -1, 0], [-1, 0, 1], [0, 1, -1]]):
            beside = reference.values(channel.name, triangles, barycentric + aside)
            smooth &= ~(np.abs(as_codes(beside, channel) - expected) > CODE).any(axis=1)
        values = as_codes(surface.evaluate(samples, channel.name), channel)
        found[channel.name] = difference(values, expected, smooth)
    return found


def converted_differences(path, depth, points):
    """An octree beside the reference, at points around which the reference is within a code of itself."""
    surface, reference = octex.load_surface(path), Reference(path)
    texture = octex.convert(surface, depth, fit=False)
    samples = surface.scatter(points)
    triangles, barycentric = samples.triangles.astype(np.int64), samples.barycentric
    cell = texture.placement.size / 2**depth
    origin = np.array(texture.placement.origin)
    centers = origin + (np.floor((samples.rest - origin) / cell) + 0.5) * cell
    owners, near, at = around(reference.positions, samples.triangles, samples.rest, centers, cell)
    found = {}
    for channel in surface.channels:
        expected = as_codes(reference.values(channel.name, triangles, barycentric), channel)
        beside = as_codes(reference.values(channel.name, near, at), channel)
        far = (np.abs(beside - expected[owners]) > CODE).any(axis=1) | np.isnan(beside).any(axis=1)
        smooth = np.bincount(owners[far], minlength=points) == 0
        values = as_codes(texture.sample(samples.rest, channel.name, "nearest"), channel)
        found[channel.name] = difference(values, expected, smooth)
    return found


def around(corners, triangles, points, centers, cell):
    """Places in the neighbourhood of cells: the number of the cell, a triangle, barycentric coordinates.

    Corners and inside of what is of each triangle in the cell around each centre; and a grid as wide as a
    cell around each point on the plane of its triangle, beyond the triangle too, as filters look there.
    """
    owners = []
    near = []
    at = []
    low, high = corners.min(axis=1), corners.max(axis=1)
    half = cell / 2
    steps = np.linspace(-half, half, 7)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    for number, (triangle, center) in enumerate(zip(triangles, centers, strict=True)):
        a, b, c = corners[triangle]
        first = (b - a) / np.linalg.norm(b - a)
        second = np.cross(np.cross(first, c - a), first)
        second /= np.linalg.norm(second)
        places = [(int(triangle), points[number] + grid @ [first, second])]
        close = ((low <= center + half) & (high >= center - half)).all(axis=1)
        for other in np.flatnonzero(close):
            polygon = clipped(corners[other], center - half, center + half)
            if len(polygon):
                middle = polygon.mean(axis=0)
                inner = [middle + part * (polygon - middle) for part in (0.33, 0.67)]
                places.append((int(other), np.vstack([polygon, *inner, middle])))
        for other, positions in places:
            owners += [number] * len(positions)
            near += [other] * len(positions)
            at.append(barycentric_of(positions, corners[other]))
    return np.array(owners), np.array(near), np.concatenate(at)


def barycentric_of(positions, corners):
    a, b, c = corners
    second, third = np.linalg.lstsq(np.stack([b - a, c - a], axis=1), (positions - a).T, rcond=None)[0]
    return np.stack([1 - second - third, second, third], axis=1)


_COMPRESSED = b"KHR_draco_mesh_compression", b"EXT_meshopt_compression"


def usable(folder):
    """Yield the models that octex takes without a word; what is broken is left to other tests."""
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".gltf", ".glb") and "fragile" not in path.parts:
            if any(word in path.read_bytes() for word in _COMPRESSED):  # the reference decodes none
                continue
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error", ModelWarning)
                    octex.load_surface(path)
            except (octex.OctexError, ModelWarning):
                continue
            yield path


# ---- models of one's own

_WRAPS = (REPEAT, MIRROR, CLAMP)


def random_model(path, seed, **fixed):
    """A bumpy patch, placed by two nodes; ``fixed`` decides what chance would (alpha_mode, tangents, …)."""
    random = np.random.default_rng(seed)
    contrast = fixed.get("contrast", 1.0)
    gltf = Gltf()

    def noise(height, width, channels, dtype="uint8"):
        values = random_image(height, width, channels, dtype, int(random.integers(1 << 30)))
        top = np.iinfo(dtype).max
        return (0.8 * top + contrast * (values - 0.8 * top)).astype(dtype)

    def chosen(name, *choices):
        return fixed.get(name, choices[int(random.integers(len(choices)))])

    def info(**more):
        height, width = (int(size) for size in random.integers(3, 17, 2))
        channels = int(random.integers(3, 5))
        image = gltf.image(png(noise(height, width, channels)))
        wrap = (_WRAPS[random.integers(3)], _WRAPS[random.integers(3)])
        texture = gltf.texture(image, wrap, mag=chosen("mag", NEAREST, LINEAR, LINEAR, None))
        entry = {"index": texture, "texCoord": int(random.integers(2)), **more}
        if random.random() < 0.5:
            u, v = random.uniform(-1, 1, 2).tolist()
            entry["extensions"] = {
                "KHR_texture_transform": {"offset": [u, v], "rotation": u * 3, "scale": [1 + v, -1.5]}
            }
            if random.random() < 0.3:
                entry["extensions"]["KHR_texture_transform"]["texCoord"] = int(random.integers(2))
        return entry

    def factors(count):
        return random.uniform(0.3, 1, count).tolist()

    kind = chosen("kind", "metallic", "metallic", "specular")
    material = {
        "normalTexture": info(scale=float(random.uniform(0.3, 1.5))),
        "occlusionTexture": info(strength=float(random.random())),
        "emissiveTexture": info(),
        "emissiveFactor": factors(3),
        "alphaMode": chosen("alpha_mode", "OPAQUE", "MASK", "BLEND"),
    }
    extensions = {}
    if material["alphaMode"] == "MASK":
        material["alphaCutoff"] = float(random.uniform(0.2, 0.6))
    if random.random() < 0.5:
        extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": float(random.uniform(0.5, 4))}
    if kind == "specular":
        extensions["KHR_materials_pbrSpecularGlossiness"] = {
            "diffuseFactor": factors(4),
            "specularFactor": factors(3),
            "glossinessFactor": factors(1)[0],
            "diffuseTexture": info(),
            "specularGlossinessTexture": info(),
        }
    pbr = {
        "baseColorFactor": factors(4),
        "metallicFactor": factors(1)[0],
        "roughnessFactor": factors(1)[0],
        "baseColorTexture": info(),
        "metallicRoughnessTexture": info(),
    }
    gltf.add("materials", pbrMetallicRoughness=pbr, extensions=extensions or None, **material)
    size = 5
    u, v = (axis.ravel() / (size - 1) for axis in np.mgrid[:size, :size])
    positions = np.stack([u, v, 0.3 * contrast * random.random(size * size)], axis=1).astype(np.float32)
    corners = np.arange(size * (size - 1)).reshape(-1, size)[:, :-1].ravel()
    triangles = np.concatenate(
        [corners[:, None] + [0, size, 1], corners[:, None] + [1, size, size + 1]]
    ).astype(np.uint16)

    def unit(count):
        vectors = random.normal([0, 0, 1], 0.3 * contrast, (count, 3))
        return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)

    attributes = {}
    for number in range(2):
        turn = random.normal(0, 1.5, (2, 2))
        attributes[f"TEXCOORD_{number}"] = gltf.accessor((np.stack([u, v], axis=1) @ turn).astype(np.float32))
    if chosen("normals", True, True, False):
        attributes["NORMAL"] = gltf.accessor(unit(len(u)))
    if chosen("tangents", True, False):
        signs = np.full((len(u), 1), random.choice([-1, 1]), np.float32)
        attributes["TANGENT"] = gltf.accessor(np.hstack([unit(len(u))[:, [2, 0, 1]], signs]))
    if random.random() < 0.5:
        attributes["COLOR_0"] = gltf.accessor(noise(1, len(u), 4, "uint16")[0], normalized=True)
    child = gltf.show(
        gltf.primitive(positions, triangles, material=0, **attributes),
        translation=random.normal(size=3).tolist(),
        scale=(random.uniform(0.5, 2, 3) * random.choice([-1, 1], 3)).tolist(),
    )
    quaternion = random.normal(size=4)
    parent = gltf.add("nodes", children=[child], rotation=(quaternion / np.linalg.norm(quaternion)).tolist())
    gltf.json["scenes"][0]["nodes"] = [parent]
    return gltf.save(path)


@pytest.mark.parametrize("seed", range(16))
def test_every_channel_of_random_models_is_the_references(tmp_path, seed):
    found = differences(random_model(tmp_path / "model.glb", seed), 300)
    assert {"base_color", "roughness", "occlusion", "emissive", "normal"} <= set(found)
    for name, each in found.items():
        assert each.largest < 1e-4, (name, each)
        assert each.points > 150 or name == "metallic", (name, each)


@needs_jit
@pytest.mark.parametrize("seed", range(4))
def test_every_channel_of_octrees_of_smooth_random_models_is_the_references(tmp_path, seed):
    found = converted_differences(random_model(tmp_path / "model.glb", seed, contrast=0.04), 7, 300)
    for name, each in found.items():
        assert each.largest < 1.5 * CODE, (name, each)
        assert each.points > 30 or name == "metallic", (name, each)


# ---- real models


@needs_jit
@pytest.mark.parametrize("into_octrees", [False, True])
def test_every_channel_of_real_models_is_the_references(models, into_octrees):
    found = {
        path: converted_differences(path, 9, 200) if into_octrees else differences(path, 300)
        for path in usable(models)
    }
    assert found
    most = 1.5 * CODE if into_octrees else 1e-4  # half a code is lost to rounding
    assert {
        (path.name, name): each
        for path, channels in found.items()
        for name, each in channels.items()
        if each.largest > most
    } == {}
