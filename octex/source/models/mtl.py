"""MTL files: the materials of OBJ models.

The MTL specification (Alias|Wavefront, 1995) leaves open what a number means, and programs have added words
to it. The field's practice is followed:

    base_color  Kd, map_Kd                      emissive    Ke, map_Ke, map_emissive
    specular    Ks, map_Ks                      metallic    Pm, map_Pm, map_metallic
    alpha       d or 1 − Tr, map_d              roughness   Pr, map_Pr, map_roughness, else Ns
    normal      norm, map_Kn, map_tangentSpaceNormal, else map_Bump, bump
    occlusion   map_ao

* Colours are sRGB values, as they look on a screen; a Ke above 1 cannot be one and is linear light.
* A colour multiplies its map, and d multiplies map_d (the specification); but zero beside a map means
  nothing: exporters write it for "unset". Pr and Pm give way to their maps: Blender writes leftovers there.
* The alpha of a colour map is not opacity. map_d is: by the image's alpha if any texel is translucent (the
  specification's default), else by its red. Other single values are red too, unless -imfchan says r, g, b,
  m (alpha) or l (luminance); z, depth, is no part of image files and counts as unsaid.
* A map_Bump that is grey (within JPEG's noise), or whose -imfchan is said, holds heights: -bm × height in
  0 … 1, in texels. Other images are tangent-space normal maps, green up, as exporters write them there; -bm
  scales their x and y.
* Ns is roughness 1 − √(Ns / 1000), as Blender has it. Nearly every file has Ns and Ks, most of them
  leftovers: without a map or a Pr in any material in use, they make a channel only if asked for by name.
* -mm base gain makes base + gain · t of the stored values t, kept in 0 … 1. -s and then -o change a map's
  coordinates, -clamp on repeats the image's edge. Left out, as elsewhere: -t (turbulence), -blendu, -blendv,
  -boost, -cc, -colorspace, -texres, -type; map_Ns (exponents, gloss or roughness, as the program likes),
  map_Ka, disp, decal, refl, Ni, Tf, illum, and sheen, clear coat and anisotropy (Ps, Pc, Pcr, aniso, anisor).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path, PureWindowsPath
from typing import NamedTuple

import numpy as np

from octex.channels import srgb_to_linear
from octex.errors import ImageError, ModelError
from octex.files import read_bytes, referred
from octex.source.images.decode import is_translucent
from octex.source.images.pyramid import CLAMP, REPEAT, Texels
from octex.source.materials import Input, Material, Texture
from octex.source.models.imagefiles import ImageFiles, is_grey
from octex.source.models.options import Options
from octex.source.models.text import parse_numbers

# How many words follow an option of a texture map; up to three numbers follow the last three.
_OPTION_WORDS = {
    "-blendu": 1, "-blendv": 1, "-boost": 1, "-bm": 1, "-cc": 1, "-clamp": 1, "-colorspace": 1,
    "-imfchan": 1, "-mm": 2, "-texres": 1, "-type": 1, "-o": 3, "-s": 3, "-t": 3,
}  # fmt: skip
_LANES = {"r": 0, "g": 1, "b": 2, "m": 3}


class Transform(NamedTuple):
    """How a map changes texture coordinates: scaled, then moved; v up."""

    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


class Description(NamedTuple):
    """A material, and the texture coordinates of each slot that its textures name."""

    material: Material = Material({"base_color": Input((1.0, 1.0, 1.0))})
    transforms: tuple[Transform, ...] = ()
    assumed: frozenset[str] = frozenset()  # channels that only Ks or Ns speaks for


class Library(NamedTuple):
    """Materials by name, the SHA-256 of each file read, by its name beside the model, and what is missing."""

    materials: dict[str, Description]
    files: dict[str, str]
    missing: list[str]


def load_materials(path: Path, lines: Sequence[str], wanted: set[str], options: Options) -> Library:
    """Read the ``wanted`` materials of the mtllib ``lines`` of the OBJ file ``path``.

    Each line names one file, whose name may hold blanks, or several. Images are read of the channels that
    ``options`` asks for. A missing file is named in the result. Raises ModelError for a line that cannot be
    read, ImageError for an image that is missing or cannot be read.
    """
    images = ImageFiles(path.parent)
    materials: dict[str, Description] = {}
    missing = []
    for line in lines:
        found = beside(path.parent, line)
        for each in [found] if found is not None else [beside(path.parent, word) for word in line.split()]:
            if each is not None:
                materials |= _parse(each, wanted, images, options)
            elif line not in missing:
                missing.append(line)
    stated = {
        channel
        for material in materials.values()
        for channel in material.material.inputs.keys() - material.assumed
    }
    stated |= set(options.channels or ())
    kept = {name: _without(each, each.assumed - stated) for name, each in materials.items()}
    return Library(kept, images.files, missing)


def wavefront_lines(data: bytes, path: Path) -> Iterator[str]:
    """Yield the lines of an OBJ or MTL file without comments, with single blanks after their first word."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = data.decode("utf-16", errors="replace")
    else:
        text = data.decode("utf-8-sig", errors="replace")
    if "\0" in text:
        raise ModelError(f"{path.name} is not a text file, so not an {path.suffix[1:].upper()} file")
    if "\\" in text:
        text = text.replace("\\\r\n", " ").replace("\\\n", " ")
    if "\t" in text:
        text = text.replace("\t", " ")
    for line in text.splitlines():
        line = line.strip()
        if "#" in line:  # names may hold it: after one, a comment has blanks on both sides of the sign
            named = line.startswith(("usemtl", "newmtl", "mtllib", "map_", "norm", "bump"))
            line = line.partition(" # " if named else "#")[0]
        if line:
            yield line


def beside(folder: Path, name: str) -> Path | None:
    """Find a file by a path relative to a folder, or by its name there if the path leads nowhere."""
    windows = PureWindowsPath(name)
    for given in (name, windows.as_posix(), windows.name):
        try:
            candidate = referred(folder, given)
            if candidate.is_file():
                return candidate
        except (OSError, ValueError):
            continue
    return None


def _without(description: Description, channels: frozenset[str]) -> Description:
    """Leave out channels of a description."""
    inputs = {name: each for name, each in description.material.inputs.items() if name not in channels}
    return description._replace(material=description.material._replace(inputs=inputs))


def _parse(path: Path, wanted: set[str], images: ImageFiles, options: Options) -> dict[str, Description]:
    """Read the wanted materials of an MTL file."""
    data = read_bytes(path)
    images.note(path, data)
    materials: dict[str, Description] = {}
    entries: dict[str, str] = {}
    name = None
    for line in [*wavefront_lines(data, path), "newmtl"]:
        key, _, rest = line.partition(" ")
        if key == "newmtl":
            if name is not None and name in wanted:
                materials[name] = _Describer(entries, name, path, images, options).describe()
            name, entries = rest.strip(), {}
        elif rest.strip():
            entries[key.lower()] = rest.strip()
    return materials


class _Map(NamedTuple):
    """A line of a texture map."""

    file: str
    transform: Transform = Transform()
    wrap: int = REPEAT
    lane: str = ""  # of -imfchan; "" where unsaid
    bump: float = 1.0
    base: float = 0.0
    gain: float = 1.0


class _Describer:
    """Turns the lines of one material into what is read from it."""

    def __init__(
        self, entries: dict[str, str], name: str, path: Path, images: ImageFiles, options: Options
    ) -> None:
        self._entries = entries
        self._name = name
        self._where = f"{path.name}: material {name}"
        self._path = path
        self._images = images
        self._options = options
        self._transforms: list[Transform] = []

    def describe(self) -> Description:
        """Return the material."""
        alpha = self._alpha()
        assumed = set()
        inputs = {"base_color": self._color("base_color", "Kd", "map_Kd") or Input((1.0, 1.0, 1.0))}
        found = {
            "alpha": alpha,
            "metallic": self._scalar("metallic", "Pm", "map_Pm", "map_metallic"),
            "roughness": self._scalar("roughness", "Pr", "map_Pr", "map_roughness"),
            "occlusion": self._scalar("occlusion", "", "map_ao"),
            "emissive": self._color("emissive", "Ke", "map_Ke", "map_emissive"),
            "specular": self._color("specular", "Ks", "map_Ks"),
            "normal": self._normal(),
        }
        inputs |= {channel: each for channel, each in found.items() if each is not None}
        if "roughness" not in inputs and "ns" in self._entries:
            inputs["roughness"] = self._from_exponent()
            assumed.add("roughness")
        if found["specular"] is not None and self._map("map_Ks") is None:
            assumed.add("specular")
        material = Material(inputs, "opaque" if alpha is None else "blend", name=self._name)
        return Description(material, tuple(self._transforms), frozenset(assumed))

    def _color(self, channel: str, key: str, *maps: str) -> Input | None:
        """Return a colour and its map; None where the material has neither, or no emission."""
        found = self._map(*maps)
        if found is None and key.lower() not in self._entries:
            return None
        stated = parse_numbers(self._entries.get(key.lower(), "1"))
        black = stated is not None and stated.max(initial=-np.inf) <= 0.0
        if black and found is None and channel == "emissive":
            return None
        if not self._options.wants(channel):
            return Input((1.0, 1.0, 1.0))
        color = self._numbers(key, 3) if key.lower() in self._entries else [1.0]
        if black and found is not None:
            color = [1.0]
        if len(color) < 3:
            color = [color[0]] * 3
        if max(color) <= 1.0 or channel != "emissive":
            color = srgb_to_linear(np.clip(color, 0.0, 1.0)).tolist()
        factor = (max(color[0], 0.0), max(color[1], 0.0), max(color[2], 0.0))
        return Input(factor, None if found is None else self._texture(found))

    def _scalar(self, channel: str, key: str, *maps: str) -> Input | None:
        """Return a map of single values, else a number; None where the material has neither."""
        found = self._map(*maps)
        if found is None and key.lower() not in self._entries:
            return None
        if not self._options.wants(channel):
            return Input((1.0,))
        if found is None:
            return Input((min(max(self._numbers(key, 1)[0], 0.0), 1.0),))
        texture, lane = self._lane(found)
        return Input((1.0,), texture, (lane,))

    def _alpha(self) -> Input | None:
        """Return opacity, and its map; None for an opaque material."""
        opacity = 1.0
        if "d" in self._entries:
            opacity = self._numbers("d", 1)[0]
        elif "tr" in self._entries:
            # MeshLab and others write opacity here: of what would not be seen at all, they mean all.
            opacity = (1.0 - self._numbers("Tr", 1)[0]) or 1.0
        opacity = min(max(opacity, 0.0), 1.0)
        found = self._map("map_d")
        if found is None:
            return None if opacity == 1.0 else Input((opacity,))
        if not self._options.wants("alpha"):
            return Input((1.0,))
        matte = not found.lane and is_translucent(self._images.read(*self._file(found)))
        texture, lane = self._lane(found._replace(lane="m") if matte else found)
        return Input((opacity or 1.0,), texture, (lane,))

    def _from_exponent(self) -> Input:
        if not self._options.wants("roughness"):
            return Input((1.0,))
        exponent = min(max(self._numbers("Ns", 1)[0], 0.0), 1000.0)
        return Input((1.0 - (exponent / 1000.0) ** 0.5,))

    def _normal(self) -> Input | None:
        """Return a normal map, or one made of a height map."""
        given = self._map("norm", "map_Kn", "map_tangentSpaceNormal")
        found = given or self._map("map_Bump", "bump")
        if found is None:
            return None
        if not self._options.wants("normal"):
            return Input((1.0, 1.0, 1.0))
        if given is None:
            texels = self._images.read(*self._file(found))
            if found.lane or is_grey(texels):
                if found.lane == "l":
                    texels = self._images.luminance(texels)
                strength = found.bump * found.gain
                texels = self._images.normals(texels, _LANES.get(found.lane, 0), strength, found.wrap)
                return Input((1.0, 1.0, 1.0), self._placed(texels, found))
        return Input((found.bump, found.bump, 1.0), self._texture(found))

    def _lane(self, found: _Map) -> tuple[Texture, int]:
        """Return the texture of a map of single values, and the component that holds them."""
        texture = self._texture(found)
        if found.lane == "l":
            return texture._replace(texels=self._images.luminance(texture.texels)), 0
        return texture, _LANES.get(found.lane, 0)

    def _texture(self, found: _Map) -> Texture:
        path, what = self._file(found)
        return self._placed(self._images.read(path, what, found.base, found.gain), found)

    def _placed(self, texels: Texels, found: _Map) -> Texture:
        if found.transform not in self._transforms:
            self._transforms.append(found.transform)
        return Texture(texels, found.wrap, found.wrap, slot=self._transforms.index(found.transform))

    def _file(self, found: _Map) -> tuple[Path, str]:
        path = beside(self._path.parent, found.file)
        if path is None:
            raise ImageError(
                f"{self._where}: the image {found.file} is missing; put it beside {self._path.name}"
            )
        return path, f"{self._where}: {found.file}"

    def _numbers(self, key: str, most: int) -> list[float]:
        return _floats(self._entries[key.lower()].replace("-halo", ""), most, f"{self._where}: {key}")

    def _map(self, *keys: str) -> _Map | None:
        """Return the first of some texture maps, without reading its image."""
        key = next((key for key in keys if key.lower() in self._entries), None)
        return None if key is None else _parse_map(self._entries[key.lower()], f"{self._where}: {key}")


def _parse_map(text: str, where: str) -> _Map | None:
    """Split a texture map's line into the file, whose name may hold blanks, and the options before it."""
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
        given = _floats(options[option], len(defaults), f"{where} {option}") if option in options else []
        return (*given, *defaults[len(given) :])

    lane = options.get("-imfchan", "z").lower()
    if lane not in ("l", "z", *_LANES):
        raise ModelError(f"{where} -imfchan is '{lane[:40]}', not one of r, g, b, m, l, z; correct the line")
    (su, sv), (ou, ov) = numbers("-s", 1.0, 1.0), numbers("-o", 0.0, 0.0)
    file = rest.strip().strip('"')
    wrap = CLAMP if options.get("-clamp", "").lower() == "on" else REPEAT
    transform = Transform((su, sv), (ou, ov))
    bump, mm = numbers("-bm", 1.0), numbers("-mm", 0.0, 1.0)
    return _Map(file, transform, wrap, "" if lane == "z" else lane, *bump, *mm) if file else None


def _floats(text: str, most: int, what: str) -> list[float]:
    values = parse_numbers(text)
    if values is None or values.size == 0 or not np.isfinite(values).all():
        raise ModelError(f"{what} is '{text[:40]}', not numbers; correct the line")
    return [float(value) for value in values[:most]]
