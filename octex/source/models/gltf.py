"""glTF 2.0 and GLB models: meshes, the scene's transforms and instances, materials and their images.

A material has a channel if the file has its factor or its map. trimesh does not serve: it skips triangle fans
and drops samplers, texture transforms and all texture coordinates but the first (see also `octex.gltf`).
"""

from __future__ import annotations

import json
import reprlib
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Float64s, Floats, Int64s
from octex.errors import ImageError, ModelError, damaged
from octex.files import OCTREE_EXTENSION
from octex.gltf import (
    DRACO,
    MESHOPT,
    Document,
    Json,
    as_numbers,
    as_object,
    is_number,
    local_matrix,
    scene_nodes,
)
from octex.parallel import cpu_count, pool_of
from octex.source.corners import Corners
from octex.source.images.decode import decode_image
from octex.source.images.pyramid import CLAMP, MIRROR, REPEAT
from octex.source.materials import AlphaMode, Input, Material, Texture
from octex.source.mesh import check_below
from octex.source.models.gltf_motion import PlacedPrimitive, Primitive, motion_of, pose_of
from octex.source.models.reading import LoadedMaterial, Options, PlacedMesh, Slot, assembled, warn
from octex.source.motion import Motion
from octex.source.surface import Surface
from octex.source.tangents import corner_frames

_TRIANGLES, _TRIANGLE_STRIP, _TRIANGLE_FAN = 4, 5, 6
_ALPHA_MODES: dict[str, AlphaMode] = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}
WRAPS = {10497: REPEAT, 33648: MIRROR, 33071: CLAMP}
NEAREST = 9728
#: The attribute of rest positions in models that carry an octree.
_REST = f"{OCTREE_EXTENSION}:REST"
_VISIBILITY = "KHR_node_visibility"
_IMAGE_EXTENSIONS = ("EXT_texture_avif", "EXT_texture_webp", "KHR_texture_basisu")
# Extensions that a file may require: octex reads them, or they change nothing that octex reads.
_KNOWN_EXTENSIONS = {
    DRACO, *MESHOPT, *_IMAGE_EXTENSIONS, _VISIBILITY, "CESIUM_primitive_outline", "EXT_instance_features",
    "EXT_lights_ies", "EXT_lights_image_based", "EXT_mesh_features", "EXT_mesh_gpu_instancing",
    "EXT_structural_metadata", "KHR_animation_pointer", "KHR_lights_punctual", "KHR_mesh_quantization",
    "KHR_texture_transform", "KHR_xmp_json_ld",
}  # fmt: skip
# Larger numbers are damage; products of two stay finite in single precision.
_FARTHEST = 1e18


def load_gltf(path: Path, options: Options) -> Surface:
    """Read the scene of a .gltf or .glb file.

    Rest positions are the mesh as modelled, without morph targets and skins, or those of EXT_octree_texture;
    ``options.pose`` moves only the positions (see `gltf_motion`). ``uv`` is TEXCOORD_0, if all primitives
    with textures have it.
    """
    document = Document(path)
    placed = _placed_primitives(document, options)
    if not placed:
        raise ModelError(f"{document.name} has no triangles; octex needs a surface, not points or lines")
    materials = _materials(document, (each.primitive.material for each in placed), options)
    indices = {number: index for index, number in enumerate(materials)}
    is_mapped = any(each.material.normal_slot is not None for each in materials.values())
    is_smooth = any("NORMAL" in each.primitive.attributes for each in placed)
    has_frames = is_mapped or (options.normals and is_smooth)
    parts: dict[str, PlacedMesh] = {}
    for primitive in (each.primitive for each in placed):
        if primitive.name not in parts:
            of_triangles = np.full(len(primitive.triangles), indices[primitive.material], np.int32)
            rest = primitive.attribute(_REST, (3,))
            part = PlacedMesh(
                primitive.positions if rest is None else rest, primitive.triangles, of_triangles
            )
            if options.materials:  # a posed primitive's normals are not those at rest
                needs_frames = has_frames and (rest is None or is_mapped)
                part = _with_attributes(part, primitive, materials[primitive.material], needs_frames)
            parts[primitive.name] = part
    posed = None
    if options.pose is not None:
        pose = pose_of(document, options.pose)
        posed = np.concatenate([pose.positions(each) for each in placed])
    elif any(_REST in each.primitive.attributes for each in placed):
        posed = np.concatenate([each.rest_positions() for each in placed])
    asset = document.json["asset"]
    origin = {key: str(asset[key]) for key in ("copyright", "generator") if key in asset}
    if isinstance(extras := asset.get("extras"), dict):
        keys = ("author", "license", "licence")
        origin |= {key: extras[key] for key in keys if isinstance(extras.get(key), str)}
    if document.files:
        origin["files"] = json.dumps(document.files, sort_keys=True, ensure_ascii=False)
    return assembled(
        [parts[each.primitive.name]._replace(matrix=each.matrix) for each in placed],
        [each.material for each in materials.values()],
        options, document.name, provenance=origin, posed=posed,
    )  # fmt: skip


def load_gltf_motion(path: Path, rate: float) -> Motion | None:
    """Return the motion of all vertices, at ``rate`` frames a second or more; None without animations."""
    document = Document(path)
    return motion_of(document, _placed_primitives(document, Options(materials=False)), rate)


def _placed_primitives(document: Document, options: Options) -> list[PlacedPrimitive]:
    """List the primitives that have triangles, as the nodes of the scene show them, depth first."""
    for extension in document.items("extensionsRequired"):
        if extension not in _KNOWN_EXTENSIONS and not str(extension).startswith("KHR_materials_"):
            raise ModelError(
                f"{document.name} requires the glTF extension {extension}, which octex does not read; export "
                "it without"
            )
    meshes: dict[int, list[Primitive]] = {}
    placed = []
    hidden: set[int] = set()  # nodes, each listed before the nodes below it
    for number, node, matrix in scene_nodes(document):
        if number in hidden or not node.get("extensions", {}).get(_VISIBILITY, {}).get("visible", True):
            hidden.update(node.get("children", []))
            continue
        if "mesh" not in node:
            continue
        if node["mesh"] not in meshes:
            meshes[node["mesh"]] = _primitives(document, node["mesh"], options)
        placed += [
            PlacedPrimitive(number, copy, matrix @ copy, primitive)
            for copy in _copies(document, node)
            for primitive in meshes[node["mesh"]]
            if len(primitive.triangles)
        ]
    return placed


def _copies(document: Document, node: Json) -> list[Float64s]:
    """Return the transforms of a node's instances (EXT_mesh_gpu_instancing), else only the identity."""
    instancing = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
    if instancing is None:
        return [np.eye(4)]
    columns = {
        name.lower(): document.accessor(instancing["attributes"][name], (3, 4)).astype(np.float64)
        for name in ("TRANSLATION", "ROTATION", "SCALE")
        if name in instancing["attributes"]
    }
    count = min((len(rows) for rows in columns.values()), default=0)
    return [local_matrix({key: rows[i] for key, rows in columns.items()}) for i in range(count)]


def _primitives(document: Document, number: int, options: Options) -> list[Primitive]:
    """Read the triangles of a mesh."""
    primitives = []
    for index, primitive in enumerate(document.item("meshes", number)["primitives"]):
        name = f"{document.name}: meshes[{number}].primitives[{index}]"
        entry = as_object(primitive, name)
        mode, attributes = entry.get("mode", _TRIANGLES), entry["attributes"]
        if "rest" in (octree := entry.get("extensions", {}).get(OCTREE_EXTENSION, {})):
            attributes = {**attributes, _REST: octree["rest"]}
        if mode not in (_TRIANGLES, _TRIANGLE_STRIP, _TRIANGLE_FAN) or "POSITION" not in attributes:
            continue
        triangles, decoded = document.draco(entry, name) or (None, {})
        positions = document.accessor(attributes["POSITION"], (3,), decoded.get("POSITION"))
        with np.errstate(invalid="ignore"):  # of signalling NaNs
            positions = positions.astype(np.float64)
        if not options.finite and not np.isfinite(positions).all():
            raise ModelError(
                f"{name} has vertices that are not finite; repair the model (--repair leaves them out)"
            )
        indices: Array = np.arange(len(positions))
        if triangles is not None:
            indices, mode = triangles.reshape(-1), _TRIANGLES
        elif "indices" in entry:
            indices = document.accessor(entry["indices"], (1,))[:, 0]
        _check_indices(indices, len(positions), name)
        faces = _triangles(indices.astype(np.int64), mode).astype(np.int32)
        material, targets = entry.get("material") if options.materials else None, entry.get("targets", [])
        primitives.append(Primitive(document, name, positions, faces, material, attributes, decoded, targets))
    return primitives


def _check_indices(indices: Array, count: int, name: str) -> None:
    if indices.dtype.kind == "f":
        raise damaged(f"{name.replace(': ', ': the indices of ', 1)} are not integers")
    check_below(indices, count, f"{name} uses vertex")
    high = indices.max(initial=0)
    if high == np.iinfo(indices.dtype).max:
        raise ModelError(
            f"{name} uses vertex {high}, but {indices.dtype.name} indices keep this number for the end of a "
            "strip (3.7.2.1); export it with wider indices"
        )


def _with_attributes(
    part: PlacedMesh, primitive: Primitive, loaded: LoadedMaterial, has_frames: bool
) -> PlacedMesh:
    """Read the attributes that a primitive's material needs, and those that other sources may need."""
    positions, triangles = part.positions, part.triangles

    def at_corners(values: Floats | None) -> Corners | None:
        return None if values is None else Corners(values.astype(np.float32), triangles)

    colors = primitive.attribute("COLOR_0", (3, 4))
    if colors is not None and colors.shape[1] == 3:
        colors = np.append(colors, np.ones((len(colors), 1)), axis=1)
    uv = primitive.attribute("TEXCOORD_0", (2,))
    coordinates = []
    for slot in loaded.slots:
        values = uv if slot.name == "TEXCOORD_0" else primitive.attribute(slot.name, (2,))
        if values is None:
            warn(
                f"{primitive.document.name}: meshes with a textured material have no {slot.name}, so they "
                "read one texel; give them coordinates"
            )
            values = np.zeros((len(positions), 2))
        with np.errstate(over="ignore", invalid="ignore"):  # the source refuses infinite coordinates
            coordinates.append(Corners(slot.applied(values).astype(np.float32), triangles))
    frames = None
    if has_frames:
        normals, slot_number = at_corners(primitive.attribute("NORMAL", (3,))), loaded.material.normal_slot
        tangents = of_map = None
        if slot_number is not None:  # only normal maps need tangents
            tangents, of_map = at_corners(primitive.attribute("TANGENT", (4,))), coordinates[slot_number]
        frames = corner_frames(positions, triangles, normals, tangents, of_map)
    return part._replace(
        colors=at_corners(colors), coordinates=coordinates, uv=at_corners(uv), frames=frames,
        is_smooth="NORMAL" in primitive.attributes,
    )  # fmt: skip


def _triangles(indices: Int64s, mode: int) -> Int64s:
    """Return the triangles (m, 3) of a list, a strip or a fan (3.7.2.1), without incomplete ones."""
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    count = max(len(indices) - 2, 0)
    first = np.arange(count)
    if mode == _TRIANGLE_FAN:
        return np.stack([indices[first + 1], indices[first + 2], np.broadcast_to(indices[:1], count)], axis=1)
    odd = first % 2
    return np.stack([indices[first], indices[first + 1 + odd], indices[first + 2 - odd]], axis=1)


class _JsonObject(NamedTuple):
    entry: Json
    name: str

    def part(self, key: str) -> _JsonObject:
        """Return an inner object; an empty one if it is missing."""
        name = f"{self.name}.{key}"
        return _JsonObject(as_object(self.entry.get(key, {}), name), name)

    def states(self, *keys: str) -> bool:
        """Say whether the file has any of the keys."""
        return any(key in self.entry for key in keys)

    def number(self, key: str, default: float) -> float:
        """Return a finite number."""
        value = self.entry.get(key, default)
        if not is_number(value, _FARTHEST):
            raise damaged(f"{self.name}.{key} must be a number, not {reprlib.repr(value)}")
        return float(value)

    def numbers(self, key: str, default: tuple[float, ...]) -> tuple[float, ...]:
        """Return as many finite numbers as the default has."""
        return as_numbers(self.entry.get(key, default), len(default), f"{self.name}.{key}", _FARTHEST)


def _materials(
    document: Document, numbers: Iterable[int | None], options: Options
) -> dict[int | None, LoadedMaterial]:
    """Return materials by number, None for glTF's default; images are decoded in parallel, each once."""
    records = {number: _material(document, number) for number in dict.fromkeys(numbers)}
    files: dict[str | int, tuple[bytes, str]] = {}
    textures = {
        number: {
            name: _texture(document, use, files) for name, use in uses.items() if options.wants_image(name)
        }
        for number, (_, uses) in records.items()
    }
    with pool_of(cpu_count()) as pool:
        texels = dict(zip(files, pool.map(lambda file: decode_image(*file), files.values()), strict=True))
    materials: dict[int | None, LoadedMaterial] = {}
    for number, (material, _) in records.items():
        slots: dict[Slot, int] = {}
        inputs = dict(material.inputs)
        for name, (file, wrap_u, wrap_v, nearest, slot) in textures[number].items():
            index = slots.setdefault(slot, len(slots))
            texture = Texture(texels[file], wrap_u, wrap_v, nearest, index)
            inputs[name] = inputs[name]._replace(texture=texture)
        materials[number] = LoadedMaterial(material._replace(inputs=inputs), tuple(slots))
    return materials


def _material(document: Document, number: int | None) -> tuple[Material, dict[str, _JsonObject]]:
    """Return a material without textures, and the file's references to these, by channel."""
    record = _JsonObject(
        {} if number is None else document.item("materials", number), f"{document.name}: materials[{number}]"
    )
    mode = record.entry.get("alphaMode", "OPAQUE")
    if mode not in _ALPHA_MODES:
        raise damaged(f"{record.name} has an unknown alphaMode {reprlib.repr(mode)}")
    inputs: dict[str, Input] = {}
    uses: dict[str, _JsonObject] = {}

    def add(name: str, entry: Input, holder: _JsonObject, key: str) -> None:
        inputs[name] = entry
        if holder.states(key):
            uses[name] = holder.part(key)

    extensions = record.part("extensions")
    is_unlit = extensions.states("KHR_materials_unlit")
    is_older = not is_unlit and extensions.states("KHR_materials_pbrSpecularGlossiness")
    if is_older:
        pbr, texture = extensions.part("KHR_materials_pbrSpecularGlossiness"), "diffuseTexture"
        color = pbr.numbers("diffuseFactor", (1.0,) * 4)
    else:
        pbr, texture = record.part("pbrMetallicRoughness"), "baseColorTexture"
        color = pbr.numbers("baseColorFactor", (1.0,) * 4)
    add("base_color", Input(color[:3]), pbr, texture)
    if mode != "OPAQUE":
        add("alpha", Input(color[3:], None, (3,)), pbr, texture)
    name = record.entry.get("name")
    material = Material(
        inputs,
        _ALPHA_MODES[mode],
        record.number("alphaCutoff", 0.5),
        name if isinstance(name, str) else "",
        record.entry.get("doubleSided") is True,
    )
    if is_unlit:
        return material, uses
    if is_older:
        texture = "specularGlossinessTexture"
        inputs["metallic"] = Input((0.0,))
        rough = Input((-pbr.number("glossinessFactor", 1.0),), None, (3,), (1.0,))
        add("roughness", rough, pbr, texture)
        if pbr.states("specularFactor", texture):
            add("specular", Input(pbr.numbers("specularFactor", (1.0,) * 3)), pbr, texture)
    else:
        texture = "metallicRoughnessTexture"
        for name, key, lane in (("metallic", "metallicFactor", 2), ("roughness", "roughnessFactor", 1)):
            if pbr.states(key, texture):
                add(name, Input((pbr.number(key, 1.0),), None, (lane,)), pbr, texture)
        if extensions.states("KHR_materials_specular", "KHR_materials_ior"):
            layer, ior = extensions.part("KHR_materials_specular"), extensions.part("KHR_materials_ior")
            index = max(ior.number("ior", 1.5), 0.0)  # 0 reflects all
            first = layer.number("specularFactor", 1.0) * ((index - 1.0) / (index + 1.0)) ** 2
            tint = np.clip(first * np.array(layer.numbers("specularColorFactor", (1.0,) * 3)), 0.0, 1.0)
            add("specular", Input(tuple(tint.tolist())), layer, "specularColorTexture")
    if record.states("occlusionTexture"):
        strength = record.part("occlusionTexture").number("strength", 1.0)
        occlusion = Input((strength,), None, (0,), (1.0 - strength,))
        add("occlusion", occlusion, record, "occlusionTexture")
    if record.states("emissiveFactor", "emissiveTexture"):
        strength = extensions.part("KHR_materials_emissive_strength").number("emissiveStrength", 1.0)
        light = tuple(strength * factor for factor in record.numbers("emissiveFactor", (0.0,) * 3))
        add("emissive", Input(light), record, "emissiveTexture")
    if record.states("normalTexture"):
        scale = record.part("normalTexture").number("scale", 1.0)
        add("normal", Input((scale, scale, 1.0)), record, "normalTexture")
    return material, uses


def _texture(
    document: Document, use: _JsonObject, files: dict[str | int, tuple[bytes, str]]
) -> tuple[str | int, int, int, bool, Slot]:
    """Return the image, wraps of u and v, flat texels and coordinates of a reference to a texture.

    ``files`` gets the image's content and its name in errors, by its uri or buffer view.
    """
    number = use.entry.get("index")
    entry = document.item("textures", number)
    source = entry.get("source")
    for name, extension in entry.get("extensions", {}).items():
        if source is None and name in _IMAGE_EXTENSIONS:
            source = extension.get("source")
    if source is None:
        raise ModelError(f"{document.name}: textures[{number}] names no image that octex reads")
    sampler = document.item("samplers", entry["sampler"]) if "sampler" in entry else {}
    wraps = {axis: sampler.get(axis, 10497) for axis in ("wrapS", "wrapT")}
    for axis, code in wraps.items():
        if code not in WRAPS:
            raise damaged(f"{document.name}: a sampler has an unknown {axis} {code}")
    wrap_u, wrap_v = (WRAPS[code] for code in wraps.values())
    image, what = document.item("images", source), f"images[{source}]"
    file: str | int | None = image.get("bufferView", image.get("uri"))
    name = f"{document.name}: {what}"
    if file is None:
        raise ImageError(f"{name} has neither a uri nor a bufferView; export the model again")
    if file not in files:
        if isinstance(file, str):
            content = document.resource(file, what, ImageError)
            name = name if file.startswith("data:") else f"{name} ({file})"
        else:
            content = bytes(document.view(file)[0])
        files[file] = content, name
    transform = use.part("extensions").part("KHR_texture_transform")
    number = transform.entry.get("texCoord", use.entry.get("texCoord", 0))
    if isinstance(number, bool) or not isinstance(number, int) or number < 0:
        raise damaged(f"{use.name}.texCoord must be a whole number, not {reprlib.repr(number)}")
    slot = Slot(
        f"TEXCOORD_{number}",
        transform.numbers("scale", (1.0, 1.0)),
        transform.number("rotation", 0.0),
        transform.numbers("offset", (0.0, 0.0)),
    )
    return file, wrap_u, wrap_v, sampler.get("magFilter") == NEAREST, slot
