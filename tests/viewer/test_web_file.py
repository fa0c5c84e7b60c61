"""What FORMAT.md says is enough to read a web file."""

from __future__ import annotations

import io
import json
import re
import tarfile
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.cli.main import main
from octex.tree.layout import FACING_FLAGS
from octex.viewer.export import write_page
from tests.conftest import needs_jit
from tests.make.painted import ball
from tests.oracles.web_file import WebFile

VIEWER = Path(octex.__file__).parent / "viewer"


@needs_jit
@pytest.mark.parametrize("max_error", [None, 8.0])
def test_a_web_file_holds_the_texture(tmp_path: Path, max_error: float | None) -> None:
    surface = ball(24).with_sources(
        {"base_color": lambda p: 0.5 + 0.4 * np.sin(7 * p), "roughness": lambda p: 0.5 + 0.3 * p[:, :1]}
    )
    texture = octex.convert(surface, depth=5, max_error=max_error)
    write_page(texture, tmp_path / "ball.octw", surface)
    found = WebFile(tmp_path / "ball.octw")
    assert (found.header["depth"], found.header["size"]) == (5, texture.placement.size)
    assert len(found.parents) == texture.tree.n_cells
    assert len(found.leaves()) == texture.tree.n_leaves
    arrays = texture.tree.arrays
    np.testing.assert_array_equal(np.array(found.flags) & FACING_FLAGS, arrays.flags & FACING_FLAGS)
    nodes = sorted(found.areas)
    np.testing.assert_array_equal([found.areas[cell] for cell in nodes], arrays.areas[nodes])
    for name, channel in texture.channels.items():
        np.testing.assert_array_equal(found.values[name], channel.values)


def test_the_command_writes_it_with_and_without_a_model(tmp_path: Path) -> None:
    surface = ball(12)
    octex.convert(surface.with_sources({"base_color": np.ones_like}), depth=3).save(tmp_path / "ball.octex")
    octex.write_model(
        octex.bake_vertices(octex.open(tmp_path / "ball.octex"), surface), tmp_path / "ball.ply"
    )
    given = [str(tmp_path / name) for name in ("ball.octex", "ball.ply", "ball.octw")]
    assert main(["view", *given, "--quiet"]) == 0
    assert WebFile(tmp_path / "ball.octw").header["mesh"]["triangles"] == len(surface.triangles)
    assert main(["view", given[0], given[2], "--force", "--quiet"]) == 0
    assert "mesh" not in WebFile(tmp_path / "ball.octw").header


def test_the_package_has_all_that_it_imports_and_is_small() -> None:
    """As npm packs it: gzip of a tar archive of its files, at most 60 kB."""
    package = json.loads((VIEWER / "package.json").read_text())
    paths = [VIEWER / "package.json"]
    for name in package["files"]:
        paths += sorted((VIEWER / name).iterdir()) if (VIEWER / name).is_dir() else [VIEWER / name]
    for path in paths:
        if path.suffix != ".js":
            continue
        text = path.read_text()
        named = re.findall(r'from "([^"]+)"|new URL\("([^"]+)", import', text)
        for name in filter(None, (one or other for one, other in named)):
            assert name == "three" or (path.parent / name).resolve() in paths, f"{path.name}: {name}"
    with io.BytesIO() as file:
        with tarfile.open(fileobj=file, mode="w:gz") as archive:
            for path in paths:
                archive.add(path)
        assert len(file.getvalue()) <= 60_000
