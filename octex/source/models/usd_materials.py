"""The materials of USD stages: UsdPreviewSurface, with its images and primvars."""

from __future__ import annotations

import hashlib
import math
from pathlib import PureWindowsPath
from typing import Any

import numpy as np
from pxr import Ar, Usd, UsdShade

from octex.channels import CHANNELS, encode, srgb_to_linear
from octex.errors import ImageError
from octex.files import is_absolute
from octex.source.images.decode import decode_image
from octex.source.images.pyramid import CLAMP, MIRROR, REPEAT, Texels
from octex.source.images.tiles import is_udim, join_tiles, tile_grid
from octex.source.materials import AlphaMode, Input, Material, Texture
from octex.source.models.reading import LoadedMaterial, Options, Slot, warn

_WRAPS = {"repeat": REPEAT, "mirror": MIRROR}
_LANES = {"r": (0,), "g": (1,), "b": (2,), "a": (3,), "rgb": (0, 1, 2)}
#: The inputs of UsdPreviewSurface, by channel.
INPUTS = {
    "base_color": "diffuseColor", "emissive": "emissiveColor", "specular": "specularColor",
    "metallic": "metallic", "roughness": "roughness", "occlusion": "occlusion", "normal": "normal",
    "alpha": "opacity",
}  # fmt: skip
#: Connections of inputs that are read: images, and the primvars of two channels.
_READ = ("UsdUVTexture", "base_color displayColor", "alpha displayOpacity")
_GREY = (0.18, 0.18, 0.18)


class Materials:
    """The materials of a stage, numbered as they occur; each image is decoded once."""

    def __init__(self, name: str, options: Options) -> None:
        self._name, self._options = name, options
        self._numbers: dict[tuple[str, bool, bool], int] = {}
        self._texels: dict[tuple[tuple[str, ...], str], Texels] = {}
        self.loaded: list[LoadedMaterial] = []
        self.files: dict[str, str] = {}

    def number(self, material: Any, double_sided: bool, fades: bool) -> int:
        """Return a material's number, or else that of displayColor, with displayOpacity if it ``fades``."""
        path = str(material.GetPath()) if material and self._options.materials else ""
        key = path, double_sided, fades and not path
        if key not in self._numbers:
            loaded = self._load(material) if path else _plain(fades)
            name = material.GetPrim().GetName() if path else ""
            named = loaded.material._replace(name=name, double_sided=double_sided)
            self._numbers[key] = len(self.loaded)
            self.loaded.append(loaded._replace(material=named))
        return self._numbers[key]

    def _load(self, material: Any) -> LoadedMaterial:
        shader = material.ComputeSurfaceSource()[0]
        if not shader or shader.GetIdAttr().Get() != "UsdPreviewSurface":
            what = f"{self._name}: the material {material.GetPath()}"
            warn(f"{what} is not a UsdPreviewSurface, so it is white; convert it")
            return _plain()
        inputs: dict[str, Input] = {"base_color": Input(_GREY)}
        slots: dict[Slot, int] = {}
        vertex: set[str] = set()
        has_specular = bool(_value(shader, "useSpecularWorkflow", 0))
        left_out = "metallic" if has_specular else "specular"
        for channel, word in INPUTS.items():
            producer = None if channel == left_out else _producer(shader, word)
            if producer is None:
                continue
            node, output, value = producer
            kind = None if node is None else node.GetIdAttr().Get()
            if kind == "UsdUVTexture":
                textured = self._textured(channel, node, output, slots)
                if textured is not None:
                    inputs[channel] = textured
            elif kind is not None and kind.startswith("UsdPrimvarReader"):
                inputs[channel] = Input((1.0,) * CHANNELS[channel].components)
                kind = f"{channel} {_value(node, 'varname', '')}"
                vertex.add(kind)
            elif value is not None and channel != "normal":
                inputs[channel] = Input(tuple(np.atleast_1d(np.array(value, np.float64)).tolist()))
            if node is not None and kind not in _READ:
                warn(f"{self._name}: {shader.GetPath()}: what {word} is connected to is not read; bake it")
        cutoff = float(_value(shader, "opacityThreshold", 0.0))
        reads_opacity = "alpha displayOpacity" in vertex
        mode: AlphaMode = "mask" if cutoff > 0.0 else "blend"
        alpha = inputs.get("alpha")
        if alpha is None or (alpha.texture is None and alpha.factor == (1.0,) and not reads_opacity):
            mode = "opaque"
            inputs.pop("alpha", None)
        material = Material(inputs, mode, cutoff if mode == "mask" else 0.5)
        reads_color = "base_color displayColor" in vertex
        return LoadedMaterial(material, tuple(slots), reads_color=reads_color, reads_opacity=reads_opacity)

    def _textured(self, channel: str, node: Any, output: str, slots: dict[Slot, int]) -> Input | None:
        """Return the input of a channel that reads an image; None for normals without an image."""
        scale = np.array(_value(node, "scale", (1.0,) * 4), np.float64)
        bias = np.array(_value(node, "bias", (0.0,) * 4), np.float64)
        lanes = _LANES.get(output, (0, 1, 2))
        if CHANNELS[channel].components == 1:
            lanes = lanes[:1]
        elif len(lanes) == 1:
            lanes *= 3
        asset = _value(node, "file", None)
        if asset is None or not asset.path:
            warn(f"{self._name}: {node.GetPath()} names no image, so it is its fallback")
            fallback = np.array(_value(node, "fallback", (0.0, 0.0, 0.0, 1.0)), np.float64)
            return None if channel == "normal" else Input(tuple(fallback[list(lanes)].tolist()))
        factor, offset = tuple(scale[list(lanes)].tolist()), tuple(bias[list(lanes)].tolist())
        if channel == "normal":  # the factor scales 2t − 1 of a texel t
            plain = (scale == 1.0).all() and (bias == 0.0).all()
            factor, offset = (1.0,) * 3 if plain else tuple((scale[:3] / 2.0).tolist()), ()
        entry = Input(factor, None, lanes, offset if any(offset) else ())
        if not self._options.wants_image(channel):
            return entry
        paths = self._image_paths(node, asset)
        texels = self._image(node, asset, paths, _value(node, "sourceColorSpace", "auto"), channel)
        wraps = [_WRAPS.get(_value(node, axis, "useMetadata"), CLAMP) for axis in ("wrapS", "wrapT")]
        tiles = tile_grid(paths) if is_udim(asset.path) else (1, 1)
        slot = slots.setdefault(_slot(node)._replace(tiles=tiles), len(slots))
        return entry._replace(texture=Texture(texels, wraps[0], wraps[1], False, slot))

    def _image_paths(self, node: Any, asset: Any) -> dict[int, str]:
        """Return the resolved path of an image, or those of UDIM tiles by number; empty if it is missing.

        An image that is not where the file says is sought by its name next to the stage.
        """
        if asset.resolvedPath and not is_absolute(asset.path) and not is_udim(asset.path):
            return {0: asset.resolvedPath}
        windows, stage = PureWindowsPath(asset.path), node.GetPrim().GetStage()
        attribute = UsdShade.Utils.GetValueProducingAttributes(node.GetInput("file"))[0]
        layers = attribute.GetPropertyStack()[0].layer, stage.GetRootLayer()
        spellings = [] if is_absolute(asset.path) else [(windows.as_posix(), layers[0])]
        for name, layer in (*spellings, (windows.name, layers[1])):
            if is_udim(name):
                tiles = UsdShade.UdimUtils.ResolveUdimTilePaths(name, layer)
                paths = {int(number): path for path, number in tiles}
            else:
                path = Ar.GetResolver().Resolve(layer.ComputeAbsolutePath(name))
                paths = {0: str(path)} if path else {}
            if paths:
                return paths
        if is_absolute(asset.path):
            what = f"{self._name}: {node.GetPath()}"
            raise ImageError(
                f"{what} names {asset.path}; absolute paths are not followed; name it from the model's folder"
            )
        return {}

    def _image(self, node: Any, asset: Any, paths: dict[int, str], space: str, channel: str) -> Texels:
        """Return an image's codes in the colour space of a channel."""
        what = f"{self._name}: {node.GetPath()}"
        opened = {n: Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path)) for n, path in paths.items()}
        if not opened or None in opened.values():
            raise ImageError(
                f"{what}: its image {asset.path} is missing; put it next to the model, or read only other "
                "channels (--channels)"
            )
        key = tuple(paths.values())
        is_light = CHANNELS[channel].space == "srgb" or channel == "alpha"
        changes = {"raw": "to sRGB" if is_light else "", "sRGB": "" if is_light else "to linear"}
        change = changes.get(space, "")
        if (key, "") not in self._texels:
            tiles = {}
            for number, file in opened.items():
                data = bytes(file.GetBuffer())
                name = asset.path.replace("<UDIM>", str(number))
                self.files[name] = hashlib.sha256(data).hexdigest()
                tiles[number] = decode_image(data, f"{what} ({name})")
            is_tiled = is_udim(asset.path)
            self._texels[key, ""] = join_tiles(tiles, f"{what} ({asset.path})") if is_tiled else tiles[0]
        if (key, change) not in self._texels:
            texels = self._texels[key, ""]
            if texels.dtype.kind != "f":  # floats are linear
                table = np.arange(65536) / 65535.0
                if change == "to sRGB":
                    table = encode(table, "uint16", "srgb")
                else:
                    table = encode(srgb_to_linear(table), "uint16", "data")
                alpha, texels = texels[..., 3], np.asarray(table[texels], np.uint16)
                texels[..., 3] = alpha
            self._texels[key, change] = texels
        return self._texels[key, change]


def bound_material(api: Any) -> Any:
    """Return the material that a prim is drawn with: its preview, or else the full one; None without any."""
    tokens = UsdShade.Tokens
    materials = (api.ComputeBoundMaterial(purpose)[0] for purpose in (tokens.preview, tokens.full))
    return next(filter(None, materials), None)


def _plain(fades: bool = False) -> LoadedMaterial:
    """Return the material of a mesh without one: displayColor, or white; displayOpacity if it ``fades``."""
    inputs = {"base_color": Input((1.0, 1.0, 1.0)), "alpha": Input((1.0,))}
    material = Material(inputs, "blend" if fades else "opaque")
    return LoadedMaterial(material, reads_color=True, reads_opacity=fades)


def _producer(shader: Any, name: str) -> tuple[Any, str, Any] | None:
    """Return an input's shader and output, or else None, "" and its value; None for a missing input."""
    entry = shader.GetInput(name)
    if not entry:
        return None
    for attribute in UsdShade.Utils.GetValueProducingAttributes(entry):
        if UsdShade.Output.IsOutput(attribute):
            return UsdShade.Shader(attribute.GetPrim()), UsdShade.Output(attribute).GetBaseName(), None
        value = attribute.Get(Usd.TimeCode.EarliestTime())
        if value is not None:
            return None, "", value
    return None


def _value(shader: Any, name: str, default: Any) -> Any:
    producer = _producer(shader, name)
    return default if producer is None or producer[2] is None else producer[2]


def _slot(node: Any) -> Slot:
    """Return the set of coordinates of an image."""
    producer = _producer(node, "st")
    scale: tuple[float, ...] = (1.0, 1.0)
    translation: tuple[float, ...] = (0.0, 0.0)
    rotation = 0.0
    if producer is not None and producer[0] is not None and producer[0].GetIdAttr().Get() == "UsdTransform2d":
        turn = producer[0]
        scale = tuple(map(float, _value(turn, "scale", scale)))
        rotation = float(_value(turn, "rotation", rotation))
        translation = tuple(map(float, _value(turn, "translation", translation)))
        producer = _producer(turn, "in")
    name = "st" if producer is None or producer[0] is None else str(_value(producer[0], "varname", "st"))
    return Slot(name, scale, -math.radians(rotation), translation)  # v runs up here
