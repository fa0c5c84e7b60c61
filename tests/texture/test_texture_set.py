"""Textures of parts: looked up by part, and kept in a folder."""

import json
import re
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import pytest

import octex
from octex import files
from octex.channels import NORMAL, ROUGHNESS
from octex.errors import ArgumentError, OutputError, TextureFileError
from octex.texture import OctreeTexture, TextureSet, lookup
from octex.texture import set as sets
from octex.tree.placement import Placement
from tests.make.small_textures import eight_colors, shell
from tests.make.strategies import random_channel

N = 60
RANDOM = np.random.default_rng(0)
POINTS = RANDOM.random((N, 3)) * 1.2 - 0.1
PARTS = RANDOM.integers(0, 3, N)
VECTORS = RANDOM.normal(size=(3, N, 3))


def with_channel(texture, form):
    """The same texture with one more channel, of noise."""
    noise = random_channel(form, texture.tree, np.random.default_rng(9))
    return texture.with_cells(texture.tree, {**texture.channels, form.name: noise})


def moved(texture):
    return OctreeTexture(texture.tree, texture.channels, Placement((0.1, -0.2, 0.0), 0.7), texture.bounds)


@pytest.fixture(scope="module")
def parts():
    textures = {"body": shell(3), "left eye/1": moved(shell(2)), "right eye": shell(1)}
    noisy = {name: with_channel(texture, NORMAL) for name, texture in textures.items()}
    return TextureSet(noisy, {"source": "me"})


def one_by_one(parts, options, **more):
    """Each point's answer by its own part's texture."""
    found = []
    for row in range(N):
        own = {name: np.asarray(value)[row : row + 1] for name, value in options.items()}
        found.append(parts[parts.names[PARTS[row]]].sample(POINTS[row : row + 1], **own, **more))
    return found


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"width": RANDOM.random(N) * 0.3},
        {"width": RANDOM.random(N).astype(np.float32) * 0.3, "normals": VECTORS[0]},
        {"dPdx": VECTORS[1] * 0.1, "dPdy": VECTORS[2] * 0.02},
        {"normals": VECTORS[0].astype(np.float32), "dPdx": VECTORS[1] * 0.1, "dPdy": VECTORS[2] * 0.02},
    ],
    ids=lambda options: "+".join(options),
)
def test_each_point_is_answered_by_its_parts_texture(parts, options):
    numbers = {"anisotropy": 3.0} if "dPdx" in options else {}
    numbers |= {"bleed_threshold": 0.0} if options and "normals" not in options else {}
    for more in ({"filter": "linear", "blur": 0.01, "normalize": False}, {"channel": "normal", **numbers}):
        found = parts.sample(POINTS, PARTS, **options, **more)
        wanted = np.concatenate(one_by_one(parts, options, **more))
        assert found.dtype == np.float32
        assert np.array_equal(found, wanted)


def test_several_channels_and_gradients_come_back_as_from_a_texture(parts):
    names = ["normal", "base_color"]
    values, gradients = parts.sample(POINTS, PARTS, names, width=0.1, gradient=True)
    pairs = one_by_one(parts, {}, channel=names, width=0.1, gradient=True)
    for name in names:
        assert np.array_equal(values[name], np.concatenate([own[name] for own, _ in pairs]))
        assert np.array_equal(gradients[name], np.concatenate([own[name] for _, own in pairs]))
    assert list(values) == names
    value, gradient = parts.sample(POINTS, PARTS, "normal", width=0.1, gradient=True)
    assert np.array_equal(value, values["normal"])
    assert np.array_equal(gradient, gradients["normal"])


def test_answers_are_written_where_the_caller_wants_them(parts):
    wanted, slopes = parts.sample(POINTS, PARTS, gradient=True)
    out, out_slopes = np.empty((N, 3), np.float32), np.empty((N, 3, 3), np.float32)
    pair = parts.sample(POINTS, PARTS, gradient=True, out=(out, out_slopes))
    assert pair[0] is out
    assert np.array_equal(out, wanted)
    assert np.array_equal(out_slopes, slopes)
    out[:] = -1.0
    assert parts.sample(POINTS, PARTS, out=out) is out
    assert np.array_equal(out, parts.sample(POINTS, PARTS))
    by_name = {"base_color": out}
    assert parts.sample(POINTS, PARTS, ["base_color"], out=by_name)["base_color"] is out


def test_parts_are_numbers_or_names_one_for_all_or_one_each(parts):
    wanted = parts.sample(POINTS, PARTS)
    names = [parts.names[part] for part in PARTS]
    for given in (PARTS.astype(np.uint8), PARTS.tolist(), names, np.array(names), np.array(names, object)):
        assert np.array_equal(parts.sample(POINTS, given), wanted)
    alone = parts["right eye"].sample(POINTS)
    for given in (2, np.int32(2), "right eye", np.array("right eye")):
        assert np.array_equal(parts.sample(POINTS, given), alone)


def test_no_points_have_no_values(parts):
    for given in ([], "body", 1, np.empty(0, np.int32)):
        assert parts.sample(np.empty((0, 3)), given, "normal").shape == (0, 3)
        assert parts.contains([], given).shape == (0,)


def test_blocks_on_threads_change_nothing(parts, monkeypatch):
    wanted, inside = parts.sample(POINTS, PARTS, width=0.1), parts.contains(POINTS, PARTS)
    monkeypatch.setattr(lookup, "BLOCK", 7)
    with ThreadPoolExecutor(3) as pool:
        assert np.array_equal(parts.sample(POINTS, PARTS, width=0.1, run=octex.Run(executor=pool)), wanted)
        assert np.array_equal(parts.contains(POINTS, PARTS, run=octex.Run(executor=pool)), inside)


def test_contains_asks_each_points_part(parts):
    own = np.array([texture.contains(POINTS) for texture in parts.values()])
    assert np.array_equal(parts.contains(POINTS, PARTS), own[PARTS, np.arange(N)])
    assert np.array_equal(parts.contains(POINTS, "left eye/1"), own[1])
    assert own.any()


def test_a_faulty_point_is_named_by_its_own_row(parts, monkeypatch):
    broken, widths = POINTS.copy(), np.full(N, 0.1)
    broken[[33, 51]], widths[44] = np.nan, -1.0
    for block in (lookup.BLOCK, 7):
        monkeypatch.setattr(lookup, "BLOCK", block)
        with pytest.raises(ArgumentError, match=r"points must be finite, but points\[33\] is \[nan"):
            parts.sample(broken, PARTS)
        with pytest.raises(ArgumentError, match=r"points\[33\]"):
            parts.contains(broken, PARTS)
        with pytest.raises(ArgumentError, match=r"not below zero, but width\[44\] is -1.0"):
            parts.sample(POINTS, PARTS, width=widths)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"parts": "nose"}, "unknown part 'nose'; there are: body, left eye/1, right eye"),
        ({"parts": ["body", "nose"] * 30}, "unknown part 'nose'; there are: body, left"),
        ({"parts": 3}, "there is no part 3; there are 0 to 2: <TextureSet of 3 parts: body, left eye/1, ri"),
        ({"parts": -1}, "there is no part -1; there are 0 to 2"),
        ({"parts": [0, 1]}, r"one for all or \(60,\), not int64 \(2,\)"),
        ({"parts": np.zeros((N, 1), int)}, r"not int64 \(60, 1\)"),
        ({"parts": np.zeros(N)}, "parts must be numbers or names, one for all .* not float64"),
        ({"parts": [True] * N}, "not bool"),
        ({"parts": [[0], [0, 1]]}, "parts must be numbers or names"),
        ({"parts": [None] * N}, "unknown part None"),
        ({"channel": "gloss"}, "unknown channel of part 'body': 'gloss'; there are: base_color, normal"),
        ({"channel": ["normal", "gloss"]}, "unknown channel of part 'body': 'gloss'"),
        ({"channel": None}, "unknown channel of part 'body': None"),
        ({"filter": "cubic"}, "unknown filter 'cubic'; there are: nearest, linear"),
        ({"filter": "nearest", "gradient": True}, "nearest has no gradient"),
        ({"width": [0.1] * 5}, r"width must be a real number or \(n,\)"),
        ({"normals": VECTORS[0][:5]}, "normals must have a row for each of 60 points, not 5"),
        ({"out": np.empty((3, 3), np.float32)}, r"must be a float32 array of shape \(60, 3\)"),
        ({"points": [[0.0, 1.0]]}, r"points must have shape \(n, 3\)"),
    ],
)
def test_what_cannot_be_looked_up_is_refused_by_name(parts, given, message):
    with pytest.raises(ArgumentError, match=message):
        parts.sample(**({"points": POINTS, "parts": PARTS} | given))


def test_a_channel_that_a_part_lacks_is_missed_only_there():
    parts = TextureSet({"a": with_channel(shell(1), ROUGHNESS), "b": shell(1)})
    assert parts.sample(POINTS, "a", "roughness").shape == (N, 1)
    with pytest.raises(ArgumentError, match="channel of part 'b': 'roughness'; there are: base_color"):
        parts.sample(POINTS, np.arange(N) % 2, "roughness")


def test_a_channel_of_other_components_in_another_part_is_refused():
    wide = ROUGHNESS._replace(components=3, space="linear")
    parts = TextureSet({"a": with_channel(shell(1), ROUGHNESS), "b": with_channel(shell(1), wide)})
    with pytest.raises(ArgumentError, match="'roughness' has 3 components in part 'b', and 1 in 'a'"):
        parts.sample(POINTS, np.arange(N) % 2, "roughness")


def test_a_set_is_a_mapping_in_order():
    textures = {name: eight_colors() for name in "dcbafe"}
    parts = TextureSet(textures, {"made": "by hand"})
    assert list(parts) == [*"dcbafe"] == list(parts.names)
    assert dict(parts) == textures
    assert len(parts) == 6
    assert "a" in parts
    assert "z" not in parts
    assert parts["c"] is textures["c"]
    assert parts.nbytes == 6 * textures["a"].nbytes
    assert repr(parts) == "<TextureSet of 6 parts: d, c, b, a, f and 1 more>"
    assert repr(TextureSet({"a": textures["a"]})) == "<TextureSet of 1 part: a>"
    assert dict(parts.metadata) == {"made": "by hand"}
    with pytest.raises(KeyError):
        parts["z"]


@pytest.mark.parametrize(
    ("textures", "metadata", "message"),
    [
        ({}, None, "needs at least one part"),
        ({"": eight_colors()}, None, "parts must have names, not ''"),
        ({0: eight_colors()}, None, "parts must have names, not 0"),
        ({"a": "a.octex"}, None, "part 'a' must be an OctreeTexture, not str"),
        ({"a": eight_colors()}, {"n": 1}, "metadata must map strings to strings"),
    ],
)
def test_what_is_no_set_is_refused(textures, metadata, message):
    with pytest.raises(ArgumentError, match=message):
        TextureSet(textures, metadata)


# --- folders


def names_in(path):
    return sorted(each.name for each in path.iterdir())


def test_a_saved_set_opens_again(parts, tmp_path):
    for name in ("one", "two"):
        parts.save(tmp_path / name)
    again = TextureSet.open(tmp_path / "one")
    assert again.names == parts.names
    assert again.metadata == parts.metadata
    assert np.array_equal(again.sample(POINTS, PARTS), parts.sample(POINTS, PARTS))
    assert again.nbytes == parts.nbytes
    assert again.info() == parts.info()
    again.validate()
    files = names_in(tmp_path / "one")
    assert files == ["body.octex", "left-eye-1.octex", "right-eye.octex", "set.json"]
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()
    sizes = [(tmp_path / "one" / file).stat().st_size for file in files[:3]]
    assert again.info()["bytes"] == sum(sizes)
    assert again.info()["provenance"] == {"source": "me"}


def test_names_of_parts_become_files_of_their_own(tmp_path):
    names = ["a", "A", "a/", "../a", "/", "ä ö", "CON", "nul.x", "x" * 300, "x" * 301, "\ud800", ".b", "set"]
    parts = TextureSet(dict.fromkeys(names, eight_colors()))
    parts.save(tmp_path / "set")
    again = TextureSet.open(tmp_path / "set")
    assert again.names == tuple(names)
    files = names_in(tmp_path / "set")
    assert len(files) == len({file.lower() for file in files}) == len(names) + 1
    for file in files[:-1]:
        assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,110}\.octex|set\.json", file)
    assert {"part-CON.octex", "part-nul.x.octex", "A-2.octex", "part.octex", "b.octex"} <= {*files}


def test_a_file_is_opened_when_its_part_is_first_needed(parts, tmp_path, monkeypatch):
    parts.save(tmp_path / "set")
    opened = []

    def noted(path):
        opened.append(path.name)
        return octex.open(path)

    monkeypatch.setattr(sets, "open_texture", noted)
    again = TextureSet.open(tmp_path / "set")
    assert repr(again) == repr(parts)
    assert len(again) == 3
    assert opened == []
    again.sample(POINTS, PARTS % 2)
    assert opened == ["body.octex", "left-eye-1.octex"]
    again.sample(POINTS, PARTS)
    assert again["body"] is again["body"]
    assert len(opened) == 3


def test_a_set_replaces_another_and_leaves_what_is_not_of_it(parts, tmp_path):
    parts.save(tmp_path)
    for name in ("notes.txt", "tail.octex"):
        (tmp_path / name).write_text("mine")
    old = TextureSet.open(tmp_path)
    values = old.sample(POINTS, PARTS)
    TextureSet({"Tail": old["right eye"], "body": old["body"]}).save(tmp_path)
    assert names_in(tmp_path) == ["Tail-2.octex", "body-2.octex", "notes.txt", "set.json", "tail.octex"]
    again = TextureSet.open(tmp_path)
    assert again.names == ("Tail", "body")
    again.validate()
    assert (tmp_path / "tail.octex").read_text() == "mine"
    old.save(tmp_path)  # its files are gone; what is mapped is still there
    assert np.array_equal(TextureSet.open(tmp_path).sample(POINTS, PARTS), values)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("at", ["part", "index"])
def test_a_broken_save_leaves_the_old_set_or_none(parts, tmp_path, monkeypatch, at, error):
    old = tmp_path / "old"
    TextureSet({"body": eight_colors()}).save(old)
    before = {name: (old / name).read_bytes() for name in names_in(old)}
    save, replacing = OctreeTexture.save, files.replacing

    def failing_save(texture, path):
        if "left" in path.name:
            raise error
        save(texture, path)

    def failing_replacing(path):
        if path.name == "set.json":
            raise error
        return replacing(path)

    if at == "part":
        monkeypatch.setattr(OctreeTexture, "save", failing_save)
    else:
        monkeypatch.setattr(files, "replacing", failing_replacing)
    wanted = OutputError if isinstance(error, OSError) else KeyboardInterrupt
    for place in (old, tmp_path / "new"):
        with pytest.raises(wanted):
            parts.save(place)
    assert {name: (old / name).read_bytes() for name in names_in(old)} == before
    assert not (tmp_path / "new").exists()


def test_a_save_that_is_interrupted_after_its_index_is_whole(parts, tmp_path, monkeypatch):
    replacing = files.replacing

    @contextmanager
    def interrupted(path):
        with replacing(path) as file:
            yield file
        if path.name == "set.json":
            raise KeyboardInterrupt

    monkeypatch.setattr(files, "replacing", interrupted)
    with pytest.raises(KeyboardInterrupt):
        parts.save(tmp_path / "new")
    again = TextureSet.open(tmp_path / "new")
    again.validate()
    assert again.names == parts.names


def test_a_folder_that_cannot_be_made_is_an_output_error(parts, tmp_path):
    (tmp_path / "file").write_text("mine")
    for place in (tmp_path / "file", tmp_path / "no" / "folder"):
        with pytest.raises(OutputError, match=r"cannot be written: .*; choose another place"):
            parts.save(place)
    assert (tmp_path / "file").read_text() == "mine"
    assert names_in(tmp_path) == ["file"]


def test_an_index_that_is_not_of_a_set_is_not_overwritten(parts, tmp_path):
    (tmp_path / "set.json").write_text('{"mine": 1}')
    with pytest.raises(OutputError, match=r"not the index of a texture set; remove set.json, or choose"):
        parts.save(tmp_path)
    assert names_in(tmp_path) == ["set.json"]


GOOD = {"format": "octex set", "format_version": 1, "parts": {"a": "a.octex"}, "provenance": {}}


@pytest.mark.parametrize(
    ("index", "message"),
    [
        (None, r"is not the folder of a texture set: it has no set\.json"),
        ("{", r"set\.json: is not JSON .*: copy or make the set again"),
        ('{"format": 1, "format": 1}', "is not JSON .a name twice"),
        ("[" * 100_000, "is not JSON"),
        ([], "is not the index of a texture set"),
        (GOOD | {"format": "octex"}, "is not the index of a texture set"),
        (GOOD | {"format_version": 2}, "has format version 2, newer than this octex reads; update octex"),
        (GOOD | {"format_version": "1"}, "has format version '1', which is none"),
        (GOOD | {"format_version": True}, "has format version True, which is none"),
        (GOOD | {"format_version": 0}, "has format version 0, which is none"),
        (GOOD | {"parts": {}}, "its parts or its provenance are damaged"),
        (GOOD | {"parts": {"": "a.octex"}}, "are damaged"),
        (GOOD | {"parts": ["a.octex"]}, "are damaged"),
        (GOOD | {"parts": {"a": 1}}, "are damaged"),
        (GOOD | {"provenance": {"a": 1}}, "are damaged"),
        (GOOD | {"parts": {"a": "b.octex"}}, r"b\.octex: the file of part 'a' is missing; copy the folder"),
        *(
            (GOOD | {"parts": {"a": file}}, r"part 'a' is in '.*', which is not an \.octex file next to it")
            for file in (
                "../a.octex", "/a.octex", "C:\\a.octex", "x/../a.octex", "a\0.octex", "..", "a.txt", "",
            )
        ),
    ],
)  # fmt: skip
def test_a_broken_folder_is_refused_in_one_line(tmp_path, index, message):
    here = tmp_path / "set"
    here.mkdir()
    for place in (here, tmp_path):
        eight_colors().save(place / "a.octex")
    if index is not None:
        (here / "set.json").write_text(index if isinstance(index, str) else json.dumps(index))
    with pytest.raises(TextureFileError, match=message) as caught:
        TextureSet.open(here)
    assert str(caught.value).count("\n") == 0


def test_an_index_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "set.json").mkdir()
    with pytest.raises(TextureFileError, match=r"set\.json: cannot be read: Is a directory"):
        TextureSet.open(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(TextureFileError, match="file: is not the folder of a texture set"):
        TextureSet.open(tmp_path / "file")


def test_a_damaged_part_is_named_when_it_is_opened_or_proved(parts, tmp_path):
    parts.save(tmp_path)
    damaged = bytearray((tmp_path / "left-eye-1.octex").read_bytes())
    damaged[4096] ^= 0xFF  # the node masks of the root
    (tmp_path / "left-eye-1.octex").write_bytes(damaged)
    with pytest.raises(TextureFileError, match=r"^part 'left eye/1': .*left-eye-1\.octex: "):
        TextureSet.open(tmp_path).validate()
    (tmp_path / "left-eye-1.octex").write_bytes(damaged[:5000])
    again = TextureSet.open(tmp_path)
    again.sample(POINTS, "body")
    with pytest.raises(TextureFileError, match=r"left-eye-1\.octex: .*cut off"):
        again.sample(POINTS, PARTS)


def test_opening_a_folder_as_a_texture_says_what_opens_it(parts, tmp_path):
    parts.save(tmp_path)
    with pytest.raises(TextureFileError, match=r"is a folder; octex\.TextureSet\.open opens a texture set"):
        octex.open(tmp_path)
