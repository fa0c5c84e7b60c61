"""The documentation: its commands and Python code run, its links lead somewhere, README stays short."""

import inspect
import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import PIL.Image
import PIL.ImageDraw
import pytest
import trimesh

import octex
from octex.channels import encode
from octex.cli.main import main
from octex.cli.options import COMMANDS, OPTIONS
from octex.docs import TOPICS, topic
from octex.drawing import render_surface, source_shader
from octex.errors import ExitCode
from tests.conftest import needs_jit
from tests.make.vxz import dual_grid, vxz

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "octex" / "docs"
PAGES = {"README": ROOT / "README.md", **{name: DOCS / f"{name}.md" for name in TOPICS}}
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
#: Code of these languages is only shown.
SHOWN = {"console", "text"}
RINGS = "def rings(positions):\n    return 0.2 + 0.3 * (positions[:, :1] * 9 % 1) * [[1.0, 0.6, 0.3]]\n"


def blocks(page):
    for match in FENCE.finditer(PAGES[page].read_text("utf-8")):
        yield match[1], match[2]


def runs(page):
    return any(language not in SHOWN and "pip install" not in code for language, code in blocks(page))


def disc(path):
    """Draw on an image that octex made, or make one."""
    image = PIL.Image.open(path).convert("RGBA") if path.exists() else PIL.Image.new("RGBA", (128, 128))
    middle = image.width // 2
    PIL.ImageDraw.Draw(image).circle((middle, middle), image.width // 6, (230, 60, 30, 255))
    image.save(path)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with every file that a page takes as there."""
    folder = tmp_path_factory.mktemp("docs")
    (folder / "samples").mkdir()
    coords, dual, crossed = dual_grid(lambda points: np.linalg.norm(points - 0.5, axis=1) - 0.3, 8)
    packed = (255 * dual).astype(np.uint8), (crossed @ [[1], [2], [4]]).astype(np.uint8)
    values = {"base_color": packed[0], "dual_vertices": packed[0], "intersected": packed[1]}
    (folder / "asset.vxz").write_bytes(vxz(coords, values))
    # A light droid: atlases of all its triangles take a second each.
    droid = octex.load_surface(ROOT / "samples" / "droid.glb")
    octex.write_model(octex.finish(droid, triangles=1500, texture_size=256), folder / "droid.glb")
    for name in ("scan.glb", "samples/droid.glb"):
        shutil.copy(folder / "droid.glb", folder / name)
    surface = octex.load_surface(folder / "droid.glb", channels=["base_color"])
    bare = trimesh.Trimesh(surface.vertices, surface.triangles)
    bare.export(folder / "scan.ply")
    bare.export(folder / "statue.stl")
    octex.convert(folder / "droid.glb", depth=6).save(folder / "droid.octex")
    assert main(["convert", str(folder / "droid.octex"), str(folder / "points.ply"), "--quiet"]) == 0
    PIL.Image.fromarray(np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)).save(
        folder / "wood.png"
    )
    (folder / "wood.py").write_text(RINGS)
    disc(folder / "stencil.png")
    (folder / "photos").mkdir()
    cameras = [
        octex.Camera.fitted(surface.vertices, (np.sin(n), 0.3, np.cos(n)), size=(96, 96)) for n in range(4)
    ]
    names = [f"photos/{n}.png" for n in range(4)]
    for name, camera in zip(names, cameras, strict=True):
        image = encode(render_surface(surface, camera, source_shader(surface)), "uint8", "srgb")
        PIL.Image.fromarray(image).save(folder / name)
    frames = [
        {"file_path": name, "transform_matrix": (np.linalg.inv(whole(camera)) @ AXES).tolist()}
        for name, camera in zip(names, cameras, strict=True)
    ]
    f = cameras[0].K[0][0]
    shared = {"w": 96, "h": 96, "fl_x": f, "fl_y": f, "cx": 48.0, "cy": 48.0}
    (folder / "transforms.json").write_text(json.dumps({**shared, "frames": frames}))
    return folder


#: From axes of glTF's cameras to those of images.
AXES = np.diag([1.0, -1.0, -1.0, 1.0])


def whole(camera):
    return np.vstack([np.asarray(camera.world_to_camera)[:3], [0, 0, 0, 1]])


#: What options and arguments that take long are changed to.
SMALL = {
    "--depth |depth=": "5",
    "--size ": "128,96",
    "--texture-size |texture_size=": "256",
    "texels=": "20_000",
    r"\bsize=(?=\(\d+, \d+\))": "(128, 128)",
}


def coarse(code):
    """Return code whose textures and images take a moment; arrays stay as large as their cameras."""
    for words, small in [*SMALL.items()][: -1 if "np.zeros((" in code else None]:
        code = re.sub(rf"({words})(?:\(\d+, \d+\)|[\d_]+(?:,\d+)?)", rf"\g<1>{small}", code)
    return re.sub(r"octex\.bake\((\w+), (\w+)\)", r"octex.bake(\1, \2, texture_size=256)", code)


def run_command(line):
    words = [
        name
        for word in shlex.split(coarse(line), comments=True)[1:]
        for name in (sorted(map(str, Path().glob(word))) if "*" in word else [word])
    ]
    command = COMMANDS[words[0]]
    silent = [word for word in ("--force", "--quiet") if command.has(word)]
    if words[0] == "view" and not any(word.endswith((".html", ".octw")) for word in words):
        silent = ["--no-browser", "--quiet"]
    if words[0] == "draw" and "--size" not in words:
        words += ["--size", "128,128"]
    if words[0] == "bake" and words[-1].endswith(".glb"):  # without options
        words += ["--texture-size", "256"]
    assert main([*words, *(word for word in silent if word not in words)]) == ExitCode.DONE, line
    if "paint" in words[1:]:
        disc(Path(words[3]))
    if "--empty-layer" in words:
        disc(Path(words[words.index("--empty-layer") + 1]))


@needs_jit
@pytest.mark.usefixtures("few_points", "small_previews")
@pytest.mark.parametrize("page", [name for name in PAGES if runs(name)])
def test_the_code_of_a_page_runs(page, files, tmp_path, monkeypatch):
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("octex.viewer.server._FIRST", 0)  # octex view waits for no page
    names = {"__name__": page}
    for language, code in blocks(page):
        if language == "python":
            exec(compile(coarse(code), f"{page}.md", "exec"), names)
        elif language == "sh":
            for line in code.replace("\\\n", "").splitlines():
                if line.startswith("octex "):
                    run_command(line)
                else:
                    assert page == "README", f"{page}: {line}"
        else:
            assert language in SHOWN, f"{page}: {language}"


@pytest.mark.parametrize("page", PAGES)
def test_links_and_names_of_pages_lead_somewhere(page):
    text = PAGES[page].read_text("utf-8")
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", text):
        assert (PAGES[page].parent / target).exists(), target
    for name in re.findall(r"octex help ([a-z][a-z-]+)", text):
        assert name in TOPICS, name
    for line in re.findall(r"See also: (.*)", text):
        assert set(re.findall(r"`([a-z-]+)`", line)) <= set(TOPICS), line


def test_every_page_is_listed_once():
    assert sorted(path.stem for path in DOCS.glob("*.md")) == sorted(TOPICS)


def test_readme_is_read_in_minutes():
    assert len(PAGES["README"].read_text("utf-8").split()) <= 700


def public():
    """Yield what octex exports, and the public methods of that."""
    for name in (*octex.__all__, "map", "open"):
        exported = getattr(octex, name)
        yield name, exported
        if inspect.isclass(exported):
            yield from (
                (f"{name}.{each}", getattr(exported, each)) for each in vars(exported) if each[0] != "_"
            )


def test_docstrings_are_read_in_a_minute():
    lengths = {name: len((inspect.getdoc(each) or "").splitlines()) for name, each in public()}
    assert {name: length for name, length in lengths.items() if length > 40} == {}


def test_every_option_stands_on_a_page():
    text = " ".join(path.read_text("utf-8") for path in PAGES.values())
    assert {word for word in re.findall(r"--[a-z][a-z-]+", text) if word in OPTIONS} == {*OPTIONS}


def test_code_is_indented_where_a_page_is_printed():
    text = topic("page")
    assert "```" not in text
    assert "\n    octex view droid.octex droid.glb\n" in text
