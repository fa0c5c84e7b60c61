"""Materials of glTF files: which channels they state, and the images that those read (glTF 2.0, 3.8 and 3.9).

A channel is stated by a factor or a map that stands in the file. Beside the core's metallic-roughness
materials: KHR_materials_unlit, which leaves only base colour and alpha; KHR_materials_emissive_strength;
KHR_texture_transform; KHR_materials_specular and KHR_materials_ior, which say what is reflected along the
normal, but for the texture of how strongly; and the older KHR_materials_pbrSpecularGlossiness, whose
materials are not metallic and as rough as they are not glossy. Other extensions of materials change none of
these channels.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterable
from concurrent.futures import Executor, Future
from typing import NamedTuple

import numpy as np

from octex.errors import ImageError, ModelError
from octex.parallel import cpu_count, pool_of
from octex.source.images.decode import decode_image
from octex.source.images.pyramid import CLAMP, MIRROR, REPEAT, Texels
from octex.source.materials import AlphaMode, Input, Material, Texture
from octex.source.models.gltf_file import Document, Json, as_numbers, as_object, is_number
from octex.source.models.reading import Description, Options, Slot

_ALPHA_MODES: dict[str, AlphaMode] = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}
_WRAPS = {10497: REPEAT, 33648: MIRROR, 33071: CLAMP}
_NEAREST = 9728
_IMAGE_EXTENSIONS = ("EXT_texture_avif", "EXT_texture_webp", "KHR_texture_basisu")
# Larger numbers are damage; products of two stay finite in single precision.
_FARTHEST = 1e18


class _Part(NamedTuple):
    """An object of the JSON, and its name in errors."""

    entry: Json
    name: str

    def part(self, key: str) -> _Part:
        """Return an object inside, an empty one if it is not there."""
        name = f"{self.name}.{key}"
        return _Part(as_object(self.entry.get(key, {}), name), name)

    def states(self, *keys: str) -> bool:
        """Say whether any of the keys stands in the file."""
        return any(key in self.entry for key in keys)

    def number(self, key: str, default: float) -> float:
        """Return a finite number."""
        value = self.entry.get(key, default)
        if not is_number(value, _FARTHEST):
            raise ModelError(
                f"{self.name}.{key} must be a number, not {reprlib.repr(value)}; export it again"
            )
        return float(value)

    def numbers(self, key: str, default: tuple[float, ...]) -> tuple[float, ...]:
        """Return as many finite numbers as the default has."""
        return as_numbers(self.entry.get(key, default), len(default), f"{self.name}.{key}", _FARTHEST)


#: A use of a texture: its image, which is being decoded, wraps of u and v, flat texels, and its coordinates.
_Reference = tuple[Future[Texels], int, int, bool, Slot]


def read_materials(
    document: Document, numbers: Iterable[int | None], options: Options
) -> dict[int | None, Description]:
    """Return materials by number, None for glTF's default; their images are decoded in parallel, each once.

    Inputs of channels that ``options`` does not want are there without their textures.
    Raises ModelError or ImageError.
    """
    described = {number: _described(document, number) for number in dict.fromkeys(numbers)}
    with pool_of(cpu_count()) as pool:
        images = _Images(document, pool)
        references = {
            number: {name: images.begin(each) for name, each in uses.items() if options.wants_image(name)}
            for number, (_, uses) in described.items()
        }
        known: dict[int | None, Description] = {}
        for number, (material, _) in described.items():
            slots: dict[Slot, int] = {}
            inputs = dict(material.inputs)
            for name, (image, wrap_u, wrap_v, nearest, slot) in references[number].items():
                place = slots.setdefault(slot, len(slots))
                texture = Texture(image.result(), wrap_u, wrap_v, nearest, place)
                inputs[name] = inputs[name]._replace(texture=texture)
            known[number] = Description(material._replace(inputs=inputs), tuple(slots))
        return known


def _described(document: Document, number: int | None) -> tuple[Material, dict[str, _Part]]:
    """Return a material without textures, and by channel the file's references to them."""
    record = _Part(
        {} if number is None else document.item("materials", number), f"{document.name}: materials[{number}]"
    )
    mode = record.entry.get("alphaMode", "OPAQUE")
    if mode not in _ALPHA_MODES:
        raise ModelError(f"{record.name} has an unknown alphaMode {reprlib.repr(mode)}; export it again")
    inputs: dict[str, Input] = {}
    uses: dict[str, _Part] = {}

    def state(
        name: str,
        factor: tuple[float, ...],
        holder: _Part,
        key: str,
        lanes: tuple[int, ...] = (0, 1, 2),
        offset: tuple[float, ...] = (),
    ) -> None:
        inputs[name] = Input(factor, None, lanes, offset)
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
    state("base_color", color[:3], pbr, texture)
    if mode != "OPAQUE":
        state("alpha", color[3:], pbr, texture, (3,))
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
        state("roughness", (-pbr.number("glossinessFactor", 1.0),), pbr, texture, (3,), (1.0,))
        if pbr.states("specularFactor", texture):
            state("specular", pbr.numbers("specularFactor", (1.0,) * 3), pbr, texture)
    else:
        texture = "metallicRoughnessTexture"
        for name, key, lane in (("metallic", "metallicFactor", 2), ("roughness", "roughnessFactor", 1)):
            if pbr.states(key, texture):
                state(name, (pbr.number(key, 1.0),), pbr, texture, (lane,))
        if extensions.states("KHR_materials_specular", "KHR_materials_ior"):
            layer, ior = extensions.part("KHR_materials_specular"), extensions.part("KHR_materials_ior")
            index = max(ior.number("ior", 1.5), 0.0)  # 0 reflects all
            first = layer.number("specularFactor", 1.0) * ((index - 1.0) / (index + 1.0)) ** 2
            tint = np.clip(first * np.array(layer.numbers("specularColorFactor", (1.0,) * 3)), 0.0, 1.0)
            state("specular", tuple(tint.tolist()), layer, "specularColorTexture")
    if record.states("occlusionTexture"):
        strength = record.part("occlusionTexture").number("strength", 1.0)
        state("occlusion", (strength,), record, "occlusionTexture", (0,), (1.0 - strength,))
    if record.states("emissiveFactor", "emissiveTexture"):
        strength = extensions.part("KHR_materials_emissive_strength").number("emissiveStrength", 1.0)
        light = tuple(strength * each for each in record.numbers("emissiveFactor", (0.0,) * 3))
        state("emissive", light, record, "emissiveTexture")
    if record.states("normalTexture"):
        scale = record.part("normalTexture").number("scale", 1.0)
        state("normal", (scale, scale, 1.0), record, "normalTexture")
    return material, uses


def _slot(use: _Part) -> Slot:
    transform = use.part("extensions").part("KHR_texture_transform")
    number = transform.entry.get("texCoord", use.entry.get("texCoord", 0))
    if isinstance(number, bool) or not isinstance(number, int) or number < 0:
        raise ModelError(
            f"{use.name}.texCoord must be a whole number, not {reprlib.repr(number)}; export it again"
        )
    return Slot(
        f"TEXCOORD_{number}",
        transform.numbers("scale", (1.0, 1.0)),
        transform.number("rotation", 0.0),
        transform.numbers("offset", (0.0, 0.0)),
    )


class _Images:
    """The images of a document, decoded by an executor from the moment they are asked for."""

    def __init__(self, document: Document, executor: Executor) -> None:
        self._document, self._executor = document, executor
        self._decoding: dict[str | int, Future[Texels]] = {}

    def begin(self, use: _Part) -> _Reference:
        """Return what a reference to a texture means, and begin to decode its image."""
        document, number = self._document, use.entry.get("index")
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
            if code not in _WRAPS:
                raise ModelError(f"{document.name}: a sampler has an unknown {axis} {code}; export it again")
        wrap_u, wrap_v = (_WRAPS[code] for code in wraps.values())
        return self._read(source), wrap_u, wrap_v, sampler.get("magFilter") == _NEAREST, _slot(use)

    def _read(self, number: int) -> Future[Texels]:
        """Read an image and have it decoded, unless another one at its place in the file is."""
        document = self._document
        entry = document.item("images", number)
        what = f"images[{number}]"
        name = f"{document.name}: {what}"
        place: str | int | None = entry.get("bufferView", entry.get("uri"))
        if place is None:
            raise ImageError(f"{name} has neither a uri nor a bufferView; export the model again")
        if place not in self._decoding:
            if isinstance(place, str):
                data = document.resource(place, what, ImageError)
                name = name if place.startswith("data:") else f"{name} ({place})"
            else:
                data = bytes(document.view(place)[0])
            self._decoding[place] = self._executor.submit(decode_image, data, name)
        return self._decoding[place]
