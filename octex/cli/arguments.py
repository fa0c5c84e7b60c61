"""Reads the values of options; nothing heavy is imported for it."""

from __future__ import annotations

import argparse
from pathlib import Path

#: What octex stores (octex.channels.ONE), how it reads images (octex.source.images.filters.FILTERS), and what
#: steers its depth but channels (octex.conversion.detail.STRETCH).
DTYPES = ("uint8", "uint16", "float16", "float32")
FILTERS = ("nearest", "bilinear", "bicubic", "trilinear", "ripmap", "sat", "ewa")
STRETCH = "stretch"

#: What a channel is to come from: an image file, or a number for each component.
Given = Path | float | tuple[float, ...]


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


def length(text: str) -> float:
    """Read a length: finite and above zero."""
    try:
        number = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
    if not 0.0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a finite number above zero")
    return number


def error_codes(text: str) -> float:
    """Read a number of 8-bit codes: finite, 0 or more."""
    try:
        number = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
    if not 0.0 <= number < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a finite number from 0 on")
    return number


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
        return _one_of(text.strip(), DTYPES)
    found: dict[str, str] = {}
    for pair in text.split(","):
        name, equals, dtype = (part.strip() for part in pair.partition("="))
        if not (name and equals):
            raise argparse.ArgumentTypeError(f"{pair!r} is not NAME=TYPE, like normal=uint16")
        if name in found:
            raise argparse.ArgumentTypeError(f"{name} is there twice")
        found[name] = _one_of(dtype, DTYPES)
    return found


def image_filter(text: str) -> str:
    """Read the name of an image filter."""
    return _one_of(text, FILTERS)


def source(text: str) -> tuple[str, Given]:
    """Read what a channel comes from: NAME=FILE, NAME=NUMBER or NAME=NUMBER,NUMBER,…."""
    name, _, given = (part.strip() for part in text.partition("="))
    if not (name and given):
        raise argparse.ArgumentTypeError(f"{text!r} is not CHANNEL=FILE, like roughness=rough.png")
    try:
        numbers = tuple(float(number) for number in given.split(","))
    except ValueError:
        return name, Path(given)
    return name, numbers[0] if len(numbers) == 1 else numbers


def _one_of(text: str, known: tuple[str, ...]) -> str:
    if text not in known:
        raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join(known)}")
    return text
