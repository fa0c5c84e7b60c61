"""Vertex colours as 3MF for printing: read back by lib3mf, and as the XML that the file is."""

import json
import locale
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest

import octex
from octex.channels import linear_to_srgb
from octex.errors import MissingExtraError, ModelError
from octex.source.surface import Surface
from tests.make import solids
from tests.make.painted import waves

MATERIALS = "{http://schemas.microsoft.com/3dmanufacturing/material/2015/02}"
CORE = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"


@pytest.fixture(scope="module")
def ball():
    surface = Surface.from_arrays(*solids.sphere([0.0, 0.0, 0.0], 1.0, 16))
    return octex.convert(surface.with_sources({"base_color": waves}), 5), surface


@pytest.fixture
def lib3mf():
    before = locale.setlocale(locale.LC_ALL)
    yield pytest.importorskip("lib3mf", reason="the extra octex[3mf] is not installed")
    locale.setlocale(locale.LC_ALL, before)  # reading changes it


def test_lib3mf_reads_a_closed_mesh_in_the_fields_colours(ball, lib3mf, tmp_path):
    texture, surface = ball
    made = octex.bake_vertices(texture, surface, subdivide="auto", max_error=4.0)
    before = locale.setlocale(locale.LC_ALL)
    octex.write_model(made, tmp_path / "ball.3mf", unit="inch")
    assert locale.setlocale(locale.LC_ALL) == before
    wrapper = lib3mf.get_wrapper()
    model = wrapper.CreateModel()
    reader = model.QueryReader("3mf")
    reader.SetStrictModeActive(True)
    reader.ReadFromFile(str(tmp_path / "ball.3mf"))
    assert reader.GetWarningCount() == 0
    assert model.GetUnit() == lib3mf.ModelUnit.Inch
    items = model.GetBuildItems()
    assert items.MoveNext()
    assert not items.Clone().Count() > 1
    meshes = model.GetMeshObjects()
    assert meshes.MoveNext()
    mesh = meshes.GetCurrentMeshObject()
    assert mesh.IsValid()
    assert mesh.IsManifoldAndOriented()
    vertices = np.array([list(each.Coordinates) for each in mesh.GetVertices()])
    triangles = np.array([list(each.Indices) for each in mesh.GetTriangleIndices()])
    np.testing.assert_allclose(vertices[triangles], made.vertices[made.triangles], atol=1e-6)
    groups = model.GetColorGroups()
    assert groups.MoveNext()
    group = groups.GetCurrentColorGroup()
    colors = {number: wrapper.ColorToRGBA(group.GetColor(number)) for number in group.GetAllPropertyIDs()}
    properties = mesh.GetAllTriangleProperties()
    assert {each.ResourceID for each in properties} == {group.GetResourceID()}
    found = np.array([[colors[number] for number in each.PropertyIDs] for each in properties])
    at_corners = vertices[triangles].reshape(-1, 3)
    field = linear_to_srgb(texture.sample(at_corners, normals=at_corners)).reshape(-1, 3, 3)
    np.testing.assert_allclose(found[..., :3] / 255.0, field, atol=0.01)
    assert (found[..., 3] == 255).all()


@pytest.mark.usefixtures("lib3mf")
def test_the_file_says_colours_as_the_specification_has_them(tmp_path):
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    colors = np.array([[255, 0, 0, 255], [0, 128, 0, 255], [0, 0, 255, 64], [1, 2, 3, 255]], np.uint8)
    # The second triangle has corners of its own in the same places, and one has no area.
    surface = Surface.from_arrays(
        np.concatenate([square, square[[0, 2]]]),
        [[0, 1, 2], [4, 5, 3], [0, 4, 1]],
        colors=np.concatenate([colors, colors[[0, 2]]]),
    )
    octex.write_model(surface, tmp_path / "square.3mf", unit="millimeter")
    with zipfile.ZipFile(tmp_path / "square.3mf") as package:
        tree = ElementTree.fromstring(package.read("3D/3dmodel.model"))
    assert tree.get("unit") == "millimeter"
    read = octex.load_surface(tmp_path / "square.3mf")
    samples = read.scatter(100, seed=0)
    np.testing.assert_allclose(read.vertices[read.triangles], surface.vertices[surface.triangles][:2])
    np.testing.assert_allclose(read.evaluate(samples), surface.evaluate(samples), atol=1e-6)
    group = tree.find(f".//{MATERIALS}colorgroup")
    texts = [str(each.get("color")).upper() for each in group]
    assert sorted(texts) == ["#0000FF40", "#008000FF", "#010203FF", "#FF0000FF"]
    places = [[float(each.get(axis, "")) for axis in "xyz"] for each in tree.iter(f"{CORE}vertex")]
    assert len(places) == 4
    triangles = list(tree.iter(f"{CORE}triangle"))
    assert len(triangles) == 2
    for triangle in triangles:
        assert triangle.get("pid") == group.get("id")
        for corner in "123":
            place = places[int(triangle.get(f"v{corner}", ""))]
            code = colors[int((square == place).all(axis=1).argmax())]
            assert texts[int(triangle.get(f"p{corner}", ""))] == "#" + bytes(code).hex().upper()


@pytest.mark.usefixtures("lib3mf")
def test_what_has_images_is_to_be_baked_first(tmp_path):
    bare = Surface.from_arrays(np.eye(3), [[0, 1, 2]])
    with pytest.raises(ModelError, match=r"\.3mf files hold colours at vertices"):
        octex.write_model(bare, tmp_path / "a.3mf")
    point = Surface.from_arrays(np.zeros((3, 3)), [[0, 1, 2]], colors=np.zeros((3, 3)))
    with pytest.raises(ModelError, match="nothing to print"):
        octex.write_model(point, tmp_path / "a.3mf")


@pytest.mark.usefixtures("lib3mf")
def test_the_command_divides_where_colours_change(ball, tmp_path, cli):
    texture, surface = ball
    texture.save(tmp_path / "ball.octex")
    octex.write_model(octex.bake_vertices(texture, surface), tmp_path / "ball.obj")
    given = [str(tmp_path / name) for name in ("ball.octex", "ball.obj", "out.3mf")]
    told = cli.result("bake", *given, "--unit", "foot", "--vertex-error", 2, "--json")
    assert json.loads(told)["triangles"] > 2 * len(surface.triangles)
    with zipfile.ZipFile(given[2]) as package:
        assert b'unit="foot"' in package.read("3D/3dmodel.model")
    assert "octex bake TEXTURE MODEL" in cli.refusal(given[0], tmp_path / "b.3mf")
    refusal = cli.refusal("bake", *given[:2], tmp_path / "b.glb", "--unit", "foot")
    assert "--unit has no effect on" in refusal


def test_a_missing_extra_is_named_before_any_work(ball, tmp_path, monkeypatch, cli):
    texture, surface = ball
    made = octex.bake_vertices(texture, surface)
    texture.save(tmp_path / "ball.octex")
    octex.write_model(made, tmp_path / "ball.obj")
    monkeypatch.setattr("octex.formats.models.find_spec", lambda _: None)
    for ending, package, extra in [(".3mf", "lib3mf", "3mf"), (".usdz", "usd-core", "usd")]:
        words = rf"to write a{ending}, {package} is needed; install it: pip install 'octex\[{extra}\]'"
        with pytest.raises(MissingExtraError, match=words):
            octex.write_model(made, tmp_path / f"a{ending}")
        files = (tmp_path / name for name in ("ball.octex", "ball.obj", f"a{ending}"))
        assert f"pip install 'octex[{extra}]'" in cli.refusal("bake", *files)
