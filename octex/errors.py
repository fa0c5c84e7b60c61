"""All errors and exit codes.

OctexError                  anything octex refuses; the message names the cause and a remedy
├── InputError              unusable input
│   ├── ArgumentError       an argument (also a ValueError)
│   ├── ModelError          a model file or surface
│   ├── ImageError          an image file
│   ├── CameraError         a camera or a camera file
│   └── TextureFileError    an .octex file
├── OutputError             output could not be written; the previous content is unchanged
└── MissingExtraError       an optional package is not installed (also an ImportError)

ModelWarning                a model was read without a part, or with a repaired one (a UserWarning)
DefectError                 a defect of octex: it made inconsistent parts from valid input
"""

from __future__ import annotations

from enum import IntEnum
from typing import Self


class ExitCode(IntEnum):
    """The exit codes of all octex commands."""

    meaning: str

    def __new__(cls, value: int, meaning: str) -> Self:
        """Make a number with a meaning."""
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
    TERMINATED = 143, "ended by SIGTERM"


class OctexError(Exception):
    """Base of all errors that octex raises on purpose."""


class InputError(OctexError):
    """Input to octex cannot be used."""


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
    """A file could not be written; no existing file was changed."""


class MissingExtraError(OctexError, ImportError):
    """An optional dependency is needed; the message names the extra to install."""

    @classmethod
    def needed(cls, what: str, package: str, extra: str) -> Self:
        """Return the error for a purpose that needs a package that is not installed."""
        return cls(f"{what}, {package} is needed; install it: pip install 'octex[{extra}]'")


class ModelWarning(UserWarning):
    """A model was read without one of its parts, or with a repaired one."""


class DefectError(Exception):
    """Octex made inconsistent parts from valid input: a defect."""


def damaged(fault: str) -> ModelError:
    """Return the error for a fault of a file that only another export can repair."""
    return ModelError(f"{fault}; export it again")
