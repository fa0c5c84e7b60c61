"""USD: what is written as OpenUSD reads and validates it, and stages made by OpenUSD as octex reads them."""

import json
import sys

import numpy as np
import PIL.Image
import pytest
import trimesh

import octex
from octex.channels import srgb_to_linear
from octex.errors import ImageError, MissingExtraError, ModelError, ModelWarning
from octex.source.mesh import SurfaceSamples
from tests.make.refusal import refused

pxr = pytest.importorskip("pxr", reason="the extra octex[usd] is not installed")
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt  # noqa: E402

SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
ST = [(0, 0), (1, 0), (1, 1), (0, 1)]


class Stage:
    """A stage with a square of one polygon, or of two triangles, whose image has a colour in each quarter."""

    def __init__(self, folder, name="model.usda"):
        self.path = folder / name
        self.stage = Usd.Stage.CreateNew(str(self.path))
        UsdGeom.SetStageUpAxis(self.stage, "Y")
        UsdGeom.SetStageMetersPerUnit(self.stage, 1.0)
        self.codes = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [200, 100, 50]]], np.uint8)
        PIL.Image.fromarray(self.codes).save(folder / "image.png")

    def square(self, at="/mesh", st=ST, how="vertex"):
        mesh = UsdGeom.Mesh.Define(self.stage, at)
        mesh.CreatePointsAttr(SQUARE)
        mesh.CreateFaceVertexCountsAttr([4])
        mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
        if st is not None:
            kind = Sdf.ValueTypeNames.TexCoord2fArray
            UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, how).Set(Vt.Vec2fArray(st))
        return mesh

    def shader(self, at, kind, **inputs):
        """Define a shader; inputs have a type and a value."""
        shader = UsdShade.Shader.Define(self.stage, at)
        shader.CreateIdAttr(kind)
        for name, (type_name, value) in inputs.items():
            shader.CreateInput(name, getattr(Sdf.ValueTypeNames, type_name)).Set(value)
        return shader

    def material(self, mesh, at="/material", **inputs):
        """Bind an image, whose shader has these inputs, as the diffuse colour."""
        material = UsdShade.Material.Define(self.stage, at)
        surface = self.shader(f"{at}/surface", "UsdPreviewSurface")
        material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        image = self.shader(f"{at}/image", "UsdUVTexture", file=("Asset", "image.png"), **inputs)
        reader = self.shader(f"{at}/reader", "UsdPrimvarReader_float2", varname=("String", "st"))
        reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
        image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
        color = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
        color.ConnectToSource(image.ConnectableAPI(), "rgb")
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
        return surface

    def read(self, **options):
        self.stage.GetRootLayer().Save()
        return octex.load_surface(self.path, **options)


def colors_at(surface, places):
    """The colours at places (n, 3) that lie on a surface."""
    places = np.asarray(places, np.float64)
    triangles, weights = np.empty(len(places), np.int32), np.empty((len(places), 3))
    for n, place in enumerate(places):
        best = -np.inf
        for triangle, (a, b, c) in enumerate(surface.vertices[surface.triangles]):
            shares, *_ = np.linalg.lstsq(np.stack([b - a, c - a], axis=1), place - a, rcond=None)
            own = np.array([1 - shares.sum(), *shares])
            if own.min() > best:
                best, triangles[n], weights[n] = own.min(), triangle, own
        assert best > -1e-9
    return surface.evaluate(SurfaceSamples(places, places, places, triangles, weights, places))


#: Middles of the texels as the square shows them, v up: the image's last row is the lower one.
QUARTERS = [(0.25, 0.75, 0), (0.75, 0.75, 0), (0.25, 0.25, 0), (0.75, 0.25, 0)]


@pytest.mark.parametrize("how", ["vertex", "varying", "faceVarying", "indexed", "no indices"])
def test_images_are_read_at_primvars_however_these_are_spread(how, tmp_path):
    made = Stage(tmp_path)
    mesh = made.square(st=ST, how="faceVarying" if "ind" in how else how)
    if how == "no indices":
        UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").SetIndices(Vt.IntArray())
    elif how == "indexed":
        primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
        primvar.Set(Vt.Vec2fArray([ST[n] for n in (2, 0, 3, 1)]))
        primvar.SetIndices(Vt.IntArray([1, 3, 0, 2]))
    made.material(mesh)
    read = made.read()
    expected = srgb_to_linear(made.codes.reshape(-1, 3) / 255.0)
    np.testing.assert_allclose(colors_at(read, QUARTERS), expected, atol=1e-4)
    assert (read.polygons.numbers == 0).all()
    *_, vertices = read.loops()
    assert vertices.tolist() == [0, 1, 2, 3]
    assert list(json.loads(read.provenance["files"])) == ["image.png"]


def test_images_are_scaled_moved_and_read_in_the_space_that_is_said(tmp_path):
    made = Stage(tmp_path)
    made.material(
        made.square(), scale=("Float4", Gf.Vec4f(0.5, 0.25, 1, 1)), bias=("Float4", Gf.Vec4f(0.1, 0, 0, 0)),
        sourceColorSpace=("Token", "raw"),
    )  # fmt: skip
    expected = made.codes.reshape(-1, 3) / 255.0 * [0.5, 0.25, 1] + [0.1, 0, 0]
    np.testing.assert_allclose(colors_at(made.read(), QUARTERS), expected, atol=1e-3)


def test_a_transform_turns_coordinates_counter_clockwise(tmp_path):
    made = Stage(tmp_path)
    made.material(made.square())
    change = {"rotation": ("Float", 90.0), "translation": ("Float2", Gf.Vec2f(1, 0))}
    turn = made.shader("/material/turn", "UsdTransform2d", **change)
    reader = UsdShade.Shader.Get(made.stage, "/material/reader")
    turn.CreateInput("in", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    turn.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    image = UsdShade.Shader.Get(made.stage, "/material/image")
    image.GetInput("st").ConnectToSource(turn.ConnectableAPI(), "result")
    # (s, t) reads at (1 − t, s): the lower left shows the image's lower right, and so on around.
    expected = srgb_to_linear(made.codes.reshape(-1, 3)[[2, 0, 3, 1]] / 255.0)
    np.testing.assert_allclose(colors_at(made.read(), QUARTERS), expected, atol=1e-4)


def test_stages_are_read_in_metres_with_y_up_as_their_transforms_place_them(tmp_path):
    made = Stage(tmp_path)
    UsdGeom.SetStageUpAxis(made.stage, "Z")
    UsdGeom.SetStageMetersPerUnit(made.stage, 0.01)
    parent = UsdGeom.Xform.Define(made.stage, "/parent")
    parent.AddTranslateOp().Set(Gf.Vec3d(100, 0, 50))
    mesh = made.square("/parent/mesh")
    mesh.AddScaleOp().Set(Gf.Vec3f(-100, 100, 100))  # a mirror turns it inside out, were it not turned back
    read = made.read()
    expected = np.array(SQUARE) * [-1, 1, 1] + [1, 0, 0.5]
    np.testing.assert_allclose(read.vertices, expected[:, [0, 2, 1]] * [1, 1, -1], atol=1e-6)
    corners = read.vertices[read.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(
        normals / np.linalg.norm(normals, axis=1, keepdims=True), [[0, 1, 0]] * 2, atol=1e-6
    )


def test_left_handed_meshes_are_turned_and_holes_left_out(tmp_path):
    made = Stage(tmp_path)
    mesh = made.square(st=None)
    mesh.CreateOrientationAttr("leftHanded")
    mesh.CreateFaceVertexCountsAttr([3, 3])
    mesh.CreateFaceVertexIndicesAttr([0, 2, 1, 0, 3, 2])
    mesh.CreateHoleIndicesAttr([1])
    read = made.read()
    assert len(read.triangles) == 1
    a, b, c = read.vertices[read.triangles[0]]
    assert np.cross(b - a, c - a)[2] > 0.0


def test_subsets_have_their_own_materials_and_constants_count(tmp_path):
    made = Stage(tmp_path)
    mesh = made.square()
    mesh.CreateFaceVertexCountsAttr([3, 3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 0, 2, 3])
    made.material(mesh)
    plain = UsdShade.Material.Define(made.stage, "/plain")
    surface = made.shader("/plain/surface", "UsdPreviewSurface", roughness=("Float", 0.3))
    # The colour comes from the material's own input.
    public = plain.CreateInput("tint", Sdf.ValueTypeNames.Color3f)
    public.Set(Gf.Vec3f(0.2, 0.4, 0.6))
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(public)
    plain.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    subset = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).CreateMaterialBindSubset(
        "half", Vt.IntArray([1])
    )
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(plain)
    read = made.read()
    found = colors_at(read, [(0.75, 0.25, 0), (0.25, 0.75, 0)])
    np.testing.assert_allclose(found, [srgb_to_linear(made.codes[1, 1] / 255.0), [0.2, 0.4, 0.6]], atol=1e-4)
    samples = read.scatter(200)
    rough = read.evaluate(samples, "roughness")[:, 0]
    np.testing.assert_allclose(rough[samples.triangles == 1], 0.3, atol=1e-6)


@pytest.mark.parametrize("how", ["constant", "uniform", "vertex"])
def test_display_colours_count_where_there_is_no_material(how, tmp_path):
    made = Stage(tmp_path)
    mesh = made.square(st=None)
    colors = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9], [0.4, 0.5, 0.6]], np.float32)
    count = 4 if how == "vertex" else 1
    mesh.CreateDisplayColorPrimvar(how).Set(Vt.Vec3fArray.FromNumpy(colors[:count]))
    places = np.array(SQUARE) * 0.998 + 0.001 * np.array([1, 1, 0])
    expected = colors if how == "vertex" else colors[[0] * 4]
    np.testing.assert_allclose(colors_at(made.read(), places), expected, atol=2e-3)


def test_display_opacities_count_where_there_is_no_material(tmp_path):
    made = Stage(tmp_path)
    mesh = made.square(st=None)
    mesh.CreateDisplayOpacityPrimvar("constant").Set(Vt.FloatArray([1.0]))
    assert "alpha" not in [form.name for form in made.read().channels]
    mesh.GetDisplayOpacityPrimvar().Set(Vt.FloatArray([0.25]))
    read = made.read()
    np.testing.assert_array_equal(read.evaluate(read.scatter(9), "alpha"), 0.25)


def test_what_is_hidden_or_a_proxy_is_left_out_and_instances_are_read(tmp_path):
    made = Stage(tmp_path)
    made.square("/source/mesh", st=None)
    made.stage.GetPrimAtPath("/source").SetSpecifier(Sdf.SpecifierClass)
    for number in range(2):
        copy = UsdGeom.Xform.Define(made.stage, f"/copy{number}")
        copy.AddTranslateOp().Set(Gf.Vec3d(2.0 * number, 0, 0))
        copy.GetPrim().GetReferences().AddInternalReference("/source")
        copy.GetPrim().SetInstanceable(True)
    UsdGeom.Imageable(made.square("/hidden", st=None)).MakeInvisible()
    made.square("/proxy", st=None).CreatePurposeAttr("proxy")
    read = made.read()
    np.testing.assert_allclose(read.bounds, [[0, 0, 0], [3, 1, 0]])
    assert len(read.triangles) == 4


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
@pytest.mark.parametrize(
    ("kind", "volume"),
    [
        ("Cube", 0.6**3),
        ("Sphere", 4 / 3 * np.pi * 0.3**3),
        ("Cylinder", np.pi * 0.3**2 * 0.8),
        ("Cone", np.pi * 0.3**2 * 0.8 / 3),
        ("Capsule", np.pi * 0.3**2 * (0.8 + 4 / 3 * 0.3)),
    ],
)
def test_solids_are_closed_and_as_large_as_openusd_says(tmp_path, kind, volume, axis):
    made = Stage(tmp_path)
    prim = made.stage.DefinePrim("/solid", kind)
    for name, value in (("size", 0.6), ("radius", 0.3), ("height", 0.8), ("axis", axis)):
        if prim.HasAttribute(name):
            prim.GetAttribute(name).Set(value)
    UsdGeom.Gprim(prim).CreateDisplayColorAttr([(0.2, 0.4, 0.6)])
    read = made.read()
    extent = UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(prim), Usd.TimeCode.Default())
    np.testing.assert_allclose(read.bounds, np.array(extent), atol=1e-6)
    solid = trimesh.Trimesh(read.vertices, read.triangles)
    assert solid.is_watertight
    assert volume * 0.99 < solid.volume < volume * (1 + 1e-9)  # positive: faces look outwards
    np.testing.assert_allclose(read.evaluate(read.scatter(9)), [[0.2, 0.4, 0.6]] * 9, rtol=1e-6)
    np.testing.assert_array_equal(made.read(normals=True).triangles, read.triangles)


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_planes_look_along_their_axis(tmp_path, axis):
    made = Stage(tmp_path)
    plane = UsdGeom.Plane.Define(made.stage, "/plane")
    plane.CreateWidthAttr(2.0), plane.CreateLengthAttr(3.0), plane.CreateAxisAttr(axis)
    read = made.read()
    extent = UsdGeom.Boundable.ComputeExtentFromPlugins(plane, Usd.TimeCode.Default())
    np.testing.assert_allclose(read.bounds, np.array(extent), atol=1e-6)
    normals = trimesh.Trimesh(read.vertices, read.triangles, process=False).face_normals
    np.testing.assert_allclose(normals, [np.eye(3)["XYZ".index(axis)]] * 2)


def test_point_instancers_place_their_prototypes(tmp_path):
    made = Stage(tmp_path)
    group = UsdGeom.Xform.Define(made.stage, "/group")
    group.AddTranslateOp().Set(Gf.Vec3d(0, 10, 0))
    outer = UsdGeom.PointInstancer.Define(made.stage, "/group/outer")
    inner = UsdGeom.PointInstancer.Define(made.stage, "/group/outer/prototypes/inner")
    made.square("/group/outer/prototypes/inner/square", st=None)
    cube = UsdGeom.Cube.Define(made.stage, "/group/outer/prototypes/cube")
    cube.AddScaleOp().Set(Gf.Vec3f(0.1, 0.2, 0.3))
    half = float(np.sqrt(0.5))
    inner.CreatePositionsAttr([(0, 0, 0), (3, 0, 0)])
    inner.CreateProtoIndicesAttr([0, 0])
    inner.CreatePrototypesRel().SetTargets(["/group/outer/prototypes/inner/square"])
    outer.CreatePositionsAttr([(0, 0, 0), (0, 0, 5), (7, 0, 0), (90, 0, 0)])
    outer.CreateOrientationsAttr([Gf.Quath(1), Gf.Quath(half, 0, half, 0), Gf.Quath(1), Gf.Quath(1)])
    outer.CreateScalesAttr([(1, 1, 1), (2, 2, 2), (1, 1, 1), (1, 1, 1)])
    outer.CreateProtoIndicesAttr([0, 0, 1, 1])
    outer.CreateIdsAttr([10, 11, 12, 13])
    outer.InvisIds([13], Usd.TimeCode.Default())
    outer.CreatePrototypesRel().SetTargets([inner.GetPath(), cube.GetPath()])
    read = made.read()
    assert len(read.triangles) == 4 * 2 + 12
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"])
    box = cache.ComputeWorldBound(made.stage.GetPseudoRoot()).ComputeAlignedRange()
    np.testing.assert_allclose(read.bounds, np.array([box.GetMin(), box.GetMax()]), atol=2e-3)
    area = 2 * 1 + 2 * 4 + 8 * (0.02 + 0.03 + 0.06)
    np.testing.assert_allclose(read.areas().sum(), area, rtol=1e-3)


def test_animated_instances_are_read_at_their_first_sample_and_prototypes_may_be_below_an_over(tmp_path):
    made = Stage(tmp_path)
    instancer = UsdGeom.PointInstancer.Define(made.stage, "/points")
    made.square("/points/hidden/square", st=None)
    made.stage.GetPrimAtPath("/points/hidden").SetSpecifier(Sdf.SpecifierOver)
    instancer.CreatePrototypesRel().SetTargets(["/points/hidden/square"])
    instancer.CreateProtoIndicesAttr([0, 0])
    for time, x in ((5, 3), (6, 4)):
        instancer.CreatePositionsAttr().Set([(x, 0, 0), (x + 4, 0, 0)], time)
        instancer.CreateVelocitiesAttr().Set([(24, 0, 0)] * 2, time)
    np.testing.assert_allclose(made.read().bounds, [[3, 0, 0], [8, 1, 0]])


def test_animated_inputs_are_read_at_their_first_sample(tmp_path):
    made = Stage(tmp_path)
    made.material(made.square())
    file = made.stage.GetAttributeAtPath("/material/image.inputs:file")
    file.Clear()
    for time, image in ((7, "image.png"), (8, "later.png")):
        file.Set(image, time)
    seen = colors_at(made.read(), QUARTERS)
    np.testing.assert_allclose(seen, srgb_to_linear(made.codes.reshape(-1, 3) / 255), atol=1e-3)


@pytest.mark.parametrize("name", ["/gone/image.png", "C:\\gone\\image.png", "gone/image.png"])
def test_an_image_that_has_moved_is_found_by_its_name_next_to_the_stage(name, tmp_path):
    made = Stage(tmp_path)
    made.material(made.square())
    made.stage.GetAttributeAtPath("/material/image.inputs:file").Set(name)
    seen = colors_at(made.read(), QUARTERS)
    np.testing.assert_allclose(seen, srgb_to_linear(made.codes.reshape(-1, 3) / 255), atol=1e-3)


@pytest.mark.parametrize("purpose", ["preview", "full"])
def test_materials_that_are_bound_for_one_purpose_are_read(purpose, tmp_path):
    made = Stage(tmp_path)
    mesh = made.square()
    made.material(mesh)
    api = UsdShade.MaterialBindingAPI(mesh)
    material = api.GetDirectBinding().GetMaterial()
    api.UnbindAllBindings()
    api.Bind(material, UsdShade.Tokens.fallbackStrength, purpose)
    seen = colors_at(made.read(), QUARTERS)
    np.testing.assert_allclose(seen, srgb_to_linear(made.codes.reshape(-1, 3) / 255), atol=1e-3)


def test_damaged_point_instancers_are_refused(tmp_path, monkeypatch):
    made = Stage(tmp_path)
    made.square("/many/square", st=None)
    many = UsdGeom.PointInstancer.Define(made.stage, "/many")
    many.CreatePrototypesRel().SetTargets(["/many/square"])
    many.CreatePositionsAttr([(0, 0, 0), (3, 0, 0)])
    many.CreateProtoIndicesAttr([0, 1])
    with pytest.raises(ModelError, match="/many uses a prototype 1, but there are 1"):
        made.read()
    many.CreateProtoIndicesAttr([0, 0, 0])
    with pytest.raises(ModelError, match="/many has 3 instances, places 0"):
        made.read()
    many.CreateProtoIndicesAttr([0, 0])
    many.CreatePrototypesRel().SetTargets(["/many"])
    with pytest.raises(ModelError, match="/many contains itself"):
        made.read()
    many.CreatePrototypesRel().SetTargets(["/many/square"])
    few = UsdGeom.PointInstancer.Define(made.stage, "/few")
    few.CreatePrototypesRel().SetTargets(["/many"])
    few.CreatePositionsAttr([(0, 0, 0)] * 2**10)
    few.CreateProtoIndicesAttr([0] * 2**10)
    monkeypatch.setattr("octex.source.models.usd._PLACEMENTS", 2**11)
    with pytest.raises(ModelError, match="/few has too many instances; export fewer"):
        made.read()


def test_damaged_stages_are_refused_in_one_line(tmp_path):
    def without(change, words, error=ModelError, name="model.usda"):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        made = Stage(folder, name)
        mesh = made.square()
        made.material(mesh)
        change(made, mesh)
        with refused(error, words):
            made.read()

    without(lambda _, mesh: mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 7]), "uses a point 7, but there are 4")
    without(lambda _, mesh: mesh.CreateFaceVertexCountsAttr([3]), "its faces have 3 corners, its list 4")
    without(
        lambda _, mesh: mesh.CreatePointsAttr([(0, 0, float("nan"))] * 4),
        "points that are not finite; .*--repair",
    )
    without(lambda made, _: made.stage.RemovePrim("/mesh"), "has no triangles")
    without(
        lambda _, mesh: UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Set(Vt.Vec2fArray(2)), "uses a value 3"
    )
    without(lambda made, _: (made.path.parent / "image.png").unlink(), "image.png is missing", ImageError)
    without(
        lambda made, _: UsdShade.Shader.Get(made.stage, "/material/image").GetInput("file").Set("/etc/a.png"),
        "absolute paths are not followed", ImageError,
    )  # fmt: skip
    colored = octex.Surface.from_arrays(SQUARE, [[0, 1, 2], [0, 2, 3]], colors=np.full((4, 3), 0.5))
    octex.write_model(colored, tmp_path / "whole.usdz")
    data = (tmp_path / "whole.usdz").read_bytes()
    for number, length in enumerate((10, 200, len(data) // 2)):
        (tmp_path / f"cut{number}.usdz").write_bytes(data[:length])
        words = rf"cut{number}\.usdz.* is damaged, or is not a USD stage"
        with pytest.raises(ModelError, match=words):
            octex.load_surface(tmp_path / f"cut{number}.usdz")
    old = tmp_path / "old.usdc"
    old.write_bytes(b"PXR-USDC" + bytes([0, 0, 1]) + bytes(77))
    with refused(ModelError, r"old\.usdc is damaged, or is not a USD stage \(.*version 0\.0\.1\. The oldest"):
        octex.load_surface(old)


def test_a_material_of_another_kind_is_white_with_a_warning(tmp_path):
    made = Stage(tmp_path)
    made.material(made.square()).GetIdAttr().Set("ND_standard_surface_surfaceshader")
    with pytest.warns(ModelWarning, match="is not a UsdPreviewSurface, so it is white"):
        read = made.read()
    np.testing.assert_allclose(colors_at(read, QUARTERS), 1.0)


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("brass.mtlx", "model.usda has MaterialX files, which are not read; use UsdPreviewSurface"),
        ("absent.usda", "is not whole: Could not open asset"),
    ],
)
def test_files_that_a_stage_refers_to_and_are_not_read_are_named(file, words, tmp_path):
    made = Stage(tmp_path)
    made.square()
    made.stage.DefinePrim("/materials").GetReferences().AddReference(f"./{file}")
    with pytest.warns(ModelWarning, match=words) as said:
        made.read()
    assert len(said) == 1


def test_what_is_connected_and_not_read_is_said(tmp_path):
    made = Stage(tmp_path)
    surface = made.material(made.square())
    reader = made.shader("/material/colors", "UsdPrimvarReader_float3", varname=("String", "Cd"))
    color = reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(color)
    with pytest.warns(ModelWarning, match="what diffuseColor is connected to is not read; bake it"):
        made.read()


def test_images_without_coordinates_are_read_at_0_0(tmp_path):
    made = Stage(tmp_path)
    made.material(made.square(st=None))
    with pytest.warns(ModelWarning, match=r"/mesh lack the primvar st: images are read at \(0, 0\)"):
        read = made.read()
    expected = srgb_to_linear(made.codes[1, 0] / 255.0)
    np.testing.assert_allclose(colors_at(read, QUARTERS), [expected] * 4, atol=1e-3)


def test_an_image_without_a_file_is_its_fallback(tmp_path):
    made = Stage(tmp_path)
    made.material(made.square(), fallback=("Float4", Gf.Vec4f(0.2, 0.4, 0.6, 1.0)))
    UsdShade.Shader.Get(made.stage, "/material/image").GetPrim().RemoveProperty("inputs:file")
    with pytest.warns(ModelWarning, match="/material/image names no image, so it is its fallback"):
        read = made.read()
    np.testing.assert_allclose(colors_at(read, QUARTERS), [[0.2, 0.4, 0.6]] * 4, atol=1e-6)


def test_what_programs_write_besides_the_specification_is_read(tmp_path, capfd):
    """Paths with backslashes, bindings without their schema, shapes that are no meshes, missing files."""
    made = Stage(tmp_path)
    mesh = made.square()
    made.material(mesh)
    (tmp_path / "maps").mkdir()
    (tmp_path / "image.png").rename(tmp_path / "maps/image.png")
    UsdShade.Shader.Get(made.stage, "/material/image").GetInput("file").Set(".\\maps\\image.png")
    mesh.GetPrim().RemoveAPI(UsdShade.MaterialBindingAPI)
    UsdGeom.BasisCurves.Define(made.stage, "/hair")
    made.stage.DefinePrim("/part").GetReferences().AddReference("gone.usda")
    made.stage.GetRootLayer().Save()
    text = made.path.read_text().replace("metersPerUnit = 1", "metersPerUnit = 0.5")
    layer = Sdf.Layer.CreateAnonymous(".usda")
    assert layer.ImportFromString(text)
    made.path = tmp_path / "model.usdc"
    layer.Export(str(made.path))
    capfd.readouterr()
    with pytest.warns(ModelWarning) as said:
        read = octex.load_surface(made.path)
    texts = " ".join(str(each.message) for each in said)
    assert "leaves out 1 BasisCurves" in texts
    assert "gone.usda" in texts
    assert capfd.readouterr().err == ""
    np.testing.assert_allclose(read.bounds, [[0, 0, 0], [0.5, 0.5, 0]])
    found = colors_at(read, 0.5 * np.array(QUARTERS))
    np.testing.assert_allclose(found, srgb_to_linear(made.codes.reshape(-1, 3) / 255.0), atol=1e-3)


def test_without_usd_core_its_extra_is_named(tmp_path, monkeypatch):
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    monkeypatch.setitem(sys.modules, "pxr", None)
    words = r"a.usda: to read USD, usd-core is needed; install it: pip install 'octex\[usd\]'"
    with pytest.raises(MissingExtraError, match=words):
        octex.load_surface(tmp_path / "a.usda")
