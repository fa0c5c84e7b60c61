"""Reads the values of options; nothing heavy is imported for it."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from pathlib import Path

from octex.cli.addresses import Address, file_here, texture_file
from octex.cli.functions import FunctionName, function_name

#: What octex stores (octex.channels.ONE), how it reads images (octex.source.images.filters.FILTERS), lays
#: them on surfaces (octex.source.mapped.KINDS) and along what (octex.source.mapped.FRAMES), how paint meets
#: what is there (octex.painting.picture.BLENDS), and what steers the depth but channels
#: (octex.conversion.detail.STRETCH); what becomes of several pictures (octex.painting.options.PICTURES) and
#: how they are made to agree (octex.painting.options.BALANCES).
DTYPES = ("uint8", "uint16", "float16", "float32")
FILTERS = ("nearest", "bilinear", "bicubic", "trilinear", "ripmap", "sat", "ewa")
PROJECTIONS = ("planar", "box", "cylindrical", "spherical")
AXES = ("x", "-x", "y", "-y", "z", "-z")
BLENDS = ("over", "multiply", "screen", "add", "erase", "replace")
STRETCH = "stretch"
PICTURES = ("average", "best", "robust")
BALANCES = ("gain", "full")
HOLES = ("leave", "smooth")

#: The widest and highest picture that is drawn: as large as octex reads.
MOST_PIXELS = 16384

#: What a channel is to come from: an image file, a function, or a number for each component.
Given = Path | FunctionName | float | tuple[float, ...]


def one_of(known: tuple[str, ...]) -> Callable[[str], str]:
    """Return what reads one of some names."""

    def read(text: str) -> str:
        if text not in known:
            raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join(known)}")
        return text

    return read


def whole_number(text: str) -> int:
    """Read a whole number."""
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None


def count(text: str) -> int:
    """Read a number of things, one at least."""
    number = whole_number(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{number} is not above zero")
    return number


def port_number(text: str) -> int:
    """Read a port of this machine."""
    number = whole_number(text)
    if not 1 <= number <= 65535:
        raise argparse.ArgumentTypeError(f"{number} is no port, 1 to 65535")
    return number


def file_size(text: str) -> int:
    """Read a number of bytes: 20MB, 800kB, 5000."""
    from octex.files import size_of

    try:
        return size_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def length(text: str) -> float:
    """Read a length: finite and above zero."""
    return _number(text, lambda number: 0.0 < number < float("inf"), "a finite number above zero")


def edge_length(text: str) -> float | str:
    """Read a length, or "auto"."""
    return text if text == "auto" else length(text)


def real(text: str) -> float:
    """Read a finite number."""
    return _number(text, lambda number: abs(number) < float("inf"), "a finite number")


def cells_apart(text: str) -> float:
    """Read how many cells parts are to be apart."""
    return _number(text, lambda number: 1.0 <= number <= 1e6, "a number of cells from 1 to a million")


def light(text: str) -> Path | str:
    """Read the name of a picture of light from all around, or "studio"."""
    return text if text == "studio" else file_here(text)


def bump(text: str) -> tuple[str, float]:
    """Read CHANNEL=HEIGHT."""
    name, equals, height = (part.strip() for part in text.partition("="))
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"{text!r} is not CHANNEL=HEIGHT, like roughness=0.01")
    return name, real(height)


def error_codes(text: str) -> float:
    """Read a number of 8-bit codes: finite, 0 or more."""
    return _number(text, lambda number: 0.0 <= number < float("inf"), "a finite number from 0 on")


def channel_names(text: str) -> list[str]:
    """Read names of channels, separated by commas."""
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise argparse.ArgumentTypeError(f"{text!r} has an empty name; write base_color,normal")
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise argparse.ArgumentTypeError(f"{twice} is there twice")
    return names


def dtypes(text: str) -> str | dict[str, str]:
    """Read one stored type for all channels, or NAME=TYPE pairs separated by commas."""
    if "=" not in text:
        return one_of(DTYPES)(text.strip())
    found: dict[str, str] = {}
    for pair in text.split(","):
        name, equals, dtype = (part.strip() for part in pair.partition("="))
        if not (name and equals):
            raise argparse.ArgumentTypeError(f"{pair!r} is not NAME=TYPE, like normal=uint16")
        if name in found:
            raise argparse.ArgumentTypeError(f"{name} is there twice")
        found[name] = one_of(DTYPES)(dtype)
    return found


def source(text: str) -> tuple[str, Given]:
    """Read what a channel comes from: NAME=FILE, NAME=FILE.py:FUNCTION, or NAME=NUMBER,NUMBER,…."""
    name, _, given = (part.strip() for part in text.partition("="))
    if not (name and given):
        raise argparse.ArgumentTypeError(f"{text!r} is not CHANNEL=FILE, like roughness=rough.png")
    try:
        numbers = tuple(float(number) for number in given.split(","))
    except ValueError:
        return name, function_name(given) or file_here(given)
    return name, numbers[0] if len(numbers) == 1 else numbers


def mask_pattern(text: str) -> str:
    """Read the path of masks, with {stem} or {name} for the picture's."""
    if "{stem}" not in text and "{name}" not in text:
        raise argparse.ArgumentTypeError(
            f"{text!r} has neither {{stem}} nor {{name}}; like masks/{{stem}}.png"
        )
    return str(file_here(text))


def position(text: str) -> tuple[float, ...]:
    """Read a position: three finite numbers."""
    numbers = _numbers(text)
    if len(numbers) != 3:
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y,Z, like 0,0.5,1")
    return numbers


def disc(text: str) -> tuple[float, ...]:
    """Read the centre of a disc and its radius, above zero."""
    numbers = _numbers(text)
    if len(numbers) != 4 or numbers[3] <= 0.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y,Z,RADIUS, like 0,0.5,1,0.2")
    return numbers


def sizes(text: str) -> float | tuple[float, ...]:
    """Read a size, or one for each direction: finite and above zero."""
    numbers = _numbers(text)
    if len(numbers) not in (1, 3) or min(numbers) <= 0.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size above zero, nor three like 1,1,0.5")
    return numbers if len(numbers) == 3 else numbers[0]


def box(text: str) -> tuple[float, ...]:
    """Read the lowest and the highest corner of a box."""
    numbers = _numbers(text)
    if len(numbers) != 6:
        raise argparse.ArgumentTypeError(f"{text!r} is not x0,y0,z0,x1,y1,z1, like 0,0,0,1,2,1")
    return numbers


def levels(text: str) -> tuple[float, ...]:
    """Read the levels that become 0 and 1, and a gamma."""
    numbers = _numbers(text)
    if len(numbers) not in (2, 3) or not (0 <= numbers[0] < numbers[1] <= 1 and 0 < numbers[-1] <= 100):
        raise argparse.ArgumentTypeError(f"{text!r} is not BLACK,WHITE[,GAMMA], like 0.1,0.9,1.2")
    return numbers


def file_and_amount(text: str) -> tuple[Path | Address, float]:
    """Read a texture's file and a number from 0 to 1, after the last =."""
    name, equals, number = text.rpartition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"{text!r} is not FILE=AMOUNT, like other.octex=0.3")
    return texture_file(name), _within(number, 1.0)


def opacity(text: str) -> float:
    """Read a number from 0 to 1."""
    return _within(text, 1.0)


def angle(text: str) -> float:
    """Read an angle in degrees, from 0 to 180."""
    return _within(text, 180.0)


def pixels(text: str) -> float:
    """Read a number of pixels, from 0 to a million."""
    return _within(text, 1e6)


def camera(text: str) -> tuple[Path, str | None]:
    """Read a file of cameras, and the name of one after a #; both may have more of these in them."""
    whole = file_here(text)
    places = [place for place, letter in enumerate(text) if letter == "#" and place > 0]
    if not places or whole.exists():
        return whole, None
    place = next((place for place in places if Path(text[:place]).exists()), places[0])
    name = text[place + 1 :]
    if not name:
        raise argparse.ArgumentTypeError(f"{text!r} names no camera; write FILE#NAME, or FILE")
    return Path(text[:place]), name


def picture_size(text: str) -> tuple[int, int]:
    """Read a picture's width and height, with a comma or an x between."""
    try:
        width, height = (int(number) for number in re.split("[,x×]", text))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTH,HEIGHT, like 1024,768") from None
    if not (0 < width <= MOST_PIXELS and 0 < height <= MOST_PIXELS):
        raise argparse.ArgumentTypeError(f"{text} is not from 1 to {MOST_PIXELS} pixels each way")
    return width, height


def color(text: str) -> tuple[int, int, int]:
    """Read a colour as 8-bit codes: R,G,B or #rrggbb, or one number for a grey."""
    try:
        if re.fullmatch("#[0-9a-fA-F]{6}", text):
            codes = list(bytes.fromhex(text[1:]))
        else:
            codes = [int(number) for number in text.split(",")]
        red, green, blue = codes * 3 if len(codes) == 1 else codes
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not R,G,B from 0 to 255, nor #rrggbb") from None
    if not all(0 <= code <= 255 for code in codes):
        raise argparse.ArgumentTypeError(f"{text} is not from 0 to 255")
    return red, green, blue


def _numbers(text: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(number) for number in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not numbers with commas between") from None
    if not all(abs(number) < float("inf") for number in numbers):
        raise argparse.ArgumentTypeError(f"{text} has numbers that are not finite")
    return numbers


def _within(text: str, most: float) -> float:
    return _number(text, lambda number: 0.0 <= number <= most, f"from 0 to {most:.7g}")


def _number(text: str, fits: Callable[[float], bool], limits: str) -> float:
    try:
        number = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
    if not fits(number):
        raise argparse.ArgumentTypeError(f"{text} is not {limits}")
    return number
