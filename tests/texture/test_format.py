"""What FORMAT.md says is enough to read a file; files of every version open."""

import runpy
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.channels import ALPHA
from octex.texture import Channel, OctreeTexture
from octex.tree.morton import decode_cells
from tests.make.small_textures import shell
from tests.texture.test_archive import assert_read_naively, hilly

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden"
READER = runpy.run_path(str(ROOT / "samples" / "read_octex.py"))


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    made = tmp_path_factory.mktemp("reader") / "read_octex"
    source = ROOT / "samples" / "read_octex.c"
    command = [
        compiler, "-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", str(source), "-o", str(made), "-lm",
    ]  # fmt: skip
    subprocess.run(command, check=True)
    return made


def kept():
    """A texture with kept nodes, split cells, alpha, and leaves of several sizes."""
    texture = hilly(5, "float16")
    alpha = Channel(
        ALPHA,
        (np.arange(texture.tree.n_cells) % 5 * 60).astype(np.uint8)[:, None],
        np.zeros((texture.tree.split.areas.size, 1), np.uint8),
        np.full((texture.tree.kept.cells.size, 1), 200, np.uint8),
    )
    channels = {**texture.channels, "alpha": alpha}
    return OctreeTexture(texture.tree, channels, texture.placement, texture.bounds)


def points_of(texture):
    random = np.random.default_rng(5)
    low, high = texture.bounds
    near = texture.tree.level_codes(texture.tree.max_depth)[:20]
    cells = decode_cells(near) / 2.0**texture.tree.max_depth
    inside = texture.placement.to_rest(cells + random.random(cells.shape) / 2.0**texture.tree.max_depth)
    return np.concatenate([inside, low + (high - low) * random.uniform(-0.2, 1.2, (20, 3))])


@pytest.mark.parametrize("filter", ["nearest", "quadratic"])
@pytest.mark.parametrize("make", [kept, lambda: hilly(4, "uint16"), lambda: shell(4)])
def test_readers_by_the_document_answer_as_octex_does(make, filter, program, tmp_path):
    texture = make()
    texture.save(tmp_path / "a.octex")
    points = points_of(texture)
    expected = texture.sample(points, filter=filter, normalize=False)
    found = READER["sample"](READER["File"](tmp_path / "a.octex"), "base_color", points, filter)
    assert np.allclose(found, expected, rtol=1e-5, atol=2e-6)
    lines = "\n".join(" ".join(f"{number:.17g}" for number in point) for point in points.tolist())
    command = [str(program), str(tmp_path / "a.octex"), "base_color", filter]
    done = subprocess.run(command, input=lines, capture_output=True, text=True, check=True)
    assert np.allclose(np.loadtxt(done.stdout.splitlines(), ndmin=2), expected, rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("example*")), ids=lambda path: path.name)
def test_files_of_every_version_open_as_they_did(path, tmp_path):
    texture = octex.open(path)
    texture.validate()
    assert texture.tree.arrays.groups.tolist() == [[0x40, 0x0802, 0x1_0000_0001]]
    assert texture.tree.arrays.flags.tolist() == [0x21, 0x01, 0x20, 0x20]
    assert texture.tree.arrays.areas.tolist() == [199, 207, 200, 210]
    assert texture.channels["base_color"].values.tolist() == [
        [150, 60, 60],
        [255, 0, 0],
        *[[100, 90, 90]] * 2,
    ]
    assert dict(texture.metadata) == {"source": "example"}
    texture.save(tmp_path / "again.octex")
    assert (tmp_path / "again.octex").read_bytes() == (GOLDEN / "example.octex").read_bytes()


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("wavy*")), ids=lambda path: path.name)
def test_archives_of_every_version_open_as_the_document_says(path):
    assert_read_naively(path, octex.open(path))


def test_the_documents_example_is_that_file():
    text = (ROOT / "octex" / "formats" / "FORMAT.md").read_text(encoding="utf-8")
    content = (GOLDEN / "example.octex").read_bytes()
    assert int.from_bytes(content[:8], "little") == 0x0FF8
    lines = text.split("from byte 4096 on:")[1].split("\n\n")[1].splitlines()
    at = 4096
    for line in lines:
        words = line.strip().split("   ")[0].split()
        if "…" in line.split("level_")[0]:
            assert [int(word[:2], 16) for word in words] == list(content[at : at + 32 : 8])
            at += 32
        else:
            assert bytes.fromhex("".join(words)) == content[at : at + len(words)]
            at += len(words)
    assert at == len(content)
