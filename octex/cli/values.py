"""Parses option values and file names, without heavy imports."""

from __future__ import annotations

import errno
import math
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, NoReturn

from octex.errors import ArgumentError
from octex.files import is_address

TEXTURE_ENDING, ARCHIVE_ENDING = ".octex", ".octz"
TEXTURE_ENDINGS = TEXTURE_ENDING, ARCHIVE_ENDING
PAGE_ENDING, PTEX_ENDING = ".html", ".ptx"
#: Web files: data for three.js.
WEB_ENDING = ".octw"
#: Equals formats.models.WRITTEN_ENDINGS, without an import.
USD_ENDINGS = ".usdz", ".usd", ".usda", ".usdc"
BAKED_ENDINGS = ".glb", ".gltf", ".obj", *USD_ENDINGS, ".3mf", ".ply", PTEX_ENDING
#: Known names, equal to those in the modules that use them.
DTYPES = "uint8", "uint16", "float16", "float32"
FILTERS = "nearest", "bilinear", "bicubic", "trilinear", "ewa"
PROJECTIONS = "planar", "box", "cylindrical", "spherical"
AXES = "x", "-x", "y", "-y", "z", "-z"
BLENDS = "over", "multiply", "screen", "add", "erase", "replace"
PICTURES = "average", "best", "robust"
BALANCES = "gain", "full"
HOLES = "leave", "smooth"
#: Largest width and height of a drawn image: the largest that octex reads.
MOST_PIXELS = 16384


class Address(str):
    """The address of a texture, in place of a path."""

    @property
    def name(self) -> str:
        """The file's name, without the query."""
        names = [PurePosixPath(re.split("[?#]", part)[0]).name for part in self.split("::")]
        return next((name for name in names if _is_texture(name)), names[-1])

    @property
    def suffix(self) -> str:
        """The ending of the name."""
        return PurePosixPath(self.name).suffix

    def is_dir(self) -> bool:
        """Return False: an address is a file's."""
        return False

    def stat(self) -> NoReturn:
        """Raise FileNotFoundError: the file is remote."""
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self))


class FunctionName(NamedTuple):
    """A function in a Python file, FILE.py:NAME."""

    path: Path
    name: str

    def __str__(self) -> str:
        return f"{self.path}:{self.name}"


#: The source of a channel: an image file, a function, a number for each component, or #rrggbb.
Source = Path | FunctionName | float | tuple[float, ...] | str


def is_texture_name(text: str) -> bool:
    """Return whether a word names a texture: a file, an address or a folder of parts."""
    return is_address(text) or _is_texture(text) or Path(text).is_dir()


def texture_file(text: str) -> Path | Address:
    """Parse the name of a texture, or its address."""
    if not is_address(text):
        return Path(text)
    address = Address(text)
    if not _is_texture(address.name):
        endings = " and NAME".join(TEXTURE_ENDINGS)
        raise ArgumentError(
            f"{text} is a URL; octex reads only textures, NAME{endings}, from one: download it first"
        )
    return address


def file_here(text: str) -> Path:
    """Parse the name of a local input file."""
    if is_address(text):
        raise ArgumentError(f"{text} is a URL, and octex reads this file from disk: download it first")
    return Path(text)


def output_file(text: str) -> Path:
    """Parse the name of an output file or folder."""
    if is_address(text):
        raise ArgumentError(f"{text} is a URL, and octex writes to disk only; write a file, then upload it")
    return Path(text)


def function_name(text: str) -> FunctionName | None:
    """Parse FILE.py:NAME; return None for another text."""
    path, colon, name = text.rpartition(":")
    return FunctionName(Path(path), name) if colon and path.endswith(".py") and name.isidentifier() else None


def one_of(*known: str) -> Callable[[str], str]:
    """Return a parser of one of these names."""

    def read(text: str) -> str:
        if text not in known:
            raise ArgumentError(f"{text!r} is not one of {', '.join(known)}")
        return text

    return read


def _number(
    kind: type[Any], limits: str = "", fits: Callable[[Any], bool] | None = None
) -> Callable[[str], Any]:
    """Return a parser of an int or a float within limits."""

    def read(text: str) -> Any:
        try:
            number = kind(text)
        except ValueError:
            raise ArgumentError(f"{text!r} is not a {'whole ' * (kind is int)}number") from None
        if fits is not None and not fits(number):
            raise ArgumentError(f"{text} is not {limits}")
        return number

    return read


whole_number = _number(int)
depth = _number(int, "from 0 to 21", lambda number: 0 <= number <= 21)  # as tree.layout.MAX_DEPTH
count = _number(int, "above zero", lambda number: number >= 1)
port_number = _number(int, "a port from 1 to 65535", lambda number: 1 <= number <= 65535)
real = _number(float, "a finite number", math.isfinite)
length = _number(float, "a finite number above zero", lambda number: 0.0 < number < math.inf)
codes = _number(float, "a finite number from 0 on", lambda number: 0.0 <= number < math.inf)
whole_codes = _number(int, "a whole number from 0 on", lambda number: number >= 0)
cells_apart = _number(float, "a number of cells from 1 to a million", lambda number: 1.0 <= number <= 1e6)
opacity = _number(float, "from 0 to 1", lambda number: 0.0 <= number <= 1.0)
angle = _number(float, "from 0 to 180", lambda number: 0.0 <= number <= 180.0)
pixels = _number(float, "from 0 to 1000000", lambda number: 0.0 <= number <= 1e6)


def thousands(text: str) -> int:
    """Parse a whole number above zero: 50k, 1.5M, 50000."""
    number, factor = text[:-1], {"k": 1e3, "M": 1e6}.get(text[-1:])
    try:
        value = float(number) * factor if factor else float(int(text))
    except ValueError:
        value = 0.0
    if not 1 <= value < 2**31:
        raise ArgumentError(f"{text!r} is not a number like 50k, 1.5M or 50000")
    return round(value)


def edge_length(text: str) -> float | str:
    """Parse a length, or "auto"."""
    return text if text == "auto" else float(length(text))


def angle_and_sides(text: str) -> dict[str, Any]:
    """Parse DEGREES, both, hidden into arguments of octex.project."""
    words = text.split(",")
    sides = {"back_faces": "both" in words, "hidden": "hidden" in words}
    numbers = [word for word in words if word not in ("both", "hidden")]
    return {"max_angle": angle(",".join(numbers)) if numbers else None, **sides}


def near(text: str) -> dict[str, float]:
    """Parse D or D,DEGREES into arguments of octex.Transfer; D is a distance, mean:RADIUS, or "any"."""
    distance, comma, degrees = text.partition(",")
    arguments: dict[str, float] = {"max_angle": angle(degrees)} if comma else {}
    if distance.startswith("mean:"):
        arguments["radius"] = length(distance.removeprefix("mean:"))
    elif distance != "any":
        arguments["distance"] = length(distance)
    return arguments


def light(text: str) -> Path | str:
    """Parse the name of a panorama, "studio" or "soft"."""
    return text if text in ("studio", "soft") else file_here(text)


def _pair(text: str, form: str) -> tuple[str, str]:
    """Split NAME=VALUE at its first sign; ``form`` describes it in messages."""
    name, _, value = (part.strip() for part in text.partition("="))
    if not (name and value):
        raise ArgumentError(f"{text!r} is not {form}")
    return name, value


def bump(text: str) -> tuple[str, float]:
    """Parse CHANNEL=HEIGHT."""
    name, height = _pair(text, "CHANNEL=HEIGHT, such as roughness=0.01")
    return name, real(height)


def displacement(text: str) -> tuple[str, float, float]:
    """Parse CHANNEL=HEIGHT or CHANNEL=HEIGHT,MIDDLE."""
    name, numbers = _pair(text, "CHANNEL=HEIGHT[,MIDDLE], such as roughness=0.01,0.5")
    height, comma, middle = numbers.partition(",")
    return name, real(height), real(middle) if comma else 0.0


def _check_names(names: Sequence[str]) -> None:
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise ArgumentError(f"{repeated} is named twice")


def channel_names(text: str) -> list[str]:
    """Parse names of channels, separated by commas."""
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise ArgumentError(f"{text!r} has an empty name; write base_color,normal")
    _check_names(names)
    return names


def dtypes(text: str) -> str | dict[str, str]:
    """Parse one stored type for all channels, or NAME=TYPE pairs separated by commas."""
    read = one_of(*DTYPES)
    if "=" not in text:
        return read(text.strip())
    pairs = [_pair(pair, "NAME=TYPE, such as normal=uint16") for pair in text.split(",")]
    _check_names([name for name, _ in pairs])
    return {name: read(dtype) for name, dtype in pairs}


def source(text: str) -> tuple[str, Source]:
    """Parse the source of a channel: NAME=FILE, =FILE.py:FUNCTION, =NUMBER,NUMBER,… or =#rrggbb."""
    name, value = _pair(text, "CHANNEL=FILE, such as roughness=rough.png")
    try:
        numbers = tuple(float(number) for number in value.split(","))
    except ValueError:
        is_color = value.startswith("#") and "." not in value
        return name, value if is_color else function_name(value) or file_here(value)
    return name, numbers[0] if len(numbers) == 1 else numbers


def projected(text: str) -> dict[str, Any]:
    """Parse KIND[:axis=A][:center=X,Y,Z][:size=S] into arguments of octex.MappedImage."""
    kind, *settings = text.split(":")
    readers: dict[str, Callable[[str], Any]] = {"axis": one_of(*AXES), "center": position, "size": sizes}
    arguments: dict[str, Any] = {"kind": one_of(*PROJECTIONS)(kind)}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if name not in readers or not equals:
            raise ArgumentError(
                f"{setting!r} is not one of axis=A, center=X,Y,Z, size=SIZE, such as box:size=0.5"
            )
        try:
            arguments[name] = readers[name](value)
        except ArgumentError as error:
            raise ArgumentError(f"{name}: {error}") from None
    if kind == "spherical" and "size" in arguments:
        raise ArgumentError("a spherical projection has no size: one copy of the image goes around")
    return arguments


def mask(text: str) -> Path | str | tuple[int, int, int]:
    """Parse a mask image, a name pattern with {stem} or {name}, or a backdrop colour, #rrggbb or R,G,B."""
    if re.fullmatch(r"#[^.]*|\d+,\d+,\d+", text):
        return color(text)
    return str(file_here(text)) if "{stem}" in text or "{name}" in text else file_here(text)


def holes(text: str) -> str | tuple[int, int, int]:
    """Parse how to fill unseen areas of a new texture: smooth, leave, or a colour."""
    if text in HOLES:
        return text
    try:
        return color(text)
    except ArgumentError as error:
        raise ArgumentError(f"{error}, nor {' or '.join(HOLES)}") from None


def subdivision(text: str) -> tuple[int, str]:
    """Parse LEVELS or LEVELS,limit: how often to subdivide a cage, and its rest positions."""
    levels, comma, rest = text.partition(",")
    return whole_number(levels), one_of("hull", "limit")(rest) if comma else "hull"


def _numbers(like: str, fits: Callable[[tuple[float, ...]], bool]) -> Callable[[str], tuple[float, ...]]:
    """Return a parser of finite numbers separated by commas."""

    def read(text: str) -> tuple[float, ...]:
        try:
            numbers = tuple(float(number) for number in text.split(","))
        except ValueError:
            raise ArgumentError(f"{text!r} must be numbers separated by commas") from None
        if not all(map(math.isfinite, numbers)):
            raise ArgumentError(f"{text} has numbers that are not finite")
        if not fits(numbers):
            raise ArgumentError(f"{text!r} is not {like}")
        return numbers

    return read


position = _numbers("X,Y,Z, such as 0,0.5,1", lambda numbers: len(numbers) == 3)
box = _numbers("x0,y0,z0,x1,y1,z1, such as 0,0,0,1,2,1", lambda numbers: len(numbers) == 6)
grid = _numbers(
    "x0,y0,z0,x1,y1,z1,EDGE, such as -1,-1,-1,1,1,1,0.02",
    lambda numbers: len(numbers) == 7 and numbers[6] > 0.0,
)
levels = _numbers(
    "BLACK,WHITE[,GAMMA], such as 0.1,0.9,1.2",
    lambda numbers: len(numbers) in (2, 3) and 0 <= numbers[0] < numbers[1] <= 1 and 0 < numbers[-1] <= 100,
)
_sphere = _numbers(
    "X,Y,Z,RADIUS, such as 0,0.5,1,0.2", lambda numbers: len(numbers) == 4 and numbers[3] > 0.0
)
_sizes = _numbers(
    "a size above zero, nor three like 1,1,0.5", lambda numbers: len(numbers) in (1, 3) and min(numbers) > 0.0
)


def sizes(text: str) -> float | tuple[float, ...]:
    """Parse a size, or one for each direction."""
    numbers = _sizes(text)
    return numbers if len(numbers) == 3 else numbers[0]


def direction(text: str) -> tuple[float, ...]:
    """Parse a direction: three numbers that are not all zero."""
    numbers = position(text)
    if not any(numbers):
        raise ArgumentError("must not be 0,0,0")
    return numbers


def disc(text: str) -> dict[str, Any]:
    """Parse X,Y,Z,RADIUS[:conformal][:up=X,Y,Z] into arguments of octex.unwrap."""
    sphere, *settings = text.split(":")
    numbers = _sphere(sphere)
    arguments: dict[str, Any] = {"center": numbers[:3], "radius": numbers[3]}
    for setting in settings:
        if setting.startswith("up="):
            arguments["up"] = direction(setting.removeprefix("up="))
        elif setting == "conformal":
            arguments["method"] = setting
        else:
            raise ArgumentError(f"{setting!r} is neither conformal nor up=X,Y,Z")
    return arguments


def file_and_amount(text: str) -> tuple[Path | Address, float]:
    """Parse a texture's file and, after the last =, a number from 0 to 1."""
    name, equals, number = text.rpartition("=")
    if not (name and equals):
        raise ArgumentError(f"{text!r} is not FILE=AMOUNT, such as other.octex=0.3")
    return texture_file(name), opacity(number)


def camera(text: str) -> tuple[Path, str | None]:
    """Parse a file of cameras, and a camera's name after a #; both may contain more #."""
    whole = file_here(text)
    signs = [at for at, letter in enumerate(text) if letter == "#" and at > 0]
    if not signs or whole.exists():
        return whole, None
    sign = next((at for at in signs if Path(text[:at]).exists()), signs[0])
    name = text[sign + 1 :]
    if not name:
        raise ArgumentError(f"{text!r} names no camera; write FILE#NAME, or FILE")
    return Path(text[:sign]), name


def image_size(text: str) -> tuple[int, int]:
    """Parse an image's width and height, separated by a comma or an x."""
    try:
        width, height = (int(number) for number in re.split("[,x×]", text))
    except ValueError:
        raise ArgumentError(f"{text!r} is not WIDTH,HEIGHT, such as 1024,768") from None
    if not (0 < width <= MOST_PIXELS and 0 < height <= MOST_PIXELS):
        raise ArgumentError(f"{text} is not from 1 to {MOST_PIXELS} pixels each way")
    return width, height


def color(text: str) -> tuple[int, int, int]:
    """Parse a colour as 8-bit codes: R,G,B or #rrggbb, or one number for a grey."""
    from octex.channels import screen_color

    try:
        numbers = screen_color(text) or tuple(int(number) for number in text.split(","))
        red, green, blue = numbers * 3 if len(numbers) == 1 else numbers
    except ValueError:
        raise ArgumentError(f"{text!r} is not R,G,B from 0 to 255, nor #rrggbb") from None
    if not all(0 <= number <= 255 for number in numbers):
        raise ArgumentError(f"{text} is not from 0 to 255")
    return red, green, blue


def _is_texture(name: str) -> bool:
    return name.lower().endswith(TEXTURE_ENDINGS)
