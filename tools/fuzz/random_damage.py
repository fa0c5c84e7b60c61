"""Damage .octex, .octz and .npz files in every way, and see that octex refuses them or answers.

A seed takes a small file that is sound, a texture or layer as .octex or .octz, points, voxels or cameras as
.npz, another texture every 200 seeds, and damages it (see damage.py): blindly, or knowing its structure, any
field of a header, any element of an array, with every checksum made right again. It is then opened,
described, validated, and some of this is done, by chance: a lookup in some way, also of a level, of an
archive as one elsewhere of which a part is read, a save, as an archive and back, a merge as a layer, a
conversion, a projection.

A finding is any exception that is no OctexError; an archive that opens although bytes of it were changed and
no checksum made right; a file that validates although its structure is not that of its leaves, a lookup is
not finite, or an archive of it comes back otherwise. What became of each file is counted: refused, unsound
(opened, but does not validate), sound.
"""

from __future__ import annotations

import json
import tempfile
import warnings
from functools import cache, lru_cache
from importlib.util import find_spec
from pathlib import Path
from random import Random
from typing import Any

import damage
import numpy as np
from damage import Archive, Render
from damage_arrays import Arrays, cameras, points, voxels

import octex
from octex.cameras.files import read_cameras
from octex.conversion.points import convert_voxels
from octex.errors import InputError, OctexError
from octex.parallel import at_most, silent
from octex.source.surface import Surface
from octex.source.voxels import Voxels
from octex.texture import FILTERS, OctreeTexture
from octex.tree.octree import Octree

#: Bytes that a process may take beside what it has at first.
MEMORY = 2 << 30
#: So many seeds damage files that are made of one texture.
SHARE = 200
#: Archives are read in part where fsspec is.
HAS_FSSPEC = find_spec("fsspec") is not None
#: Of twenty files so many are of a kind.
KINDS = (".octex",) * 8 + (".octz",) * 8 + ("points", "voxels", "voxels", "cameras")
SCRATCH = "/dev/shm" if Path("/dev/shm").is_dir() else None  # files of a millisecond's life


def check(seed: int) -> str:
    """Try a seed; return what became of the file, and what was damaged."""
    with tempfile.TemporaryDirectory(dir=SCRATCH) as folder, at_most(1):
        return " ".join(attempt(seed, Path(folder)))


@lru_cache(maxsize=1)
def files(number: int) -> dict[str, Render | Archive | Arrays]:
    """Return the parts of files that are sound, by their kind."""
    texture = damage.made(number)
    found: dict[str, Render | Archive | Arrays] = {}
    with tempfile.TemporaryDirectory(dir=SCRATCH) as folder:
        for ending in (".octex", ".octz"):
            texture.save(Path(folder) / f"good{ending}")
            found[ending] = damage.parted(Path(folder) / f"good{ending}")
    chance = np.random.default_rng(number)
    return found | {each.__name__: each(chance) for each in (points, voxels, cameras)}


def attempt(seed: int, folder: Path) -> tuple[str, str]:
    """Write a damaged file, and use it: "refused", "unsound" or "sound", and what was damaged."""
    chance = Random(seed)
    kind = chance.choice(KINDS)
    parts = files(seed // SHARE)[kind]
    path = folder / f"damaged{parts.ending}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        content, what, is_changed = damaged(parts, chance)
        path.write_bytes(content)
        try:
            word = use(path, kind, chance)
            assert not (is_changed and kind == ".octz") or word == "refused", (
                "it opens, but bytes were changed"
            )
        except Exception as error:
            raise AssertionError(f"{path.name}: {what}: {error}") from error
    return word, f"{kind}: {what}"


def damaged(parts: Render | Archive | Arrays, chance: Random) -> tuple[bytes, str, bool]:
    """Return a damaged file, what was damaged, and whether at last blindly, into another file."""
    weights, ways = zip(*parts.ways, strict=True)
    content, what = chance.choices(ways, weights)[0](parts, chance)
    before = parts.content if what == "blind" else content
    if chance.random() < 0.05:
        before, content, what = content, damage.blind(content, chance), f"{what}, then blind"
    return content, what, what.endswith("blind") and content != before


def use(path: Path, kind: str, chance: Random) -> str:
    """Do something with a file that may be damaged.

    Raises what is no OctexError, or any if it validates.
    """
    if not kind.startswith("."):
        return _use_arrays(path, kind, chance)
    try:
        texture = octex.open(path)
    except OctexError as error:
        if not isinstance(error, InputError) or "\n" in str(error):
            raise AssertionError("what is said of it is not a line, or not of the file") from error
        if kind != ".octex" and HAS_FSSPEC:
            _read_in_part(path, chance, is_sound=False)
        return "refused"
    json.dumps(texture.info())
    try:
        texture.validate()
        word = "sound"
    except OctexError:
        word = "unsound"
    try:
        if kind != ".octex" and HAS_FSSPEC and chance.random() < 0.4:
            _read_in_part(path, chance, is_sound=word == "sound")
        if word == "unsound" or chance.random() < 0.4:
            look_up(texture, chance, is_mapped=kind == ".octex", is_sound=word == "sound")
    except OctexError:
        if word == "sound":
            raise
    if word == "sound":
        leaves = [codes[~is_node] for codes, is_node in texture.tree.walk()]
        if any(codes.size for codes in leaves):
            twin = Octree.from_levels(leaves).arrays
            if not all(np.array_equal(*pair) for pair in zip(twin[:3], texture.tree.arrays[:3], strict=True)):
                raise AssertionError("it validates, but its structure is not that of its leaves")
    match chance.randrange(24):
        case 0:
            _save(texture, path, is_sound=word == "sound")
        case 1 if word == "sound":
            _merge(texture)
        case _:
            pass
    return word


def _read_in_part(path: Path, chance: Random, *, is_sound: bool) -> None:
    """Look up an archive as one elsewhere, of which a part is decoded."""
    try:
        texture = octex.open(path.resolve().as_uri())
        look_up(texture, chance, is_mapped=False, is_sound=is_sound)
        look_up(texture, chance, is_mapped=False, is_sound=is_sound)
    except OctexError:
        if is_sound:
            raise


def look_up(texture: OctreeTexture, chance: Random, *, is_mapped: bool, is_sound: bool) -> None:
    """Look up a channel in some way, at points on the model and off it.

    Of a mapped file list also which bytes that reads.
    """
    given: dict[str, Any] = {}
    low, high = (np.clip(corner, -1e6, 1e6) for corner in texture.bounds)
    random = np.frombuffer(chance.randbytes(32 * 6 * 2), np.uint16).reshape(32, 6) / 65535.0
    points = np.where(np.arange(32)[:, None] < 24, low + (high - low) * random[:, :3], 4 * random[:, :3] - 2)
    if not texture.channels:
        texture.contains(points)
        return
    channel = chance.choice(list(texture.channels))
    match chance.randrange(8):
        case 0:
            given["width"] = 0.05
        case 1:
            given.update(normals=random[:, 3:] - 0.5, width=0.1)
        case 2:
            given["normals"] = random[:, 3:] - 0.5
        case 3:
            texture.contains(points)
            texture.level(2).sample(points, channel)
            return
        case _:
            given["filter"] = chance.choice(list(FILTERS))
    if is_mapped and chance.random() < 0.25:
        texture.blocks(points, channel, block_size=64, **given)
        return
    found = texture.sample(points, channel, **given)
    values = texture.channels[channel]
    if is_sound and values.format.dtype != "float32" and not np.isfinite(found).all():
        raise AssertionError(f"it validates, but a lookup {given} is not finite")


def _save(texture: OctreeTexture, path: Path, *, is_sound: bool) -> None:
    """Save a texture, as an archive too; what is not sound must be refused, or saved."""
    again = [path.with_name(f"again{ending}") for ending in (".octz", ".octex", ".2.octex")]
    texture.save(again[1])
    try:
        texture.save(again[0])
    except OctexError:
        if is_sound:
            raise
        return
    octex.open(again[0]).save(again[2])
    if again[1].read_bytes() != again[2].read_bytes():
        raise AssertionError("its archive comes back as another file")


@cache
def _below() -> tuple[OctreeTexture, Surface]:
    """Return a texture and its surface, for layers to be merged into."""
    vertices = np.array([[0.0, 0, 0], [1, 0.1, 0], [0.2, 1, 0.1], [0.3, 0.2, 0.9]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    return damage.made(2), Surface.from_arrays(vertices, faces, colors=vertices)


def _merge(layer: OctreeTexture) -> None:
    texture, surface = _below()
    try:
        octex.merge(texture, layer, surface)
    except OctexError:
        return  # another root cell, other channels


def _use_arrays(path: Path, kind: str, chance: Random) -> str:
    try:
        if kind == "points":
            cloud = octex.PointCloud.load(path)
            if chance.random() < 0.25:
                _ = cloud.spacing
        elif kind == "voxels":
            voxels = Voxels.load(path)
            if chance.random() < 0.25:
                convert_voxels(voxels, report=silent).validate()
        else:
            for frame in read_cameras(path):
                frame.camera().project(np.eye(3))
    except OctexError:
        return "refused"
    return "sound"
