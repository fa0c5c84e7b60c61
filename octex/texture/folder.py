"""The folder of a texture set: an .octex file for each part, and an index of them.

    set.json    {"format": "octex set", "format_version": 1,
                 "parts": {name: file, …}, "provenance": {name: text, …}}

Files lie in the folder itself. The index is written last: what it does not name is of no set.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeGuard

from octex import container, files
from octex.errors import OutputError, TextureFileError
from octex.texture.file import ENDING, wrong_version
from octex.texture.texture import OctreeTexture

INDEX = "set.json"
FORMAT = "octex set"
FORMAT_VERSION = 1
_LONGEST_NAME = 100
# Windows keeps these names for itself, whatever their ending.
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\.|$)", re.IGNORECASE)


def read_index(folder: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Read the index of a folder: the names of its files, which must be there, by part; and the provenance.

    Raises TextureFileError for an index that is missing, damaged or newer, and for a file that is missing or
    lies elsewhere.
    """
    path = folder / INDEX
    try:
        text = files.read_bytes(path)
    except (FileNotFoundError, NotADirectoryError):
        raise TextureFileError(f"{folder}: is not the folder of a texture set: it has no {INDEX}") from None
    except OSError as error:
        raise TextureFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    try:
        content = json.loads(text, object_pairs_hook=container.without_duplicates)
    except (ValueError, RecursionError) as error:
        raise TextureFileError(f"{path}: is not JSON ({error}): copy or make the set again") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise TextureFileError(f"{path}: is not the index of a texture set")
    version = content.get("format_version")
    if type(version) is not int or version != FORMAT_VERSION:
        fault = wrong_version(repr(version))
        raise TextureFileError(f"{path}: has format version {version!r}, {fault}")
    parts, metadata = content.get("parts"), content.get("provenance")
    if not (_are_texts(parts) and parts and all(parts) and _are_texts(metadata)):
        raise TextureFileError(f"{path}: its parts or its provenance are damaged; make the set again")
    for name, file in parts.items():
        # Whatever the system, no file of a set leads out of its folder.
        if not file.lower().endswith(ENDING) or re.search(r"[/\\:\0]", file):
            raise TextureFileError(
                f"{path}: part {name!r} is in {file!r}, which is not an {ENDING} file next to it"
            )
        if not (folder / file).is_file():
            raise TextureFileError(
                f"{folder / file}: the file of part {name!r} is missing; copy the folder again"
            )
    return parts, metadata


def _are_texts(value: Any) -> TypeGuard[dict[str, str]]:
    return isinstance(value, dict) and all(isinstance(text, str) for text in value.values())


def write_folder(folder: Path, textures: Mapping[str, OctreeTexture], metadata: Mapping[str, str]) -> None:
    """Write a file for each part, then the index, then remove the files of the set that was there.

    Raises OutputError if that cannot be done; an older set in the folder is then as it was.
    """
    old = _files_there(folder)
    is_new = not os.path.lexists(folder)
    written: dict[str, str] = {}

    def undo() -> None:
        """Remove the files that no index names, neither that of an older set nor that of this one."""
        with contextlib.suppress(OSError, OutputError):
            kept = _files_there(folder)
            for file_name in set(written.values()) - kept:
                (folder / file_name).unlink(missing_ok=True)
            if is_new and not kept:
                folder.rmdir()

    try:
        with files.undone_on_failure(undo):
            folder.mkdir(exist_ok=True)
            taken = {path.name.lower() for path in folder.iterdir()}
            for name, texture in textures.items():
                written[name] = _free_name(name, taken)
                texture.save(folder / written[name])
            index = {
                "format": FORMAT,
                "format_version": FORMAT_VERSION,
                "parts": written,
                "provenance": dict(metadata),
            }
            with files.replacing(folder / INDEX) as file:
                file.write(json.dumps(index, indent=1).encode() + b"\n")
    except OSError as error:
        raise OutputError(
            f"{folder}: cannot be written: {error.strerror or error}; choose another place"
        ) from error
    for file_name in old - set(written.values()):
        with contextlib.suppress(OSError):  # open elsewhere, which some systems forbid; it is of no set now
            (folder / file_name).unlink()


def _files_there(folder: Path) -> set[str]:
    """Return the files of the set that a folder holds; raises OutputError for an index that is no set's."""
    if not os.path.lexists(folder / INDEX):
        return set()
    try:
        return set(read_index(folder)[0].values())
    except TextureFileError as error:
        raise OutputError(f"{error}; remove {INDEX}, or choose another folder") from error


def _free_name(part: str, taken: set[str]) -> str:
    """Return a file's name for a part, that no file has, whether or not the system tells case apart."""
    base = re.sub(r"[^A-Za-z0-9._-]+", "-", part)[:_LONGEST_NAME].strip("-.") or "part"
    if _RESERVED.match(base):
        base = f"part-{base}"
    name, number = f"{base}{ENDING}", 1
    while name.lower() in taken:
        number += 1
        name = f"{base}-{number}{ENDING}"
    taken.add(name.lower())
    return name
