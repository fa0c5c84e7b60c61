"""Damaged files are refused, or answer; `tools/fuzz/soak.py damage` tries many more."""

import os
import sys
from collections import Counter
from pathlib import Path
from random import Random

import pytest

from tests.conftest import needs_jit
from tests.make.fixtures import OBJ_SQUARE, obj, png, random_image, textured_square

TOOLS = Path(__file__).parents[2] / "tools" / "fuzz"
#: Files with which something was wrong once.
DAMAGED = sorted((Path(__file__).parents[1] / "damaged").iterdir())

pytestmark = [needs_jit, pytest.mark.skipif(sys.platform != "linux", reason="the fuzzer forks")]


@pytest.fixture
def fuzz(monkeypatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    import random_damage

    return random_damage


@pytest.mark.parametrize("kind", [".octex", ".octz", "points", "voxels", "cameras"])
def test_files_that_are_sound_answer_in_every_way(kind, tmp_path, fuzz):
    for number in range(4):
        parts = fuzz.files(number)[kind]
        path = tmp_path / f"good{parts.ending}"
        path.write_bytes(parts.content)
        for seed in range(60):
            word = fuzz.use(path, kind, Random(seed))
            assert word == "sound" or kind == "points"  # of which a cloud needs three


def test_damaged_files_of_many_seeds_are_refused_or_answer(tmp_path, fuzz):
    outcomes = [fuzz.attempt(seed, tmp_path) for seed in range(400)]
    words = Counter(word for word, _ in outcomes)
    assert min(words[word] for word in ("refused", "unsound", "sound")) > 5  # it reaches both ends
    assert {what.split(":")[0] for _, what in outcomes} == set(fuzz.KINDS)


@pytest.mark.parametrize("damaged", DAMAGED, ids=lambda path: path.stem)
def test_what_was_wrong_with_a_file_once_is_mended(damaged, tmp_path, fuzz):
    kind = damaged.stem.partition("_")[0] if damaged.suffix == ".npz" else damaged.suffix
    path = tmp_path / damaged.name
    path.write_bytes(damaged.read_bytes())
    words = {fuzz.use(path, kind, Random(seed)) for seed in range(60)}
    assert len(words) == 1
    assert words <= {"refused", "unsound"}


def test_an_archive_that_opens_although_bytes_were_changed_is_a_finding(tmp_path, fuzz, monkeypatch):
    monkeypatch.setattr(fuzz, "KINDS", (".octz",))
    monkeypatch.setattr(fuzz, "damaged", lambda parts, _chance: (parts.content, "blind", True))
    with pytest.raises(AssertionError, match="bytes were changed"):
        fuzz.attempt(0, tmp_path)
    assert (tmp_path / "damaged.octz").exists()


@pytest.fixture
def others(monkeypatch):
    """The kind for files of other programs."""
    monkeypatch.syspath_prepend(str(TOOLS))
    monkeypatch.setenv("OCTEX_TRACEBACK", "1")  # which it sets
    import random_files

    return random_files


def test_files_of_others_convert_or_are_refused_in_a_line(tmp_path, others, monkeypatch, capfd):
    folder, image = tmp_path / "files", png(random_image(8, 8))
    folder.mkdir()
    (folder / "whole.png").write_bytes(image)
    (folder / "cut.png").write_bytes(image[:-30])
    (folder / "notes.txt").write_text("neither a model nor an image")
    textured_square(folder / "square.glb", image)
    (folder / "torn.glb").write_bytes((folder / "square.glb").read_bytes()[:100])
    obj(folder / "lost.obj", OBJ_SQUARE + "f 1 2 9\n")
    monkeypatch.setenv("OCTEX_TEST_MODELS", str(folder))
    others.files.cache_clear()
    assert [path.name for path in others.files()] == [
        "cut.png", "lost.obj", "square.glb", "torn.glb", "whole.png",
    ]  # fmt: skip
    found = [others.check(seed) for seed in range(20)]
    others.files.cache_clear()
    words = [".png: refused", ".obj: refused", ".glb: converted", ".glb: refused", ".png: converted"]
    assert found[:5] == words
    assert {each.rpartition(" ")[2] for each in found} == {"refused", "converted"}
    assert capfd.readouterr() == ("", "")


def test_damaged_copies_are_the_same_each_time_and_keep_the_json_of_glb(tmp_path, others):
    textured_square(tmp_path / "a.glb", png(random_image(8, 8)))
    whole = (tmp_path / "a.glb").read_bytes()
    length = 20 + int.from_bytes(whole[12:16], "little")
    copies = [others.damaged(tmp_path / "a.glb", Random(n // 2), tmp_path).read_bytes() for n in range(10)]
    assert copies[::2] == copies[1::2]
    assert len({whole, *copies}) == 6
    assert {copy[:length] for copy in copies} == {whole[:length]}
    model = obj(tmp_path / "a.obj", OBJ_SQUARE)
    assert others.damaged(model, Random(0), tmp_path) == model


@pytest.mark.parametrize(
    ("said", "code", "message"),
    [
        ("well\nwell\n", 2, "well"),
        ("", 2, r"\[\]"),
        ("a warning\n", 0, "a warning"),
        ("", 1, r"\(1, \[\]\)"),
        ("error: out of memory\n", 2, "out of memory"),
        (300, 0, "MB, where 268 MB are allowed"),
    ],
)
def test_all_but_silence_and_a_refusal_is_a_finding(said, code, message, tmp_path, others, monkeypatch):
    def converted(*_):
        if isinstance(said, int):
            assert bytearray(b"1") * (said << 20)
        else:
            os.write(2, said.encode())
        return code

    monkeypatch.setattr(others, "converted", converted)
    (tmp_path / "a.png").touch()
    with pytest.raises(AssertionError, match=message):
        others.attempt(tmp_path / "a.png", tmp_path)


def test_what_a_model_refers_to_counts_as_its_size(tmp_path, others):
    (tmp_path / "unused.png").write_bytes(bytes(5000))
    images = {"a/b.png": png(random_image(8, 8))}
    path = obj(tmp_path / "square.obj", OBJ_SQUARE, "newmtl a\nmap_Kd a/b.png\n", images)
    named = path, tmp_path / "square.mtl", tmp_path / "a" / "b.png"
    assert others.bytes_with_references(path) == sum(file.stat().st_size for file in named)
    assert others.bytes_with_references(tmp_path / "unused.png") == 5000


def test_nothing_bad_happens_with_real_fragile_files(models, tmp_path, others, monkeypatch):
    if not (models / "fragile").is_dir():
        pytest.skip("no folder of fragile models")
    monkeypatch.setenv("OCTEX_TEST_MODELS", str(models / "fragile"))
    others.files.cache_clear()
    words = {path: others.attempt(path, tmp_path) for path in others.files()}
    others.files.cache_clear()
    corrupt = [path for path in words if path.name.startswith("x") and "png-suite" in path.parts]
    assert corrupt
    assert {words[path] for path in corrupt} == {"refused"}
