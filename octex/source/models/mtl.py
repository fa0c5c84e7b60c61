"""MTL files: the materials of OBJ models.

The specification (Alias|Wavefront, 1995) leaves open what numbers mean; octex follows the field's practice
(see `octex help models`). Colours are sRGB values, in files that Blender wrote linear light.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path, PureWindowsPath
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Int64s, Uint16s
from octex.channels import CHANNELS, LUMINANCE, srgb_to_linear
from octex.errors import ImageError, ModelError
from octex.files import read_bytes, referred
from octex.source.images.decode import decode_image, is_translucent
from octex.source.images.pyramid import CLAMP, REPEAT, Texels
from octex.source.images.tiles import is_udim, join_tiles, tile_files, tile_grid
from octex.source.materials import Input, Material, Texture
from octex.source.models.reading import LoadedMaterial, Options, Slot, parse_numbers

# Number of words after an option of a texture map; up to three numbers follow the last three.
_OPTION_WORDS = {
    "-blendu": 1, "-blendv": 1, "-boost": 1, "-bm": 1, "-cc": 1, "-clamp": 1, "-colorspace": 1,
    "-imfchan": 1, "-mm": 2, "-texres": 1, "-type": 1, "-o": 3, "-s": 3, "-t": 3,
}  # fmt: skip
_LANES = {"r": 0, "g": 1, "b": 2, "m": 3}
#: Keywords of a channel: of its number or colour, then of its map; the first map of a material counts.
KEYS = {
    "alpha": ("d", "map_d"),
    "base_color": ("Kd", "map_Kd"),
    "metallic": ("Pm", "map_Pm", "map_metallic"),
    "roughness": ("Pr", "map_Pr", "map_roughness"),
    "occlusion": ("", "map_ao"),
    "emissive": ("Ke", "map_Ke", "map_emissive"),
    "specular": ("Ks", "map_Ks"),
    "normal": ("", "norm", "map_Kn", "map_tangentSpaceNormal"),
}

#: The first bytes of files whose colours are linear light.
_LINEAR = b"# Blender"
# Grey images that went through JPEG differ by a few codes of 255; normal maps by about a hundred.
_GREY = 8 / 255
_ROWS = 256  # rows of an image that are processed at once


def load_materials(
    path: Path, lines: Sequence[str], wanted: set[str], options: Options
) -> tuple[dict[str, LoadedMaterial], dict[str, str], list[str]]:
    """Read the ``wanted`` materials of the mtllib ``lines`` of the OBJ file ``path``.

    Each line names one file or several, whose names may have blanks. Returns materials by name, the SHA-256
    of each file read, by its path from the model, and the lines whose files are missing.
    """
    images = ImageFiles(path.parent)
    materials: dict[str, LoadedMaterial] = {}
    missing = []
    for line in lines:
        for file in _libraries(path.parent, line):
            if file is not None:
                data = read_bytes(file)
                images.note(file, data)
                is_linear = data.startswith(_LINEAR)
                for name, entries in _entries(data, file):
                    if name in wanted:
                        reader = _MaterialReader(entries, name, file, images, options, is_linear)
                        materials[name] = reader.read()
            elif line not in missing:
                missing.append(line)
    needed = set(options.channels or ())
    needed.update(*(each.material.inputs.keys() - each.assumed for each in materials.values()))
    for name, (material, slots, assumed, *_) in materials.items():
        inputs = {key: value for key, value in material.inputs.items() if key not in assumed - needed}
        materials[name] = LoadedMaterial(material._replace(inputs=inputs), slots, assumed)
    return materials, images.files, missing


def _entries(data: bytes, path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the name of each material of an MTL file, and its lines by their first word."""
    entries: dict[str, str] = {}
    name = None
    for line in [*wavefront_lines(data, path), "newmtl"]:
        key, _, rest = line.partition(" ")
        if key == "newmtl":
            if name is not None:
                yield name, entries
            name, entries = rest.strip(), {}
        elif rest.strip():
            entries[key.lower()] = rest.strip()


def _libraries(folder: Path, line: str) -> list[Path | None]:
    """Return the files of an mtllib line, None for each that is missing."""
    if (file := find_beside(folder, line)) is not None:
        return [file]
    readings = [
        [find_beside(folder, name) for name in names]
        for names in (line.split(), re.findall(r"\S.*?\.mtl\b", line, re.IGNORECASE))
    ]
    return max(readings, key=lambda files: len(files) - files.count(None))


def wavefront_lines(data: bytes, path: Path) -> Iterator[str]:
    """Yield the lines of an OBJ or MTL file without comments, with single blanks after their first word."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = data.decode("utf-16", errors="replace")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:  # older programs write the code page of western Windows
            text = data.decode("cp1252", errors="replace")
    if "\0" in text:
        raise ModelError(f"{path.name} is not a text file, so not an {path.suffix[1:].upper()} file")
    if "\\" in text:
        text = text.replace("\\\r\n", " ").replace("\\\n", " ")
    if "\t" in text:
        text = text.replace("\t", " ")
    for line in text.splitlines():
        line = line.strip()
        if "#" in line:  # names may have it: after a name, a comment has blanks around the sign
            named = line.startswith(("usemtl", "newmtl", "mtllib", "map_", "norm", "bump"))
            line = line.partition(" # " if named else "#")[0]
        if line:
            yield line


def find_beside(folder: Path, name: str) -> Path | None:
    """Find a file by a path relative to a folder, else by its name there, else by its name in any case.

    A path with <UDIM> in its name is found if it has tiles.
    """
    windows = PureWindowsPath(name)
    for spelling in (name, windows.as_posix(), windows.name):
        try:
            candidate = referred(folder, spelling)
            if candidate.is_file() or (is_udim(candidate.name) and tile_files(candidate)):
                return candidate
        except (OSError, ValueError):
            continue
    alike = windows.name.casefold()  # Windows finds files in any case
    with suppress(OSError):
        return next((each for each in sorted(folder.iterdir()) if each.name.casefold() == alike), None)
    return None


class _TextureMap(NamedTuple):
    file: str
    slot: Slot = Slot()
    wrap: int = REPEAT
    lane: str = ""  # of -imfchan; "" where unsaid
    bump: float = 1.0
    base: float = 0.0
    gain: float = 1.0


class _MaterialReader:
    """Reads one material from its lines."""

    def __init__(
        self, entries: dict[str, str], name: str, path: Path, images: ImageFiles, options: Options,
        is_linear: bool,
    ) -> None:  # fmt: skip
        self._entries, self._name, self._path = entries, name, path
        self._where = f"{path.name}: material {name}"
        self._images, self._options, self._is_linear = images, options, is_linear
        self._slots: dict[Slot, int] = {}

    def read(self) -> LoadedMaterial:
        """Return the material."""
        special = {"alpha": self._alpha, "normal": self._normal}
        inputs = {"base_color": Input((1.0, 1.0, 1.0))}
        for channel in KEYS:
            read = self._scalar if CHANNELS[channel].components == 1 else self._color
            entry = special.get(channel, read)(channel)
            if entry is not None:
                inputs[channel] = entry
        assumed = set()
        if "roughness" not in inputs and "ns" in self._entries:
            exponent = self._numbers("Ns", 1)[0] if self._options.wants("roughness") else 0.0
            inputs["roughness"] = Input((1.0 - (min(max(exponent, 0.0), 1000.0) / 1000.0) ** 0.5,))
            assumed.add("roughness")
        if "specular" in inputs and self._map("map_Ks") is None:
            assumed.add("specular")
        material = Material(inputs, "blend" if "alpha" in inputs else "opaque", name=self._name)
        return LoadedMaterial(material, tuple(self._slots), frozenset(assumed))

    def _color(self, channel: str) -> Input | None:
        """Return a colour and its map; None if the material has neither, or no emission."""
        key, *maps = KEYS[channel]
        image, text = self._map(*maps), self._entries.get(key.lower())
        if image is None and text is None:
            return None
        numbers = parse_numbers(text or "1")
        black = numbers is not None and numbers.max(initial=-np.inf) <= 0.0
        if black and image is None and channel == "emissive":
            return None
        if not self._options.wants(channel):
            return Input((1.0, 1.0, 1.0))
        color = [1.0] if text is None else self._numbers(key, 3)
        if black and image is not None:
            color = [1.0]
        if len(color) < 3:
            color = [color[0]] * 3
        if max(color) <= 1.0 or channel != "emissive":
            values = np.clip(color, 0.0, 1.0)
            color = (values if self._is_linear else srgb_to_linear(values)).tolist()
        factor = tuple(max(component, 0.0) for component in color)
        return Input(factor, None if image is None else self._texture(image))

    def _scalar(self, channel: str) -> Input | None:
        """Return a map of single values, or else a number; None if the material has neither."""
        key, *maps = KEYS[channel]
        image = self._map(*maps)
        if image is None and key.lower() not in self._entries:
            return None
        if not self._options.wants(channel):
            return Input((1.0,))
        if image is None:
            return Input((min(max(self._numbers(key, 1)[0], 0.0), 1.0),))
        texture, lane = self._lane(image)
        return Input((1.0,), texture, (lane,))

    def _alpha(self, channel: str) -> Input | None:
        """Return opacity, and its map; None for an opaque material."""
        opacity = 1.0
        if "d" in self._entries:
            opacity = self._numbers("d", 1)[0]
        elif "tr" in self._entries:
            # MeshLab and others write opacity here: an invisible material is meant to be opaque.
            opacity = (1.0 - self._numbers("Tr", 1)[0]) or 1.0
        opacity = min(max(opacity, 0.0), 1.0)
        image = self._map(*KEYS[channel][1:])
        if image is None:
            return None if opacity == 1.0 else Input((opacity,))
        if not self._options.wants(channel):
            return Input((1.0,))
        matte = not image.lane and is_translucent(self._texels(image))
        texture, lane = self._lane(image._replace(lane="m") if matte else image)
        return Input((opacity or 1.0,), texture, (lane,))

    def _normal(self, channel: str) -> Input | None:
        normal_map = self._map(*KEYS[channel][1:])
        image = normal_map or self._map("map_Bump", "bump")
        if image is None:
            return None
        if not self._options.wants(channel):
            return Input((1.0, 1.0, 1.0))
        if normal_map is None:
            texels = self._texels(image)
            if image.lane or is_grey(texels):
                if image.lane == "l":
                    texels = self._images.luminance(texels)
                strength = image.bump * image.gain
                texels = self._images.normals(texels, _LANES.get(image.lane, 0), strength, image.wrap)
                return Input((1.0, 1.0, 1.0), self._placed(texels, image))
        return Input((image.bump, image.bump, 1.0), self._texture(image))

    def _lane(self, image: _TextureMap) -> tuple[Texture, int]:
        """Return the texture of a map of single values, and their component."""
        texture = self._texture(image)
        if image.lane == "l":
            return texture._replace(texels=self._images.luminance(texture.texels)), 0
        return texture, _LANES.get(image.lane, 0)

    def _texture(self, image: _TextureMap) -> Texture:
        return self._placed(self._texels(image, image.base, image.gain), image)

    def _placed(self, texels: Texels, image: _TextureMap) -> Texture:
        path = self._file(image)
        tiles = tile_grid(tile_files(path)) if is_udim(path.name) else (1, 1)
        slot = self._slots.setdefault(image.slot._replace(tiles=tiles), len(self._slots))
        return Texture(texels, image.wrap, image.wrap, slot=slot)

    def _texels(self, image: _TextureMap, base: float = 0.0, gain: float = 1.0) -> Texels:
        return self._images.read(self._file(image), f"{self._where}: {image.file}", base, gain)

    def _file(self, image: _TextureMap) -> Path:
        path = find_beside(self._path.parent, image.file)
        if path is None:
            raise ImageError(
                f"{self._where}: the image {image.file} is missing; put it next to {self._path.name}, or "
                "read only other channels (--channels)"
            )
        return path

    def _numbers(self, key: str, most: int) -> list[float]:
        return _floats(self._entries[key.lower()].replace("-halo", ""), most, f"{self._where}: {key}")

    def _map(self, *keys: str) -> _TextureMap | None:
        """Return the first texture map among the keys, without reading its image."""
        key = next((key for key in keys if key.lower() in self._entries), None)
        return None if key is None else _parse_map(self._entries[key.lower()], f"{self._where}: {key}")


def _parse_map(text: str, where: str) -> _TextureMap | None:
    """Split a texture map's line into the options and the file, whose name may have blanks."""
    options: dict[str, str] = {}
    rest = text
    while rest.split(" ", 1)[0].lower() in _OPTION_WORDS:
        option, _, rest = rest.partition(" ")
        words: list[str] = []
        for _ in range(_OPTION_WORDS[option.lower()]):
            word, _, after = rest.lstrip().partition(" ")
            if option.lower() in ("-o", "-s", "-t") and parse_numbers(word) is None:
                break
            words.append(word)
            rest = after
        options[option.lower()] = " ".join(words)
        rest = rest.lstrip()

    def numbers(option: str, *defaults: float) -> tuple[float, ...]:
        values = _floats(options[option], len(defaults), f"{where} {option}") if option in options else []
        return (*values, *defaults[len(values) :])

    lane = options.get("-imfchan", "z").lower()
    if lane not in ("l", "z", *_LANES):
        raise ModelError(f"{where} -imfchan is '{lane[:40]}', not one of r, g, b, m, l, z; correct the line")
    slot = Slot(scale=numbers("-s", 1.0, 1.0), offset=numbers("-o", 0.0, 0.0))
    file = rest.strip().strip('"')
    wrap = CLAMP if options.get("-clamp", "").lower() == "on" else REPEAT
    bump, mm = numbers("-bm", 1.0), numbers("-mm", 0.0, 1.0)
    if file in ("", "."):  # Blender wrote a dot for an image without a file
        return None
    return _TextureMap(file, slot, wrap, "" if lane == "z" else lane, *bump, *mm)


def _floats(text: str, most: int, what: str) -> list[float]:
    values = parse_numbers(text)
    if values is None or values.size == 0 or not np.isfinite(values).all():
        raise ModelError(f"{what} is '{text[:40]}', not numbers; correct the line")
    return [float(value) for value in values[:most]]


class ImageFiles:
    """The images of a model's materials, each read and converted once, and the digests of all files read."""

    def __init__(self, folder: Path) -> None:
        self.files: dict[str, str] = {}
        self._folder = folder
        self._texels: dict[tuple[object, ...], Texels] = {}

    def note(self, path: Path, data: bytes) -> None:
        """Record that a file was read."""
        inside = path.is_relative_to(self._folder)
        name = path.relative_to(self._folder).as_posix() if inside else path.name
        self.files[name] = hashlib.sha256(data).hexdigest()

    def read(self, path: Path, what: str, base: float = 0.0, gain: float = 1.0) -> Texels:
        """Return texels with values t as base + gain · t, clipped to 0 … 1; light above 1 stays."""
        if (path, base, gain) not in self._texels:
            texels: Texels
            if (base, gain) == (0.0, 1.0):
                texels = self._decoded(path, what)
            elif (whole := self.read(path, what)).dtype.kind == "u":
                codes = np.clip(np.rint(65535.0 * base + gain * np.arange(65536)), 0, 65535)
                texels = codes.astype(np.uint16)[whole]
            else:
                texels = np.maximum(np.float32(base) + np.float32(gain) * whole, np.float32(0))
            self._texels[path, base, gain] = texels
        return self._texels[path, base, gain]

    def _decoded(self, path: Path, what: str) -> Texels:
        if is_udim(path.name):
            return join_tiles({n: self._decoded(each, what) for n, each in tile_files(path).items()}, what)
        data = read_bytes(path)
        self.note(path, data)
        return decode_image(data, what)

    def luminance(self, texels: Texels) -> Texels:
        """Return an image whose red is another's luma, from stored values."""
        key = ("luminance", id(texels))
        if key not in self._texels:
            grey = texels[..., :3].astype(np.float32) @ LUMINANCE.astype(np.float32)
            grey = np.repeat(grey[..., None], 4, axis=2)
            self._texels[key] = np.rint(grey).astype(np.uint16) if texels.dtype.kind == "u" else grey
        return self._texels[key]

    def normals(self, texels: Texels, lane: int, strength: float, wrap: int) -> Texels:
        """Return the normal map of one lane's heights."""
        key = ("normals", id(texels), lane, strength, wrap)
        if key not in self._texels:
            unit = 65535.0 if texels.dtype.kind == "u" else 1.0
            self._texels[key] = normals_of_heights(texels[..., lane], strength / unit, wrap)
        return self._texels[key]


def is_grey(texels: Texels) -> bool:
    """Say whether red, green and blue are equal all over an image."""
    limit = _GREY * (65535.0 if texels.dtype.kind == "u" else 1.0)
    for first in range(0, len(texels), _ROWS):
        block = texels[first : first + _ROWS, :, :3].astype(np.float32)
        if (np.ptp(block, axis=2) > limit).any():
            return False
    return True


def normals_of_heights(heights: Array, strength: float, wrap: int) -> Uint16s:
    """Return the tangent-space normal map (height, width, 4) of a height map (height, width), rows down.

    The slopes are central differences, per texel, of ``strength`` × height. x right, y up, z out.
    """
    height, width = heights.shape
    texels = np.full((height, width, 4), 65535, np.uint16)
    columns = _continued(np.arange(-1, width + 1), width, wrap)
    for first in range(0, height, _ROWS):
        last = min(first + _ROWS, height)
        rows = _continued(np.arange(first - 1, last + 1), height, wrap)
        block = heights[rows][:, columns].astype(np.float32) * np.float32(strength / 2)
        right = block[1:-1, 2:] - block[1:-1, :-2]
        up = block[:-2, 1:-1] - block[2:, 1:-1]
        normals = np.stack([-right, -up, np.ones_like(up)], axis=-1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        texels[first:last, :, :3] = np.rint((normals + 1) * np.float32(32767.5))
    return texels


def _continued(indices: Int64s, size: int, wrap: int) -> Int64s:
    return np.clip(indices, 0, size - 1) if wrap == CLAMP else indices % size
