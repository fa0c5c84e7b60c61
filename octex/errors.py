"""Errors and exit codes, all of them.

OctexError                  anything octex refuses; the message names what, why and what to do
├── InputError              something given cannot be used
│   ├── ArgumentError       an argument (also a ValueError)
│   ├── ModelError          a model file or surface
│   ├── ImageError          an image file
│   ├── CameraError         a camera or a camera file
│   └── TextureFileError    an .octex file
├── OutputError             something could not be written; what stood there before still stands
└── MissingExtraError       an optional package is not installed (also an ImportError)

ModelWarning                part of a model is missing or was mended; it is read nevertheless (a UserWarning)
DefectError                 octex made something that does not fit together: nobody's input is to blame
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from typing import Self


class ExitCode(IntEnum):
    """What every octex command returns to the shell."""

    meaning: str

    def __new__(cls, value: int, meaning: str) -> Self:
        """Make a number that knows what it means."""
        code = int.__new__(cls, value)
        code._value_ = value
        code.meaning = meaning
        return code

    DONE = 0, "done"
    INVALID = 1, "validation found the file broken"
    REFUSED = 2, "bad usage, bad input, or output that cannot be written"
    NOTHING_PAINTED = 3, "nothing was painted"
    CRASHED = 70, "a defect of octex itself"
    INTERRUPTED = 130, "interrupted (Ctrl-C)"
    TERMINATED = 143, "told to end (SIGTERM)"


class OctexError(Exception):
    """Base of everything that octex raises on purpose."""


class InputError(OctexError):
    """Something given to octex cannot be used."""


class ArgumentError(InputError, ValueError):
    """An argument has the wrong type, shape, range or name."""


class ModelError(InputError):
    """A model file or a surface cannot be used."""


class ImageError(InputError):
    """An image is missing, broken or of a kind that octex does not read."""


class CameraError(InputError):
    """A camera or a camera file cannot be used."""


class TextureFileError(InputError):
    """A file is not an octree texture, is damaged, or comes from a newer octex."""


class OutputError(OctexError):
    """A file could not be written; nothing of the user's was changed."""


class MissingExtraError(OctexError, ImportError):
    """An optional dependency is needed; the message names the extra to install."""

    @classmethod
    def needed(cls, what: str, package: str, extra: str) -> Self:
        """Return the error for ``what`` takes a package that is not installed."""
        return cls(f"{what}, {package} is needed; install it: pip install 'octex[{extra}]'")


class ModelWarning(UserWarning):
    """A model was read without something that it refers to, or with something mended."""


class DefectError(Exception):
    """Octex itself made something inconsistent: a defect, whatever was given to it."""


def damaged(fault: str) -> ModelError:
    """Return the error for a fault of a file that only another export can mend."""
    return ModelError(f"{fault}; export it again")


@contextmanager
def own_making() -> Iterator[None]:
    """Raise DefectError for what is refused inside: for parts that octex made itself out of checked input."""
    try:
        yield
    except InputError as error:
        raise DefectError(str(error)) from error
