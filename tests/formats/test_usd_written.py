"""USD stages that octex writes."""

import zipfile

import numpy as np
import pytest

import octex
from octex.errors import ModelError
from octex.source.materials import Input, Material, MaterialSource
from octex.source.surface import Surface
from tests.make import solids
from tests.make.small_surfaces import whole

pytest.importorskip("pxr", reason="the extra octex[usd] is not installed")
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdValidation

from tests.source.test_usd import SQUARE, ST


@pytest.fixture(scope="module")
def baked():
    surface = whole()
    return octex.bake(octex.convert(surface, 4), surface, texture_size=64)


def validated(stage):
    """What OpenUSD's own validators say against a stage."""
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    return [error.GetErrorAsString() for error in context.Validate(stage)]


@pytest.mark.parametrize("ending", [".usdz", ".usda", ".usdc", ".usd"])
def test_written_stages_are_valid_and_read_back_as_they_were(baked, ending, tmp_path):
    path = tmp_path / f"whole{ending}"
    octex.write_model(baked, path, unit="meter")
    assert validated(Usd.Stage.Open(str(path))) == []
    read = octex.load_surface(path, normals=True)
    assert [form.name for form in read.channels] == [form.name for form in baked.channels]
    np.testing.assert_allclose(read.vertices[read.triangles], baked.vertices[baked.triangles], atol=1e-7)
    points = baked.scatter(2000)
    for form in baked.channels:
        np.testing.assert_allclose(
            read.evaluate(points, form.name), baked.evaluate(points, form.name), atol=1e-3
        )
    for mine, theirs in zip(read.frames, baked.frames, strict=True):
        np.testing.assert_allclose(mine.values[mine.rows], theirs.values[theirs.rows], atol=1e-3)


def test_materials_say_what_the_specification_asks_for(baked, tmp_path):
    octex.write_model(baked, tmp_path / "a.usda", unit="centimeter")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.01
    (mesh,) = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
    assert not mesh.GetDoubleSidedAttr().Get()
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    assert st.GetInterpolation() == "faceVarying"
    assert st.GetTypeName() == Sdf.ValueTypeNames.TexCoord2fArray
    flat = np.array(st.ComputeFlattened()).reshape(-1, 3, 2)
    np.testing.assert_allclose(flat * [1, -1] + [0, 1], baked.uv.values[baked.uv.rows], atol=1e-6)
    material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource()[0]
    outputs, spaces = {}, {}
    for entry in surface.GetInputs():
        source = entry.GetConnectedSources()[0]
        if source:
            shader = UsdShade.Shader(source[0].source.GetPrim())
            outputs[entry.GetBaseName()] = source[0].sourceName
            spaces[entry.GetBaseName()] = shader.GetInput("sourceColorSpace").Get()
            if entry.GetBaseName() == "normal":
                assert tuple(shader.GetInput("scale").Get()) == (2, 2, 2, 1)
                assert tuple(shader.GetInput("bias").Get()) == (-1, -1, -1, 0)
    assert outputs == {
        "diffuseColor": "rgb", "emissiveColor": "rgb", "metallic": "b", "roughness": "g", "normal": "rgb",
    }  # fmt: skip
    assert spaces == {
        "diffuseColor": "sRGB", "emissiveColor": "sRGB", "metallic": "raw", "roughness": "raw",
        "normal": "raw",
    }  # fmt: skip


def test_packages_hold_their_files_uncompressed_at_64_bytes(baked, tmp_path):
    octex.write_model(baked, tmp_path / "a.usdz", images="jpeg")
    with zipfile.ZipFile(tmp_path / "a.usdz") as package, (tmp_path / "a.usdz").open("rb") as file:
        entries = package.infolist()
        assert entries[0].filename.endswith(".usdc")
        for entry in entries:
            assert entry.compress_type == zipfile.ZIP_STORED
            file.seek(entry.header_offset + 26)
            lengths = np.frombuffer(file.read(4), "<u2")
            assert (entry.header_offset + 30 + int(lengths.sum())) % 64 == 0
    with pytest.raises(ModelError, match="USD holds no webp images"):
        octex.write_model(baked, tmp_path / "b.usdz", images="webp")


@pytest.mark.parametrize("name", ["materials.glb", "1 droid²é.obj", ".glb", "a\ud800.glb"])
def test_materials_are_kept_whatever_the_model_is_called(baked, name, tmp_path):
    surface = Surface(
        baked.vertices, baked.triangles, baked.source, uv=baked.uv, frames=baked.frames, name=name
    )
    octex.write_model(surface, tmp_path / "a.usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert validated(stage) == []
    kinds = {str(prim.GetParent().GetTypeName()) for prim in stage.Traverse() if prim.IsA(UsdShade.Material)}
    assert kinds == {"Scope"}
    points = baked.scatter(500)
    found = octex.load_surface(tmp_path / "a.usda").evaluate(points, "base_color")
    np.testing.assert_allclose(found, baked.evaluate(points, "base_color"), atol=1e-3)


@pytest.mark.parametrize("mode", ["opaque", "mask", "blend"])
def test_alpha_and_its_mode_are_kept(mode, tmp_path):
    random = np.random.default_rng(1)
    image = random.integers(0, 256, (8, 8, 4)).astype(np.uint8)
    surface = Surface.from_arrays(
        SQUARE, [[0, 1, 2], [0, 2, 3]], uv=ST, image=image, alpha=mode, cutoff=0.25, factor=(0.5, 1, 1, 1)
    )
    octex.write_model(surface, tmp_path / "a.usdz")
    read = octex.load_surface(tmp_path / "a.usdz")
    assert read.source.materials[0].alpha_mode == mode
    assert [form.name for form in read.channels] == [form.name for form in surface.channels]
    points = surface.scatter(500)
    for form in surface.channels:
        np.testing.assert_allclose(
            read.evaluate(points, form.name), surface.evaluate(points, form.name), atol=2e-3
        )


def test_several_materials_their_names_and_sides_are_kept(tmp_path):
    base = Surface.from_arrays(SQUARE, [[0, 1, 2], [0, 2, 3]])
    colors = [(0.1, 0.2, 0.3), (0.7, 0.5, 0.3)]
    materials = [
        Material({"base_color": Input(color)}, name="worn steel", double_sided=True) for color in colors
    ]
    numbers = np.array([1, 0], np.int32)
    source = MaterialSource(materials, numbers, base.rest, base.triangles)
    octex.write_model(Surface(base.vertices, base.triangles, source), tmp_path / "a.usda")
    assert validated(Usd.Stage.Open(str(tmp_path / "a.usda"))) == []
    read = octex.load_surface(tmp_path / "a.usda")
    found = [read.source.materials[number] for number in read.source.triangle_materials]
    assert [each.name.rstrip("_") for each in found] == ["worn_steel"] * 2
    assert found[0].name != found[1].name
    assert all(each.double_sided for each in found)
    np.testing.assert_allclose([each.inputs["base_color"].factor for each in found], colors[::-1], atol=1e-6)


def test_vertex_colours_are_kept(tmp_path):
    points, triangles = solids.sphere([0.0, 0.0, 0.0], 1.0, 6)
    colors = np.random.default_rng(2).random((len(points), 4))
    surface = Surface.from_arrays(points, triangles, colors=colors)
    octex.write_model(surface, tmp_path / "a.usdz")
    assert validated(Usd.Stage.Open(str(tmp_path / "a.usdz"))) == []
    read = octex.load_surface(tmp_path / "a.usdz")
    some = surface.scatter(500)
    for name in ("base_color", "alpha"):
        np.testing.assert_allclose(read.evaluate(some, name), surface.evaluate(some, name), atol=1e-5)
