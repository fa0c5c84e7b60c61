"""Textures at addresses: as lookups of a local file answer, of a small part of its bytes."""

from __future__ import annotations

import pickle
import re
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import octex
from octex import arrays, container
from octex.errors import ArgumentError, MissingExtraError, OutputError, TextureFileError
from octex.remote import BLOCK
from octex.tree.morton import decode_cells
from tests.make.painted import ball
from tests.make.small_textures import shell
from tests.properties.random_lookups import random_points, random_texture, random_views

GOLDEN = Path(__file__).parents[1] / "golden"
DROID = Path(__file__).parents[2] / "samples" / "droid.glb"
fsspec = pytest.importorskip("fsspec", reason="needs the extra octex[remote]")


class Server(ThreadingHTTPServer):
    """Serves one file in memory, counts what it sends, and fails in the ways that it is told to."""

    content = b""
    tag = '"1"'
    has_ranges = True
    is_broken = False
    refusal: int | None = None
    sent = 0
    largest = 0
    requests = 0

    @property
    def address(self):
        return f"http://127.0.0.1:{self.server_address[1]}/a.octex"


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Server

    def log_message(self, *_):
        pass

    def do_HEAD(self):
        self.answer(is_head=True)

    def do_GET(self):
        self.answer(is_head=False)

    def answer(self, *, is_head):
        server = self.server
        server.requests += 1
        if server.is_broken:
            self.close_connection = True
            return
        if server.refusal is not None:
            self.send_error(server.refusal)
            return
        body, asked = server.content, re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers["Range"] or "")
        if asked and server.has_ranges:
            begin, end = int(asked[1]), int(asked[2]) + 1
            body = server.content[begin:end]
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {begin}-{end - 1}/{len(server.content)}")
        else:
            self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("ETag", server.tag)
        self.end_headers()
        if not is_head:
            self.wfile.write(body)
            server.sent += len(body)
            server.largest = max(server.largest, len(body))


@pytest.fixture
def server():
    pytest.importorskip("aiohttp", reason="needs the extra octex[remote]")
    with Server(("127.0.0.1", 0), Handler) as made:
        made.daemon_threads = True
        thread = threading.Thread(target=made.serve_forever, daemon=True)
        thread.start()
        yield made
        made.shutdown()


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    path = tmp_path_factory.mktemp("remote") / "shell.octex"
    shell(8, keep=0).save(path)
    return path


@pytest.mark.parametrize("ending", [".octex", ".octz"])
@pytest.mark.parametrize("seed", range(4))
def test_a_texture_elsewhere_answers_as_here(seed, ending, tmp_path):
    random = np.random.default_rng(seed)
    path = tmp_path / f"a{ending}"
    random_texture(random, ("uint8",)).save(path)
    here, address = octex.open(path), elsewhere(path)
    names = list(here.channels)
    for filter in octex.texture.FILTERS:
        there = octex.open(address)
        for _ in range(2):
            points, _ = random_points(here, random, 2)
            views = random_views(random, len(points), here.placement.size)
            found = there.sample(points, names, filter, **views)
            for name, expected in here.sample(points, names, filter, **views).items():
                np.testing.assert_array_equal(found[name], expected)
            taps = there.taps(points, names[0], **views), here.taps(points, names[0], **views)
            for one, other in zip(*taps, strict=True):
                np.testing.assert_array_equal(one, other)
    there = octex.open(address)
    np.testing.assert_array_equal(there.contains(points), here.contains(points))
    assert there.info() == here.info()
    assert repr(there) == repr(here)
    coarse = octex.open(address).level(2)
    np.testing.assert_array_equal(coarse.rows(names[0]), here.level(2).rows(names[0]))
    rows = octex.open(address).rows(names[0])
    np.testing.assert_array_equal(rows, here.rows(names[0]))
    octex.open(address).save(tmp_path / f"b{ending}")
    assert (tmp_path / f"b{ending}").read_bytes() == path.read_bytes()
    octex.open(address).validate()
    blurred = [octex.blur(octex.open(each), 0.1) for each in (address, path)]
    np.testing.assert_array_equal(*(each.rows(names[0]) for each in blurred))
    sent = pickle.loads(pickle.dumps(octex.open(address)))
    np.testing.assert_array_equal(sent.sample(points, names[0]), here.sample(points, names[0]))


def elsewhere(path, content=None):
    """Put a file, or other content under its name, into fsspec's memory; return its address."""
    content = path.read_bytes() if content is None else content
    fsspec.filesystem("memory").pipe(f"/octex/{path.name}", content)
    return f"memory://octex/{path.name}"


def test_a_channel_elsewhere_is_replaced_by_one_here():
    channel = octex.open(elsewhere(min(GOLDEN.glob("*.octz")))).channels["base_color"]
    values = channel.values.copy()
    changed = channel._replace(values=255 - values)
    assert type(changed) is octex.texture.Channel
    np.testing.assert_array_equal(changed.values, 255 - values)
    assert len(changed.split_values) == len(channel.split_values)


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.octz")), ids=lambda path: path.name)
def test_archives_of_every_version_are_read_in_part(path):
    here, address = octex.open(path), elsewhere(path)
    for level in range(here.tree.max_depth + 1):
        coarse, expected = octex.open(address).level(level), here.level(level)
        np.testing.assert_array_equal(coarse.rows(), expected.rows())
        for one, other in zip(coarse.tree.arrays, expected.tree.arrays, strict=True):
            np.testing.assert_array_equal(one, other)
    points = np.random.default_rng(0).uniform(*here.bounds, (50, 3))
    there = octex.open(address)
    for width in (0.5, 0.1, None):
        found, expected = (each.sample(points, width=width) for each in (there, here))
        np.testing.assert_array_equal(found, expected)


def test_damaged_archives_elsewhere_are_named(tmp_path):
    path = tmp_path / "a.octz"
    shell(5).save(path)
    content = path.read_bytes()
    for length in (8, 20, 31, 32, len(content) - 9):
        with pytest.raises(TextureFileError, match=r"^memory://octex/a\.octz: .*copy it again"):
            octex.open(elsewhere(path, content[:length]))
    there = octex.open(elsewhere(path, content[:200] + bytes([content[200] ^ 1]) + content[201:]))
    with pytest.raises(TextureFileError, match=r"^memory://octex/a\.octz: its bytes from \d+ on are damaged"):
        there.validate()


@pytest.mark.parametrize("ending", [".octex", ".octz"])
def test_what_was_asked_before_does_not_matter(ending, droid, tmp_path):
    surface, texture = droid
    path = tmp_path / f"a{ending}"
    texture.save(path)
    here, address = octex.open(path), elsewhere(path)
    samples = surface.scatter(300)
    views = [{"normals": samples.normals}, {}]
    views += [{"width": here.placement.size * 2.0**-n} for n in range(2, 8)]
    for number in range(6):
        there = octex.open(address)
        random = np.random.default_rng(number)
        for n in random.permutation(len(views)):
            some = slice(*sorted(random.integers(0, 300, 2)))
            view = {name: each[some] if name == "normals" else each for name, each in views[n].items()}
            found, expected = (each.sample(samples.rest[some], **view) for each in (there, here))
            np.testing.assert_array_equal(found, expected)


@pytest.fixture(scope="module")
def droid():
    """The droid, and a texture of it with leaves of several depths."""
    surface = octex.load_surface(DROID, channels=["base_color"])
    return surface, octex.convert(surface, 7, max_error=3)


def test_a_view_of_an_archive_moves_less_than_one_of_a_file(server, tmp_path):
    octex.convert(ball(rings=128), 8).save(tmp_path / "a.octex")
    here = octex.open(tmp_path / "a.octex")
    here.save(tmp_path / "a.octz")
    codes = here.tree.level_codes(here.tree.max_depth)[::40]
    points = here.placement.to_rest((decode_cells(codes) + 0.5) / 2**here.tree.max_depth)
    width = here.placement.size / 2**5
    moved = {}
    for path in (tmp_path / "a.octex", tmp_path / "a.octz"):
        server.content, server.sent = path.read_bytes(), 0
        there = octex.open(server.address)
        np.testing.assert_array_equal(there.sample(points, width=width), here.sample(points, width=width))
        moved[path.suffix] = server.sent
    assert moved[".octz"] < 0.5 * moved[".octex"]
    assert moved[".octz"] < 0.3 * len(server.content)
    near = points[:20]
    np.testing.assert_array_equal(there.sample(near), here.sample(near))
    assert server.sent < len(server.content)


def test_a_view_moves_little_of_a_file(server, large, tmp_path):
    server.content = large.read_bytes()
    here, there = octex.open(large), octex.open(server.address)
    assert server.sent <= 20 * BLOCK
    random = np.random.default_rng(1)
    points = here.placement.origin + here.placement.size * random.random((200, 3))
    views = {"width": here.placement.size / 16, "normals": points - points.mean(axis=0)}
    np.testing.assert_array_equal(there.sample(points, **views), here.sample(points, **views))
    moved = server.sent
    assert 0 < moved < len(server.content) / 4
    there.sample(points, **views)
    assert server.sent == moved
    again = octex.open(server.address, cache=tmp_path / "cache")
    again.sample(points, **views)
    moved = server.sent
    again = octex.open(server.address, cache=tmp_path / "cache")
    np.testing.assert_array_equal(again.sample(points, **views), here.sample(points, **views))
    assert server.sent == moved
    shell(3).save(tmp_path / "b.octex")
    server.content, server.tag = (tmp_path / "b.octex").read_bytes(), '"2"'
    changed = octex.open(server.address, cache=tmp_path / "cache")
    np.testing.assert_array_equal(changed.rows(), octex.open(tmp_path / "b.octex").rows())
    assert len(list((tmp_path / "cache").iterdir())) == 2


def test_a_whole_file_comes_in_pieces_and_again_if_it_is_lost(server, large, tmp_path, monkeypatch):
    monkeypatch.setattr("octex.remote._MOST", 32 * BLOCK)
    server.content = large.read_bytes()
    for _ in range(2):
        found = octex.open(server.address, cache=tmp_path).rows()
        np.testing.assert_array_equal(found, octex.open(large).rows())
        assert server.largest <= 32 * BLOCK
        (part,) = tmp_path.glob("*.part")
        part.unlink()


def test_only_what_lies_around_the_points_is_fetched(server, large):
    server.content = large.read_bytes()
    here, there = octex.open(large), octex.open(server.address)
    groups = here.tree.arrays.groups.nbytes
    cells = decode_cells(here.tree.level_codes(8)[:20]) + 0.5
    near = here.placement.origin + here.placement.size * (cells / 256)
    assert here.contains(near).all()
    for filter in octex.texture.FILTERS:
        np.testing.assert_array_equal(there.sample(near, filter=filter), here.sample(near, filter=filter))
    assert server.sent < groups / 4
    moved, requests = server.sent, server.requests
    np.testing.assert_array_equal(there.contains(near), here.contains(near))
    taps = there.taps(near), here.taps(near)
    for one, other in zip(*taps, strict=True):
        np.testing.assert_array_equal(one, other)
    assert (server.sent, server.requests) == (moved, requests)
    far = here.placement.origin + here.placement.size * np.random.default_rng(0).random((40, 3))
    np.testing.assert_array_equal(there.contains(far), here.contains(far))
    np.testing.assert_array_equal(there.sample(far), here.sample(far))
    with ThreadPoolExecutor(4) as pool:
        parts = list(pool.map(lambda some: there.sample(some), np.split(far[::-1], 4)))
    np.testing.assert_array_equal(np.concatenate(parts), here.sample(far[::-1]))
    assert not there.storage.file.is_whole


@pytest.mark.parametrize("ending", [".octex", ".octz"])
def test_a_set_of_textures_elsewhere_fetches_no_more_than_they_do_alone(ending, server, large, tmp_path):
    here = octex.open(large)
    here.save(tmp_path / f"a{ending}")
    server.content = (tmp_path / f"a{ending}").read_bytes()
    cells = decode_cells(here.tree.level_codes(8)[:5]) + 0.5
    near = here.placement.origin + here.placement.size * (cells / 256)
    points, parts = np.repeat(near, 2, axis=0)[1:7], np.arange(6) % 2
    for views in ({}, {"width": here.placement.size / 64}, {"normals": near}):
        begin, there = server.sent, octex.open(server.address)
        there.sample(near, **views)
        there.contains(near)
        alone, begin = server.sent - begin, server.sent
        local = octex.TextureSet({"here": here, "there": octex.open(server.address)})
        given = {"normals": np.repeat(near, 2, axis=0)[1:7]} if "normals" in views else views
        np.testing.assert_array_equal(local.sample(points, parts, **given), here.sample(points, **given))
        np.testing.assert_array_equal(local.contains(points, parts), here.contains(points))
        assert 0 < server.sent - begin <= alone
    points = near.copy()
    points[3] = np.nan
    with pytest.raises(ArgumentError, match=r"points must be finite, but points\[3\]"):
        local.sample(points, [0, 1, 0, 1, 1])


def test_a_full_disk_names_the_folder_of_the_cache_or_of_the_archive(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    paths = [tmp_path / f"full.{ending}" for ending in ("octex", "octz")]
    for path in paths:
        shell(5).save(path)
    there = octex.open(elsewhere(paths[0]), cache=tmp_path / "cache")
    monkeypatch.setattr(there.storage.file, "_file", SimpleNamespace(seek=full))
    folder = re.escape(str(tmp_path / "cache"))
    with pytest.raises(OutputError, match=rf"^{folder}: the cache for memory://octex"):
        there.rows()
    monkeypatch.setattr("octex.archive.read.zeros", partial(arrays.zeros, most_in_memory=0))
    monkeypatch.setattr(arrays, "zeros_in", full)
    for path in (paths[1], elsewhere(paths[1])):
        with pytest.raises(OutputError, match=r"has no room for .* bytes: No space left on device"):
            octex.open(path)


def test_what_goes_wrong_on_the_way_names_the_address(server, large):
    content = server.content = large.read_bytes()

    def fails(match):
        with pytest.raises(TextureFileError, match=match) as caught:
            octex.open(server.address).validate()
        assert str(caught.value).startswith(server.address)

    there = octex.open(server.address)
    server.is_broken = True
    with pytest.raises(TextureFileError, match=r"a\.octex: cannot be read: "):
        there.validate()
    fails("cannot be read: its server does not answer: Server disconnected")
    server.is_broken = False
    for status, reason in ((404, "there is no such file"), (403, "its server answers 403 Forbidden")):
        server.refusal = status
        fails(f"cannot be read: {reason}")
    server.refusal = None
    there.validate()
    there = octex.open(server.address)
    server.tag = '"2"'
    with pytest.raises(TextureFileError, match=r"a\.octex: changed after it was opened; open it again"):
        there.validate()
    server.has_ranges = False
    fails("does not answer requests for a part")
    server.has_ranges, server.content = True, content[:-1]
    fails("cut off or damaged")
    server.content = b""
    fails("has no known length")
    server.content = b"{}" * 9000
    fails("is not an octree texture file|safetensors")


def test_addresses_that_cannot_be_opened_are_refused(tmp_path, monkeypatch):
    for address, message in (
        ("memory://octex/none", r"^memory://octex/none: .*no such file"),
        ("nothing://a", r"^nothing://a: .*not known"),
        ("http://127.0.0.1:1/a.octex", r"its server does not answer: .*127\.0\.0\.1"),
    ):
        with pytest.raises(TextureFileError, match=message):
            octex.open(address)
    with pytest.raises(ArgumentError, match="cache is for addresses"):
        octex.open(tmp_path / "a.octex", cache=tmp_path)
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(MissingExtraError, match=r"^https://a/b: .*octex\[remote\]"):
        octex.open("https://a/b")


def test_what_an_archive_has_of_others_is_kept(tmp_path):
    shell(4).save(tmp_path / "a.octex")
    contents = container.read(tmp_path / "a.octex")
    others = {"channels/other": np.arange(7.0), "kept/channels/other": np.ones(3, np.int16)}
    container.write(tmp_path / "b.octex", {**contents.tensors, **others}, contents.metadata)
    octex.open(tmp_path / "b.octex").save(tmp_path / "b.octz")
    there = octex.open(elsewhere(tmp_path / "b.octz"))
    there.level(2)
    there.save(tmp_path / "c.octex")
    assert (tmp_path / "c.octex").read_bytes() == (tmp_path / "b.octex").read_bytes()
