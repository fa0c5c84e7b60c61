"""Materials of glTF files: which channels they state, and the images that those read (glTF 2.0, 3.8 and 3.9).

A channel is stated by a factor or a map that stands in the file. Beside the core's metallic-roughness
materials: KHR_materials_unlit, which leaves only base colour and alpha; KHR_materials_emissive_strength;
KHR_texture_transform; and the older KHR_materials_pbrSpecularGlossiness, whose materials are not metallic and
as rough as they are not glossy. Other extensions of materials change none of these channels.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterable
from concurrent.futures import Executor, Future
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.errors import ImageError, ModelError
from octex.parallel import cpu_count, threads
from octex.source.gltf_file import CODED, Document
from octex.source.images import decode_image
from octex.source.materials import AlphaMode, Input, Material, Texture
from octex.source.options import Options
from octex.source.pyramid import CLAMP, MIRROR, REPEAT

_ALPHA_MODES: dict[str, AlphaMode] = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}
_WRAPS = {10497: REPEAT, 33648: MIRROR, 33071: CLAMP}
_NEAREST = 9728


class Slot(NamedTuple):
    """A set of texture coordinates, and what is done to it before an image is read."""

    number: int  # n of TEXCOORD_n
    scale: tuple[float, ...] = (1.0, 1.0)
    rotation: float = 0.0  # radians, counter-clockwise as seen on the image
    offset: tuple[float, ...] = (0.0, 0.0)

    def applied(self, coordinates: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return coordinates (n, 2) scaled, turned, then moved (KHR_texture_transform)."""
        if self == Slot(self.number):
            return coordinates
        cos, sin = math.cos(self.rotation), math.sin(self.rotation)
        turned = (coordinates * self.scale) @ np.array([[cos, -sin], [sin, cos]])
        moved: npt.NDArray[np.float64] = turned + self.offset
        return moved


class Bound(NamedTuple):
    """A material, and the coordinates that each of its textures' slots stands for."""

    material: Material
    slots: tuple[Slot, ...]

    @property
    def normal_slot(self) -> int | None:
        """The slot of the normal map, if there is one that is wanted."""
        given = self.material.inputs.get("normal")
        return None if given is None or given.texture is None else given.texture.slot


class _Reference(NamedTuple):
    """A use of a texture: the place of its image in the file, its sampler, and its coordinates."""

    image: str | int
    wrap_u: int
    wrap_v: int
    nearest: bool
    slot: Slot


def read_materials(
    document: Document, numbers: Iterable[int | None], options: Options
) -> dict[int | None, Bound]:
    """Return materials by number, None for glTF's default; their images are decoded in parallel, each once.

    Inputs of channels that ``options`` does not want are there without their textures.
    Raises ModelError or ImageError.
    """
    described = {number: _described(document, number) for number in dict.fromkeys(numbers)}
    with threads(cpu_count()) as pool:
        images = _Images(document, pool)
        references = {
            number: {name: images.begin(*each) for name, each in uses.items() if _is_wanted(name, options)}
            for number, (_, uses) in described.items()
        }
        return {
            number: _bound(material, references[number], images)
            for number, (material, _) in described.items()
        }


def _is_wanted(channel: str, options: Options) -> bool:
    """Say whether a channel's image is to be read; colour is averaged by coverage, so alpha comes along."""
    pair = ("base_color", "alpha")
    return any(map(options.wants, pair)) if channel in pair else options.wants(channel)


def _bound(material: Material, references: dict[str, _Reference], images: _Images) -> Bound:
    """Give a material its textures."""
    slots: dict[Slot, int] = {}
    inputs = dict(material.inputs)
    for name, (image, wrap_u, wrap_v, nearest, slot) in references.items():
        place = slots.setdefault(slot, len(slots))
        texture = Texture(images.texels(image), wrap_u, wrap_v, nearest, place)
        inputs[name] = inputs[name]._replace(texture=texture)
    return Bound(material._replace(inputs=inputs), tuple(slots))


_Uses = dict[str, tuple[dict[str, Any], str]]


def _described(document: Document, number: int | None) -> tuple[Material, _Uses]:
    """Return a material without textures, and by channel the file's references to them with their names."""
    entry = {} if number is None else document.item("materials", number)
    what = f"{document.name}: materials[{number}]"
    mode = entry.get("alphaMode", "OPAQUE")
    if mode not in _ALPHA_MODES:
        raise ModelError(f"{what} has an unknown alphaMode {reprlib.repr(mode)}; export it again")
    inputs: dict[str, Input] = {}
    uses: _Uses = {}

    def state(
        name: str,
        factor: tuple[float, ...],
        holder: dict[str, Any],
        key: str,
        lanes: tuple[int, ...] = (0, 1, 2),
        offset: tuple[float, ...] = (),
    ) -> None:
        inputs[name] = Input(factor, None, lanes, offset)
        if key in holder:
            uses[name] = holder[key], f"{what}.{key}"

    extensions = entry.get("extensions", {})
    is_unlit = "KHR_materials_unlit" in extensions
    older = None if is_unlit else extensions.get("KHR_materials_pbrSpecularGlossiness")
    pbr, factor, texture = entry.get("pbrMetallicRoughness", {}), "baseColorFactor", "baseColorTexture"
    if older is not None:
        pbr, factor, texture = older, "diffuseFactor", "diffuseTexture"
    color = _numbers(pbr, factor, (1.0,) * 4, what)
    state("base_color", color[:3], pbr, texture)
    if mode != "OPAQUE":
        state("alpha", color[3:], pbr, texture, (3,))
    material = Material(inputs, _ALPHA_MODES[mode], _number(entry, "alphaCutoff", 0.5, what))
    if is_unlit:
        return material, uses
    if older is None:
        texture = "metallicRoughnessTexture"
        for name, key, lane in (("metallic", "metallicFactor", 2), ("roughness", "roughnessFactor", 1)):
            if texture in pbr or key in pbr:
                state(name, (_number(pbr, key, 1.0, what),), pbr, texture, (lane,))
    else:
        texture = "specularGlossinessTexture"
        state("metallic", (0.0,), {}, "")
        state("roughness", (-_number(older, "glossinessFactor", 1.0, what),), older, texture, (3,), (1.0,))
        if texture in older or "specularFactor" in older:
            state("specular", _numbers(older, "specularFactor", (1.0,) * 3, what), older, texture)
    if "occlusionTexture" in entry:
        strength = _number(entry["occlusionTexture"], "strength", 1.0, f"{what}.occlusionTexture")
        state("occlusion", (strength,), entry, "occlusionTexture", (0,), (1.0 - strength,))
    if "emissiveFactor" in entry or "emissiveTexture" in entry:
        lamp = extensions.get("KHR_materials_emissive_strength", {})
        strength = _number(lamp, "emissiveStrength", 1.0, what)
        light = _numbers(entry, "emissiveFactor", (0.0,) * 3, what)
        state("emissive", tuple(strength * each for each in light), entry, "emissiveTexture")
    if "normalTexture" in entry:
        scale = _number(entry["normalTexture"], "scale", 1.0, f"{what}.normalTexture")
        state("normal", (scale, scale, 1.0), entry, "normalTexture")
    return material, uses


def _slot(info: dict[str, Any], what: str) -> Slot:
    transform = info.get("extensions", {}).get("KHR_texture_transform", {})
    number = transform.get("texCoord", info.get("texCoord", 0))
    if isinstance(number, bool) or not isinstance(number, int) or number < 0:
        raise ModelError(f"{what} has texCoord {reprlib.repr(number)}, not a whole number; export it again")
    return Slot(
        number,
        _numbers(transform, "scale", (1.0, 1.0), what),
        _number(transform, "rotation", 0.0, what),
        _numbers(transform, "offset", (0.0, 0.0), what),
    )


def _number(entry: dict[str, Any], key: str, default: float, what: str) -> float:
    """Return a finite number of the file."""
    value = entry.get(key, default)
    if not _is_number(value):
        raise ModelError(f"{what} has {key} {reprlib.repr(value)}, not a number; export it again")
    return float(value)


def _numbers(entry: dict[str, Any], key: str, default: tuple[float, ...], what: str) -> tuple[float, ...]:
    """Return as many finite numbers of the file as the default has."""
    values = entry.get(key, default)
    if not (
        isinstance(values, (list, tuple)) and len(values) == len(default) and all(map(_is_number, values))
    ):
        raise ModelError(
            f"{what} has {key} {reprlib.repr(values)}, not {len(default)} numbers; export it again"
        )
    return tuple(map(float, values))


def _is_number(value: Any) -> bool:
    # Whole numbers may be too large to be compared as floats, but not with this one.
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300


class _Images:
    """The images of a document, decoded by an executor from the moment they are asked for."""

    def __init__(self, document: Document, executor: Executor) -> None:
        self._document = document
        self._executor = executor
        self._decoding: dict[str | int, Future[npt.NDArray[np.uint16] | npt.NDArray[np.float32]]] = {}

    def begin(self, info: dict[str, Any], what: str) -> _Reference:
        """Return what a reference to a texture means, and begin to decode its image."""
        document, number = self._document, info["index"]
        entry = document.item("textures", number)
        source = entry.get("source")
        for name, extension in entry.get("extensions", {}).items():
            if source is None and name in ("EXT_texture_webp", "EXT_texture_avif"):
                source = extension.get("source")
            elif source is None and name in CODED:
                raise document.coded(name)
        if source is None:
            raise ModelError(f"{document.name}: textures[{number}] names no image that octex reads")
        sampler = document.item("samplers", entry["sampler"]) if "sampler" in entry else {}
        wraps = []
        for axis in ("wrapS", "wrapT"):
            code = sampler.get(axis, 10497)
            if code not in _WRAPS:
                raise ModelError(f"{document.name}: a sampler has an unknown {axis} {code}; export it again")
            wraps.append(_WRAPS[code])
        is_nearest = sampler.get("magFilter") == _NEAREST
        return _Reference(self._read(source), wraps[0], wraps[1], is_nearest, _slot(info, what))

    def texels(self, place: str | int) -> npt.NDArray[np.uint16] | npt.NDArray[np.float32]:
        """Return an image that was begun."""
        return self._decoding[place].result()

    def _read(self, number: int) -> str | int:
        """Read an image and have it decoded, unless it is; return its place, which other images may share."""
        document = self._document
        entry = document.item("images", number)
        what = f"images[{number}]"
        name = f"{document.name}: {what}"
        place: str | int
        if "bufferView" in entry:
            place = entry["bufferView"]
        elif "uri" in entry:
            place = entry["uri"]
        else:
            raise ImageError(f"{name} has neither a uri nor a bufferView; export the model again")
        if place not in self._decoding:
            if isinstance(place, str):
                data = document.resource(place, what, ImageError)
                name = name if place.startswith("data:") else f"{name} ({place})"
            else:
                data = bytes(document.view(place)[0])
            self._decoding[place] = self._executor.submit(decode_image, data, name)
        return place
