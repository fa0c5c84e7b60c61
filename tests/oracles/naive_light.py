"""Reflected light, sample by sample: the whole integral over the hemisphere, slow and obvious."""

import numpy as np


def directions(n):
    """Return n directions, even over the sphere: a spiral of golden angles."""
    z = 1 - (2 * np.arange(n) + 1) / n
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    rim = np.sqrt(1 - z**2)
    return np.stack([rim * np.cos(turn), z, rim * np.sin(turn)], axis=1)


def texel_directions(height, width):
    """Directions (height · width, 3) of the middles of texels, and their solid angles."""
    found, solid = [], []
    for row in range(height):
        for column in range(width):
            latitude = np.pi / 2 - np.pi * (row + 0.5) / height
            longitude = np.pi - 2 * np.pi * (column + 0.5) / width
            c = np.cos(latitude)
            found.append((c * np.sin(longitude), np.sin(latitude), c * np.cos(longitude)))
            top, bottom = np.pi / 2 - np.pi * row / height, np.pi / 2 - np.pi * (row + 1) / height
            solid.append((np.sin(top) - np.sin(bottom)) * 2 * np.pi / width)
    return np.array(found), np.array(solid)


def lobe(cosine, roughness):
    """Return GGX's distribution of a half vector at some cosine to the normal (glTF 2.0, B.3.2)."""
    square = roughness**4
    return square / (np.pi * (cosine**2 * (square - 1) + 1) ** 2)


def reflectance(n, v, light, base, metallic, roughness, specular=0.04):
    """Return glTF's BRDF (glTF 2.0, appendix B) times the cosine, for directions of light (m, 3): (m, 3)."""
    h = light + v
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    n_l, n_v, n_h, v_h = light @ n, v @ n, h @ n, h @ v
    above = n_l > 0
    n_l = np.maximum(n_l, 1e-9)
    square = roughness**4
    visible = 0.5 / (
        n_l * np.sqrt(n_v**2 * (1 - square) + square) + n_v * np.sqrt(n_l**2 * (1 - square) + square)
    )
    schlick = (1 - np.clip(v_h, 0, 1)) ** 5
    base = np.asarray(base)
    plain, metal = (f0 + (1 - f0) * schlick[:, None] for f0 in (specular, base))
    gloss = (lobe(n_h, roughness) * visible)[:, None]
    mixed = (1 - metallic) * (plain * gloss + (1 - plain) * base / np.pi) + metallic * metal * gloss
    return mixed * (n_l * above)[:, None]


def reflected(n, v, radiance, base, metallic, roughness, specular=0.04, samples=100_000):
    """Return the light toward v of a surface with normal n, in the ``radiance`` of directions (m, 3)."""
    toward = directions(samples)
    values = radiance(toward) * reflectance(n, v, toward, base, metallic, roughness, specular)
    return 4 * np.pi * values.mean(axis=0)


def reflected_again(n, v, radiance, base, metallic, roughness, specular=0.04):
    """Return the light that facets scatter more than once (Fdez-Agüera 2019): as if from all around."""
    base = np.asarray(base)
    lost = 1 - reflected(n, v, np.ones_like, np.ones(3), 1.0, roughness)
    toward = directions(20_000)
    matte = 4 * (radiance(toward) * np.maximum(toward @ n, 0)[:, None]).mean(axis=0)

    def again(first, part):
        average = first + (1 - first) / 21
        return part * average / (1 - lost * average) * lost * matte

    metal = again(base, reflected(n, v, np.ones_like, base, 1.0, roughness))
    dielectric = again(specular, reflected(n, v, np.ones_like, specular * np.ones(3), 1.0, roughness))
    # What is scattered again is not left for the matte part below.
    return (1 - metallic) * dielectric * (1 - base) + metallic * metal
