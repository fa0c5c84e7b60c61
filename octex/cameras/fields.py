"""Fields of camera files: read by name, checked, and named in errors."""

from __future__ import annotations

import contextlib
import math
import reprlib
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from octex.arrays import Float64s
from octex.cameras.camera import LARGEST, LARGEST_SIZE, SMALLEST
from octex.errors import ArgumentError, CameraError, ModelError


class BrokenError(Exception):
    """An error in a camera file; the message has no file name yet."""


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn any error of reading a file into a CameraError that names the file."""
    try:
        with np.errstate(all="ignore"):  # as_finite refuses values that overflow
            yield
    except (BrokenError, ArgumentError) as error:
        raise CameraError(f"{path}: {error}") from None
    except ModelError as error:  # its text begins with the file's name
        raise CameraError(f"{path}: {str(error).removeprefix(path.name).lstrip(': ')}") from None
    except UnicodeDecodeError:
        raise CameraError(f"{path}: is not UTF-8 text; is it a camera file, or damaged?") from None
    except (OSError, ValueError) as error:  # ValueError: an impossible file name
        reason = getattr(error, "strerror", None) or str(error)
        raise CameraError(f"{path}: cannot be read: {reason}; give a camera file") from error


@contextlib.contextmanager
def within(where: str) -> Iterator[None]:
    """Prefix errors with the name of the part of the file that has them."""
    try:
        yield
    except (BrokenError, ArgumentError) as error:
        raise BrokenError(f"{where}: {error}") from None


class Record:
    """Named fields of JSON, XML or a line of text; ``are_texts`` allows numbers written as texts.

    Each method returns a field as one type, or raises BrokenError that states the expected value.
    """

    def __init__(self, fields: Mapping[str, Any], *, are_texts: bool = False) -> None:
        self._fields = fields
        self._are_texts = are_texts

    def __contains__(self, field: str) -> bool:
        return field in self._fields

    def __iter__(self) -> Iterator[str]:
        return iter(self._fields)

    def find(self, field: str, default: object = None) -> object:
        """Return a field of any type, or the default."""
        return self._fields.get(field, default)

    def over(self, other: Record) -> Record:
        """Return this record's fields, completed by the fields of another record."""
        return Record({**other._fields, **self._fields}, are_texts=self._are_texts)

    def _get(self, field: str, kind: type, what: str) -> Any:
        if field not in self._fields:
            raise BrokenError(f"{field} is missing; it must be {what}")
        value = self._fields[field]
        if not isinstance(value, kind):
            raise BrokenError(f"{field} must be {what}, not {reprlib.repr(value)}")
        return value

    def key(self, field: str) -> str:
        """Return the identifier of another record, as a text."""
        return str(self._get(field, object, "a number"))

    def text(self, field: str) -> str:
        """Return a text."""
        return str(self._get(field, str, "a text"))

    def choice(self, field: str, choices: Sequence[str], default: str | None = None) -> Any:
        """Return a text out of ``choices``; the default where the field is missing."""
        if default is not None and field not in self:
            return default
        value = self.text(field)
        if value not in choices:
            raise BrokenError(f"{field} must be one of {', '.join(choices)}, not {reprlib.repr(value)}")
        return value

    def record(self, field: str) -> Record:
        """Return an object."""
        return Record(self._get(field, dict, "an object"), are_texts=self._are_texts)

    def records(self, field: str) -> list[Record]:
        """Return a list of objects."""
        values = self._get(field, list, "a list of objects")
        for value in values:
            if not isinstance(value, dict):
                raise BrokenError(f"{field} must be a list of objects, not of {reprlib.repr(value)}")
        return [Record(value, are_texts=self._are_texts) for value in values]

    def number(self, field: str, default: float | None = None) -> float:
        """Return a finite number; the default where the field is missing."""
        if default is not None and field not in self:
            return default
        return self._number(self._get(field, object, "a number"), field)

    def _number(self, value: object, field: str) -> float:
        try:
            return as_finite(float(value) if self._are_texts and isinstance(value, str) else value, field)
        except ValueError:
            raise BrokenError(f"{field} must be a number, not {reprlib.repr(value)}") from None

    def positive(self, field: str, below: float = math.inf) -> float:
        """Return a number above zero and below ``below``."""
        number = self.number(field)
        if not SMALLEST <= number < below:
            limit = "" if below == math.inf else f" and below {below:g}"
            raise BrokenError(f"{field} must be above zero{limit}, not {number:g}")
        return number

    def size(self, width: str = "width", height: str = "height") -> tuple[int, int]:
        """Return an image size (width, height): whole numbers of pixels in two fields."""
        pixels = []
        for field in (width, height):
            number = self.number(field)
            if not (1.0 <= number <= LARGEST_SIZE and number.is_integer()):
                raise BrokenError(f"{field} must be a whole number from 1 to {LARGEST_SIZE}, not {number:g}")
            pixels.append(int(number))
        return pixels[0], pixels[1]

    def numbers(self, field: str, *counts: int) -> Float64s:
        """Return a list of numbers whose length is in ``counts``."""
        what = " or ".join(map(str, counts))
        values = self._get(field, list, f"{what} numbers")
        if len(values) not in counts:
            raise BrokenError(f"{field} must be {what} numbers, not {len(values)}")
        return np.array([self._number(value, field) for value in values])

    def matrix(self, field: str, *shapes: tuple[int, int]) -> Float64s:
        """Return a matrix, stored as a list of rows, whose shape is in ``shapes``."""
        what = "a matrix of " + " or ".join(f"{rows}×{columns}" for rows, columns in shapes) + " numbers"
        values = self._get(field, list, what)
        widths = {len(row) if isinstance(row, list) else -1 for row in values}
        if not any(len(values) == rows and widths == {columns} for rows, columns in shapes):
            raise BrokenError(f"{field} must be {what}, row by row")
        return np.array([[self._number(value, field) for value in row] for row in values])


def as_finite(value: object, field: str) -> float:
    """Return a value as a float, or raise BrokenError unless it is a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= LARGEST:
        raise BrokenError(f"{field} must be a finite number, not {reprlib.repr(value)}")
    return float(value)


class Bytes:
    """Reads bytes from front to back."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    @property
    def left(self) -> int:
        """Number of unread bytes."""
        return len(self._content) - self._at

    def piece(self, count: int) -> bytes:
        """Return the next bytes."""
        if count > self.left:
            raise BrokenError("the file ends here; copy or export it again")
        self._at += count
        return self._content[self._at - count : self._at]

    def take(self, layout: str) -> tuple[Any, ...]:
        """Return the next values, little-endian."""
        return struct.unpack(f"<{layout}", self.piece(struct.calcsize(f"<{layout}")))

    def numbers(self, field: str, *shape: int) -> Float64s:
        """Return the next float64 values as an array of this shape."""
        values = self.take(f"{math.prod(shape)}d")
        return np.array([as_finite(value, field) for value in values]).reshape(shape)

    def text(self) -> str:
        """Return the bytes up to the next zero byte as text, and skip the zero byte."""
        count = self._content.find(b"\0", self._at) - self._at
        if count < 0:
            raise BrokenError("the file ends in a name; copy or export it again")
        return self.piece(count + 1)[:-1].decode("utf-8")
