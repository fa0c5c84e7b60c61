"""Writes USD: a surface with images or vertex colours as .usdz, or as .usd, .usda, .usdc with image files.

Materials are UsdPreviewSurface (specification 2.6); usdz packages are made by OpenUSD itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdUtils, Vt

from octex.channels import CHANNELS
from octex.errors import ModelError
from octex.files import replacing, scratch_folder
from octex.formats.images import encoded_images, image_names
from octex.formats.models import METERS, Target, Written, materials_of, origin_of
from octex.source.images.pyramid import WRAPS
from octex.source.materials import Input, MaterialSource
from octex.source.models.usd_materials import INPUTS
from octex.source.surface import Surface

_TYPES = Sdf.ValueTypeNames
#: The primvars of vertex colours, and the shaders that read them.
_OF_VERTICES = {"base_color": ("displayColor", "float3"), "alpha": ("displayOpacity", "float")}

#: Path of the scope that holds the materials.
_MATERIALS = "/model/materials"


def write(surface: Surface, target: Target) -> Written:
    """Write a surface with images or vertex colours as one mesh below ``/model``, with y up.

    A model far from the origin is translated. Texture coordinates are the primvar ``st``, vertex colours
    ``displayColor`` and ``displayOpacity``. UsdPreviewSurface has either metals or specular colours: these
    are written where nothing is metallic. Raises ModelError for values that it cannot hold.
    """
    path, images, unit = target[:3]
    source = materials_of(surface)
    used = np.unique(source.triangle_materials).tolist()
    materials = [source.materials[n] for n in used]
    files, numbers = encoded_images(materials, images)
    is_package = path.suffix.lower() == ".usdz"
    names = image_names(materials, path.stem, files)
    with scratch_folder() as folder:  # OpenUSD writes only to paths
        paths = [f"./textures/{number}.{ending}" for number, (_, ending) in enumerate(files)]
        if is_package:
            (folder / "textures").mkdir()
            for image, (data, _) in zip(paths, files, strict=True):
                (folder / image).write_bytes(data)
        scratch = folder / ("model.usdc" if is_package else f"model{path.suffix.lower()}")
        stage = Usd.Stage.CreateNew(str(scratch))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, METERS[unit])
        root = UsdGeom.Xform.Define(stage, "/model").GetPrim()
        stage.SetDefaultPrim(root)
        Usd.ModelAPI(root).SetKind("component")
        UsdGeom.Scope.Define(stage, _MATERIALS)  # first: a mesh may have the same name
        mesh = _mesh(stage, surface, source)
        writer = _MaterialWriter(
            stage, numbers, paths if is_package else [f"./{name}" for name in names], source
        )
        for number in used:
            faces = None if len(used) == 1 else np.flatnonzero(source.triangle_materials == number)
            writer.bind(mesh, writer.material(number), faces)
        stage.GetRootLayer().Save()
        if is_package:
            scratch = folder / "model.usdz"
            if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(folder / "model.usdc")), str(scratch)):
                raise ModelError(f"{path.name}: OpenUSD cannot package it; write a .usdc")
        else:
            for name, (data, _) in zip(names, files, strict=True):
                with replacing(path.with_name(name)) as file:
                    file.write(data)
        with replacing(path) as file:
            file.write(scratch.read_bytes())
    separate = [] if is_package else [path.with_name(name) for name in names]
    return Written([path, *separate], sum(len(data) for data, _ in files))


def _mesh(stage: Any, surface: Surface, source: MaterialSource) -> Any:
    """Define the mesh, with the data of its corners."""
    mesh = UsdGeom.Mesh.Define(stage, _free_path(stage, "/model", Path(surface.name).stem))
    origin = origin_of(surface.vertices)
    if origin.any():
        mesh.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(tuple(origin.tolist()))
    points = (surface.vertices - origin).astype(np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(surface.triangles), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(surface.triangles.reshape(-1)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    used = np.unique(source.triangle_materials).tolist()
    mesh.CreateDoubleSidedAttr(any(source.materials[number].double_sided for number in used))
    frames = surface.posed_frames()
    if frames is not None:
        normals = frames.normals.values[frames.normals.rows.reshape(-1)]
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals)))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)
    primvars = UsdGeom.PrimvarsAPI(mesh)
    for slot, corners in enumerate(source.coordinates):
        up = np.stack([corners.values[:, 0], 1.0 - corners.values[:, 1]], axis=1)
        st = primvars.CreatePrimvar(_set_name(slot), _TYPES.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        st.Set(Vt.Vec2fArray.FromNumpy(up))
        st.SetIndices(Vt.IntArray.FromNumpy(corners.rows.reshape(-1)))
    if source.colors is not None:
        rows = Vt.IntArray.FromNumpy(source.colors.rows.reshape(-1))
        values = source.colors.values
        color = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.faceVarying)
        color.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values[:, :3])))
        opacity = mesh.CreateDisplayOpacityPrimvar(UsdGeom.Tokens.faceVarying)
        opacity.Set(Vt.FloatArray.FromNumpy(np.ascontiguousarray(values[:, 3])))
        for primvar in (color, opacity):
            primvar.SetIndices(rows)
    return mesh


def _free_path(stage: Any, parent: str, name: str) -> str:
    """Return the path of a new prim below ``parent``, with the name made valid."""
    # OpenUSD refuses unpaired surrogates.
    path = f"{parent}/{Tf.MakeValidIdentifier(name.encode(errors='replace').decode())}"
    while stage.GetPrimAtPath(path):
        path += "_"
    return path


def _set_name(slot: int) -> str:
    return f"st{slot}" if slot else "st"


class _MaterialWriter:
    """The materials of a stage, with their networks of shaders."""

    def __init__(self, stage: Any, numbers: dict[int, int], paths: list[str], source: MaterialSource) -> None:
        self._stage, self._numbers, self._paths, self._source = stage, numbers, paths, source
        self._shaders: dict[tuple[object, ...], Any] = {}

    def bind(self, mesh: Any, material: Any, faces: Any) -> None:
        """Bind a material to a mesh, or to a subset of its faces."""
        prim = mesh.GetPrim()
        if faces is not None:
            indices = Vt.IntArray.FromNumpy(faces.astype(np.int32))
            subset = UsdGeom.Subset.CreateGeomSubset(
                mesh, material.GetPrim().GetName(), UsdGeom.Tokens.face, indices, UsdShade.Tokens.materialBind
            )
            api = UsdShade.MaterialBindingAPI(prim)
            api.SetMaterialBindSubsetsFamilyType(UsdGeom.Tokens.partition)
            prim = subset.GetPrim()
        UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)

    def material(self, number: int) -> Any:
        """Define the material with a number, under its name."""
        material = self._source.materials[number]
        prim = _free_path(self._stage, _MATERIALS, material.name or f"material{number}")
        usd_material = UsdShade.Material.Define(self._stage, prim)
        surface = self._shader(f"{prim}/surface", "UsdPreviewSurface")
        usd_material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        inputs = dict(material.inputs)
        if "specular" in inputs and "metallic" in inputs and _largest_value(inputs["metallic"]) > 0.0:
            del inputs["specular"]
        elif "specular" in inputs:
            inputs.pop("metallic", None)
            surface.CreateInput("useSpecularWorkflow", _TYPES.Int).Set(1)
        if material.alpha_mode == "opaque":
            inputs.pop("alpha", None)
        elif material.alpha_mode == "mask":
            surface.CreateInput("opacityThreshold", _TYPES.Float).Set(material.cutoff)
            surface.CreateInput("opacityMode", _TYPES.Token).Set("presence")
        for name in inputs:
            self._feed(prim, surface, name, inputs)
        return usd_material

    def _shader(self, prim: str, kind: str) -> Any:
        shader = UsdShade.Shader.Define(self._stage, prim)
        shader.CreateIdAttr(kind)
        return shader

    def _feed(self, prim: str, surface: Any, name: str, inputs: Mapping[str, Input]) -> None:
        """Connect or set a channel's input of a material's surface."""
        item, is_scalar = inputs[name], CHANNELS[name].components == 1
        kind = "Float" if is_scalar else "Normal3f" if name == "normal" else "Color3f"
        surface_input = surface.CreateInput(INPUTS[name], getattr(_TYPES, kind))
        shader, output = None, "result"
        if name in _OF_VERTICES and self._source.colors is not None:
            if item.texture is not None or set(item.factor) != {1.0}:
                raise ModelError("a USD material has vertex colours or an image, not both; bake it first")
            shader = self._reader(prim, *_OF_VERTICES[name])
        elif item.texture is not None:
            shader = self._texture(prim, name, inputs)
            output = "rgba"[item.lanes[0]] if is_scalar else "rgb"
        if shader is not None:
            outlet = shader.CreateOutput(output, _TYPES.Float if is_scalar else _TYPES.Float3)
            surface_input.ConnectToSource(outlet)
        elif name == "normal":
            surface_input.Set(Gf.Vec3f(0.0, 0.0, 1.0))
        else:
            values = [sum(each) for each in zip_longest(item.factor, item.offset, fillvalue=0.0)]
            surface_input.Set(values[0] if is_scalar else Gf.Vec3f(*values))

    def _reader(self, prim: str, primvar: str, kind: str) -> Any:
        """Return a material's shader that reads a primvar."""
        key = (prim, primvar)
        if key not in self._shaders:
            shader = self._shader(f"{prim}/{primvar}", f"UsdPrimvarReader_{kind}")
            shader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(primvar)
            self._shaders[key] = shader
        return self._shaders[key]

    def _texture(self, prim: str, name: str, inputs: Mapping[str, Input]) -> Any:
        """Return a material's shader that reads a channel's image."""
        texture = inputs[name].texture
        assert texture is not None
        scale, bias = _affine(name, inputs)
        number = self._numbers[id(texture.texels)]
        # Floats are linear. Alpha shares the base colour's image and is never encoded.
        is_coded = texture.texels.dtype != np.float32 and (CHANNELS[name].space == "srgb" or name == "alpha")
        space = "sRGB" if is_coded else "raw"
        key = (prim, number, space, *texture[1:], scale, bias)
        if key not in self._shaders:
            shader = self._shader(f"{prim}/{name}", "UsdUVTexture")
            shader.CreateInput("file", _TYPES.Asset).Set(Sdf.AssetPath(self._paths[number]))
            shader.CreateInput("sourceColorSpace", _TYPES.Token).Set(space)
            shader.CreateInput("wrapS", _TYPES.Token).Set(WRAPS[texture.wrap_u])
            shader.CreateInput("wrapT", _TYPES.Token).Set(WRAPS[texture.wrap_v])
            if scale != (1.0,) * 4:
                shader.CreateInput("scale", _TYPES.Float4).Set(Gf.Vec4f(*scale))
            if any(bias):
                shader.CreateInput("bias", _TYPES.Float4).Set(Gf.Vec4f(*bias))
            reader = self._reader(prim, _set_name(texture.slot), "float2")
            outlet = reader.CreateOutput("result", _TYPES.Float2)
            shader.CreateInput("st", _TYPES.Float2).ConnectToSource(outlet)
            self._shaders[key] = shader
        return self._shaders[key]


def _affine(name: str, inputs: Mapping[str, Input]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the factors and the offsets of the four components of a channel's texels."""
    if name == "normal":
        x, y, z = inputs[name].factor
        return (2.0 * x, 2.0 * y, 2.0 * z, 1.0), (-x, -y, -z, 0.0)
    scale, bias = np.ones(4), np.zeros(4)
    for each in ("base_color", "alpha") if name in ("base_color", "alpha") else (name,):
        item = inputs.get(each)
        if item is not None and item.texture is not None:
            lanes = list(item.lanes[: len(item.factor)])
            scale[lanes], bias[lanes] = item.factor, item.offset or 0.0
    return tuple(scale.tolist()), tuple(bias.tolist())


def _largest_value(item: Input) -> float:
    """Return the largest value of an input of one component."""
    texel = 1.0
    if item.texture is not None:
        texel = float(item.texture.texels[..., item.lanes[0]].max())
    return item.factor[0] * texel + sum(item.offset)
