"""Files that the command line names: on this machine, or, of textures, at an address."""

from __future__ import annotations

import argparse
import errno
import os
import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import NoReturn

from octex.errors import ArgumentError
from octex.files import is_address

TEXTURE_ENDING = ".octex"
ARCHIVE_ENDING = ".octz"
TEXTURE_ENDINGS = TEXTURE_ENDING, ARCHIVE_ENDING
_READ_THERE = f"only textures, NAME{' and NAME'.join(TEXTURE_ENDINGS)}, are read from one"


@dataclass(frozen=True)
class Address:
    """A texture elsewhere, where commands expect a path."""

    text: str

    def __str__(self) -> str:
        return self.text

    def __fspath__(self) -> str:
        return self.text

    @property
    def name(self) -> str:
        """The file's name, without what a server is asked beside it."""
        names = [PurePosixPath(re.split("[?#]", part)[0]).name for part in self.text.split("::")]
        return next((name for name in names if _is_texture(name)), names[-1])

    @property
    def suffix(self) -> str:
        """The ending of that."""
        return PurePosixPath(self.name).suffix

    def exists(self) -> bool:
        """Say that it is there: who opens it finds out."""
        return True

    def is_dir(self) -> bool:
        """Say that it is no folder."""
        return False

    def stat(self) -> NoReturn:
        """Raise FileNotFoundError: it is no file of this machine."""
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), self.text)


def texture_file(text: str) -> Path | Address:
    """Read the name of what may be a texture, or its address."""
    if not is_address(text):
        return Path(text)
    address = Address(text)
    if not _is_texture(address.name):
        raise argparse.ArgumentTypeError(f"{text} is an address; {_READ_THERE}: download it first")
    return address


def check_texture(path: Path | Address) -> None:
    """Refuse what is no texture by its ending."""
    if path.suffix.lower() not in TEXTURE_ENDINGS:
        raise ArgumentError(f"{path}: is no {TEXTURE_ENDING} file; octex convert makes one of a model")


def file_here(text: str) -> Path:
    """Read the name of a file that is read on this machine."""
    if is_address(text):
        raise argparse.ArgumentTypeError(
            f"{text} is an address, and this file is read here: download it first"
        )
    return Path(text)


def output_file(text: str) -> Path:
    """Read the name of a file that is written, or of a folder."""
    if is_address(text):
        raise argparse.ArgumentTypeError(
            f"{text} is an address, and octex writes files of this machine; write one, and upload it"
        )
    return Path(text)


def _is_texture(name: str) -> bool:
    return name.lower().endswith(TEXTURE_ENDINGS)
