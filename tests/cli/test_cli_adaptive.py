"""Adaptive conversions at the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import octex
from tests.make.command import Cli
from tests.make.fixtures import png, textured_square


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A square with a speckled corner."""
    image = np.full((32, 32, 3), 90, np.uint8)
    image[:4, :4] = np.random.default_rng(0).integers(0, 256, (4, 4, 3))
    return textured_square(tmp_path_factory.mktemp("model") / "square.glb", png(image))


@pytest.fixture(scope="module")
def mask(model: Path) -> Path:
    """White on the left, a quarter on the right."""
    path = model.with_name("mask.png")
    image = np.full((32, 32, 1), 255, np.uint8)
    image[:, 16:] = 64
    path.write_bytes(png(image))
    return path


def made(cli: Cli, model: Path, folder: Path, *words: object) -> octex.OctreeTexture:
    out = folder / "made.octex"
    cli.result(model, out, "--depth", 6, "--force", *words)
    return octex.open(out)


def assert_same(one: octex.OctreeTexture, other: octex.OctreeTexture, folder: Path) -> None:
    for name, texture in (("one", one), ("other", other)):
        texture.save(folder / f"{name}.octex")
    assert (folder / "one.octex").read_bytes() == (folder / "other.octex").read_bytes()


def test_max_error_merges_leaves(model: Path, tmp_path: Path, cli: Cli) -> None:
    found = made(cli, model, tmp_path, "--max-error", 2)
    assert_same(found, octex.convert(model, 6, max_error=2), tmp_path)
    assert found.tree.n_leaves < octex.convert(model, 6).tree.n_leaves / 4


def test_no_fit_keeps_averages(model: Path, tmp_path: Path, cli: Cli) -> None:
    assert_same(made(cli, model, tmp_path, "--no-fit"), octex.convert(model, 6, fit=False), tmp_path)


def test_detail_stretch_reads_the_rest_mesh(model: Path, tmp_path: Path, cli: Cli) -> None:
    found = made(cli, model, tmp_path, "--detail", "stretch", "--rest", model)
    assert_same(found, octex.convert(model, 6, rest=model, detail="stretch"), tmp_path)


def test_a_painted_channel_steers_and_is_stored_if_it_is_named(
    model: Path, mask: Path, tmp_path: Path, cli: Cli
) -> None:
    words = ["--detail", "detail", "--source", f"detail={mask}"]
    found = made(cli, model, tmp_path, *words, "--channels", "base_color")
    assert list(found.channels) == ["base_color"]
    (fine, _), (coarse, _) = found.tree.cells_by_depth()[6], found.tree.cells_by_depth()[4]
    assert fine > 0
    assert coarse > 0
    both = made(cli, model, tmp_path, *words)
    assert list(both.channels) == ["base_color", "detail"]
    assert both.tree.n_leaves == found.tree.n_leaves


@pytest.mark.parametrize("option", ["--max-error 2", "--detail stretch", "--no-fit"])
def test_a_texture_cannot_adapt_any_more(option: str, model: Path, tmp_path: Path, cli: Cli) -> None:
    texture = tmp_path / "a.octex"
    octex.convert(model, 3).save(texture)
    word = option.split()[0]
    assert cli.refusal(texture, tmp_path / "b.octex", *option.split()) == (
        f"{texture}: {word} needs the model, but this is a texture made from it; see octex edit"
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--detail wear", "unknown detail 'wear'; there are: base_color, stretch"),
        (
            "--detail base_color",
            "--detail must be a channel with one component in 0 … 1, and 'base_color' is not",
        ),
        (
            "--channels base_color --detail stretch --source alpha=1",
            "--source gives alpha, but --channels leaves it out",
        ),
    ],
)
def test_what_cannot_steer_is_refused(
    words: str, message: str, model: Path, tmp_path: Path, cli: Cli
) -> None:
    assert cli.refusal(model, tmp_path / "x.octex", "--depth", 3, *words.split()) == message
