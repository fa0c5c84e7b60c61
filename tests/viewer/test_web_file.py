"""What FORMAT.md says is enough to read a web file."""

import io
import json
import re
import shutil
import subprocess
import tarfile
from base64 import b64encode
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.arrays import bit_counts
from octex.cli.main import main
from octex.tree.children import masks_of
from octex.viewer.mesh import packed_mesh
from tests.make.painted import ball
from tests.make.small_surfaces import sheet
from tests.oracles.web_file import WebFile

GOLDEN = Path(__file__).parents[1] / "golden"
VIEWER = Path(octex.__file__).parent / "viewer"


def test_the_command_writes_it_with_and_without_a_model(tmp_path):
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


#: Prints what octex-three reads of a file: of its one part the octree, and the mesh.
READ = """
const [, module, path] = process.argv, { contents } = await import(module);
const { readFileSync } = await import("node:fs"), whole = readFileSync(path);
const buffer = whole.buffer.slice(whole.byteOffset, whole.byteOffset + whole.length);
const found = { planes: [], words: [], entries: [] };
for await (const { header, mesh, rows } of contents({ name: path, buffer })) {
  if (header) found.header = header;
  if (mesh) found.mesh = [mesh.positions, mesh.normals, mesh.triangles].map((each) => Array.from(each));
  if (!rows) continue;
  found.words.push(...rows.words);
  found.entries.push(...rows.pairs);
  rows.planes.forEach((plane, n) => (found.planes[n] ??= []).push(...plane));
}
console.log(JSON.stringify(found));
"""


def test_the_readers_agree_on_the_file_of_version_1():
    """In Python and in JavaScript: levels, tables of kept nodes and split cells, and a mesh."""
    wanted, path = octex.open(GOLDEN / "web.octex"), GOLDEN / "web.octw"
    tree, channel = wanted.tree, wanted.channels["base_color"]
    assert tree.kept.cells.size > 50 and tree.split.cells.size > 50
    back = octex.open(path)
    np.testing.assert_array_equal(WebFile(path).values["base_color"], channel.values)
    for one, other in zip(
        [*back.tree.arrays[:4], *back.tree.split[:2], *back.tree.kept, *back.channels["base_color"][1:]],
        [*tree.arrays[:4], *tree.split[:2], *tree.kept, *channel[1:]],
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    if shutil.which("node") is None:
        pytest.skip("no node")
    module = (VIEWER / "three" / "contents.js").as_uri()
    command = ["node", "--input-type=module", "-e", READ, module, str(path)]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    found = json.loads(said)
    header = found["header"]["parts"][0]
    [plane, slot] = header["channels"][0]["at"]
    rows = np.array(found["planes"][plane], np.uint8).reshape(-1, 4)[:, slot : slot + 3]
    np.testing.assert_array_equal(rows, np.concatenate([channel[1], channel[3], channel[2]]))
    words = np.array(found["words"], np.uint32).reshape(-1, 2) & 255
    masks = [masks_of(tree.arrays.groups, word)[: len(words)] for word in range(2)]
    np.testing.assert_array_equal(words, np.stack(masks, axis=1))
    entries = np.array(found["entries"]).reshape(-1, 2)
    np.testing.assert_array_equal(entries[:, 0], [*tree.kept.cells, *tree.split.cells])
    counts = bit_counts(tree.split.facings)
    firsts = [*range(tree.kept.cells.size), *(np.cumsum(counts) - counts)]
    np.testing.assert_array_equal(entries[:, 1], firsts)
    surface = sheet(np.eye(3), 0.01)
    positions, normals, triangles = (np.array(each).reshape(-1, 3) for each in found["mesh"])
    corners = surface.vertices[surface.triangles]
    turned = np.stack([np.roll(positions[triangles], step, axis=1) for step in range(3)])
    gaps = np.abs(turned[:, :, None] - corners).max(axis=(3, 4)).min(axis=0)  # of each two triangles
    assert sorted(gaps.argmin(axis=1)) == list(range(len(corners)))
    assert gaps.min(axis=1).max() <= header["size"] * 2.0**-16
    corners = corners[gaps.argmin(axis=1)]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sides /= np.linalg.norm(sides, axis=1)[:, None]
    assert (np.einsum("ni,ni->n", normals[triangles[:, 0]], sides) > 0.6).all()


#: Prints positions and triangles of meshes that are read from the standard input.
UNPACK = """
const { unpackedMesh } = await import(process.argv[1]);
const meshes = JSON.parse((await import("node:fs")).readFileSync(0));
const read = ([header, stream]) => unpackedMesh(header, Buffer.from(stream, "base64"), null);
const printed = ({ rest, triangles }) => [Array.from(rest), Array.from(triangles)];
console.log(JSON.stringify(meshes.map(read).map(printed)));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="no node")
def test_pages_get_each_triangle_of_random_meshes_the_same_way_round():
    """Also with borders, edges of three triangles and more, doubled triangles, and such without area."""
    rng = np.random.default_rng(6)
    texture = octex.convert(sheet(np.eye(3), 0.01), depth=2)
    low, size = np.array(texture.placement.origin), texture.placement.size
    packed, wanted = [], []
    for count in [1, 2, 3, 5, *rng.integers(4, 200, 20)]:
        vertices = low + size * rng.random((rng.integers(3, 9 + count // 2), 3))
        triangles = rng.integers(0, len(vertices), (count, 3))
        surface = octex.Surface.from_arrays(vertices, triangles)
        header, stream = packed_mesh(texture, surface)
        packed.append((header, b64encode(stream).decode()))
        wanted.append(np.rint((vertices - low) / size * 2 ** header["bits"]).astype(int)[surface.triangles])
        assert header["edges"] <= 3 * count and header["corners"] <= 3 * count
    command = ["node", "--input-type=module", "-e", UNPACK, (VIEWER / "page" / "mesh.js").as_uri()]
    said = subprocess.run(
        command, input=json.dumps(packed), capture_output=True, text=True, check=True, timeout=60
    ).stdout
    for (rest, triangles), (header, _), corners in zip(json.loads(said), packed, wanted, strict=True):
        found = np.rint(np.array(rest).reshape(-1, 3) * 2 ** header["bits"]).astype(int)
        assert _turned(found[np.array(triangles).reshape(-1, 3)]) == _turned(corners)


def _turned(triangles):
    """Return triangles (m, 3, 3) in order, each with its least corner first."""
    return sorted(min([*each[n:], *each[:n]] for n in range(3)) for each in triangles.tolist())


def test_the_package_has_all_that_it_imports_and_is_small():
    """As npm packs it: gzip of a tar archive of its files, at most 60 kB."""
    package = json.loads((VIEWER / "package.json").read_text())
    paths = [VIEWER / name for name in ("package.json", "README.md", "LICENSE")]  # npm packs these by itself
    assert paths[2].read_bytes() == (GOLDEN.parents[1] / "LICENSE").read_bytes()
    for name in package["files"]:
        paths += sorted((VIEWER / name).iterdir()) if (VIEWER / name).is_dir() else [VIEWER / name]
    for path in paths:
        if path.suffix != ".js":
            continue
        text = path.read_text()
        named = re.findall(r'from "([^"]+)"|new URL\("([^"]+)", import', text)
        for name in filter(None, (one or other for one, other in named)):
            assert name.startswith("three") or (path.parent / name).resolve() in paths, f"{path.name}: {name}"
    with io.BytesIO() as file:
        with tarfile.open(fileobj=file, mode="w:gz") as archive:
            for path in paths:
                archive.add(path)
        assert len(file.getvalue()) <= 60_000
