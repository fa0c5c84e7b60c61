"""Commands read textures at addresses, as they read those in files; what they write lies here."""

import json

import pytest

import octex
from octex.cli.values import Address, texture_file
from octex.errors import ExitCode
from tests.make.fixtures import png, random_image, textured_square

fsspec = pytest.importorskip("fsspec", reason="needs the extra octex[remote]")

THERE = "memory://octex/a.octex"


@pytest.fixture(scope="module")
def square(tmp_path_factory):
    """A model; beside it, and elsewhere, its texture."""
    path = tmp_path_factory.mktemp("square") / "square.glb"
    textured_square(path, png(random_image(8, 8)))
    octex.convert(path, depth=4).save(path.with_suffix(".octex"))
    octex.open(path.with_suffix(".octex")).save(path.with_suffix(".octz"))
    for ending in (".octex", ".octz"):
        content = path.with_suffix(ending).read_bytes()
        fsspec.filesystem("memory").pipe(f"/octex/a{ending}", content)
    return path


@pytest.mark.usefixtures("small_previews")
def test_commands_read_a_texture_at_an_address_as_in_a_file(cli, square, tmp_path):
    here = square.with_suffix(".octex")
    assert cli.result("info", THERE) == cli.result("info", here)
    assert cli.result("validate", THERE) == "valid\n"
    told = json.loads(cli.result("validate", "memory://octex/a.octz", "--json"))
    assert told == {"file": "memory://octex/a.octz", "valid": True, "broken": None}
    assert "base_color" in cli.result("diff", THERE, square)
    for number, words in enumerate((["--depth", 3], ["--mix", f"{THERE}=0.5", "--depth", 4])):
        made = [tmp_path / f"{number}{name}.octex" for name in "ab"]
        for path, given in zip(made, (THERE, here), strict=True):
            cli.result("edit", given, path, *words, "--quiet")
        assert made[0].read_bytes() == made[1].read_bytes()
    cli.result(THERE, tmp_path / "a.octz", "--preview", tmp_path / "a.png", "--quiet")
    assert (tmp_path / "a.octz").read_bytes() == square.with_suffix(".octz").read_bytes()
    cli.result("view", THERE, square, tmp_path / "page.html", "--quiet")
    for name, given in (("a", THERE), ("b", here)):
        cli.result("bake", given, square, tmp_path / f"{name}.glb", "--quiet")
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()
    view = [tmp_path / "view.png", "--as", "paint", "--camera-out", tmp_path / "view.json", "--size", "32,32"]
    cli.result("draw", THERE, square, *view, "--quiet")


def test_what_is_no_texture_or_is_written_has_no_address(cli, square, tmp_path):
    out, url, camera = tmp_path / "a.octex", "https://a.b/c", "--camera: https://a.b/c.json"
    paint = "paint", square, "a.octex", "view.png", "--camera"
    for words, said in (
        ((f"{url}.glb", "d.octex"), f"{url}.glb is a URL; octex reads only textures, NAME.octex and"),
        ((THERE, "s3://a/b.octex"), "s3://a/b.octex is a URL, and octex writes to disk only"),
        ((square, out, "--rest", f"{url}.glb"), f"{url}.glb is a URL, and"),
        (("draw", square, tmp_path / "a.png", "--light", f"{url}.hdr"), f"--light: {url}.hdr is"),
        ((square, out, "--source", f"base_color={url}.png"), f"--source: {url}.png is"),
        (("paint", THERE, square, THERE, "a.png", "--camera", "c"), f"{THERE} is a URL, and octex writes"),
        ((*paint, f"{url}.json"), f"{camera} is a URL, and octex reads this file from disk"),
        ((*paint, f"{url}.json#left"), f"{camera}#left is a URL, and octex reads this file from disk"),
    ):
        assert said in cli.errors(*words, code=ExitCode.REFUSED)
    none = "memory://octex/none.octex"
    for words in (("info", none), ("validate", none), ("edit", none, tmp_path / "b.octex", "--depth", 2)):
        assert cli.refusal(*words).startswith(f"{none}: cannot be read: there is no such file")
    fsspec.filesystem("memory").pipe("/octex/cut.octex", square.with_suffix(".octex").read_bytes()[:-1])
    assert cli.run("validate", "memory://octex/cut.octex") == ExitCode.INVALID
    assert cli.said()[0].startswith("memory://octex/cut.octex: ")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("https://a.b/c/d.octex?key=a/b.c#e", "d.octex"),
        ("simplecache::s3://a/d.OCTZ", "d.OCTZ"),
        ("zip://d.octex::https://a.b/c.zip", "d.octex"),
    ],
)
def test_addresses_have_the_ending_of_the_file_that_they_name(text, name, tmp_path):
    address = texture_file(text)
    assert isinstance(address, Address)
    assert (str(address), address.name) == (text, name)
    assert address.suffix.lower() in (".octex", ".octz")
    assert texture_file(str(tmp_path)) == tmp_path
