"""octree-convert --info and --validate: a look at what a file or a folder holds, and whether it is sound."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import octex
from octex.cli.addresses import Address
from octex.cli.common import say
from octex.cli.sets import INDEX, set_text
from octex.errors import ExitCode, TextureFileError
from octex.files import open_file

if TYPE_CHECKING:
    from octex.texture import OctreeTexture, TextureSet


def info(path: Path | Address, as_json: bool) -> int:
    """Say what a texture, or a set, holds."""
    information = _opened(path).info()
    lines = set_text if "parts" in information else _readable
    say(json.dumps(information) if as_json else "\n".join(lines(information)))
    return ExitCode.DONE


def _opened(path: Path | Address) -> OctreeTexture | TextureSet:
    return octex.TextureSet.open(path) if path.is_dir() else octex.open(str(path))


def _readable(information: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of a texture's information for a person."""
    placement, bounds, parts = (information[key] for key in ("placement", "bounds", "bytes"))
    yield f"depth       {information['depth']}, finest cells of edge {information['finest_cell']:.6g}"
    yield f"root cell   edge {placement['size']:.6g} at {triple(placement['origin'])}"
    yield f"bounds      {triple(bounds[0])} to {triple(bounds[1])}"
    longest = max((len(channel["name"]) for channel in information["channels"]), default=0)
    for number, channel in enumerate(information["channels"]):
        stored = f"{channel['components']} x {channel['dtype']:7}  {channel['space']}"
        yield f"{'' if number else 'channels':10}  {channel['name']:{longest}}  {stored}"
    yield ""
    yield f"{'level':>5} {'leaves':>15} {'nodes':>15}"
    for level in information["levels"]:
        yield f"{level['level']:5} {level['leaves']:15,} {level['nodes']:15,}"
    yield f"{'all':>5} {information['leaves']:15,} {information['nodes']:15,}"
    yield ""
    leaves = max(information["leaves"], 1)
    archive = information.get("archive", {})
    if archive:
        parts = {f"archive: {part}": size for part, size in archive.items()}
        parts |= {"archive: total": sum(archive.values()), "as .octex": information["bytes"]["total"]}
    yield f"{'part':32} {'bytes':>15} {'a leaf':>7}"
    for part, size in parts.items():
        yield f"{part:32} {size:15,} {size / leaves:7.2f}"
    if information["provenance"]:
        yield ""
    width = max(map(len, information["provenance"]), default=0)
    for name, text in information["provenance"].items():
        for number, line in enumerate(_lines(text)):
            yield f"{'' if number else name:{width}}  {line}"


def _lines(text: str) -> list[str]:
    """Return a text, or each entry of a JSON object, as lines."""
    with suppress(ValueError):
        entries = json.loads(text)
        if isinstance(entries, dict) and entries:
            return [
                f"{key}: {value if isinstance(value, str) else json.dumps(value)}"
                for key, value in entries.items()
            ]
    return [text]


def triple(numbers: Sequence[float]) -> str:
    """Return a position for a person."""
    return "(" + ", ".join(f"{number:.6g}" for number in numbers) + ")"


def validate(path: Path | Address, as_json: bool, quiet: bool) -> int:
    """Say whether a texture, or each of a set, is sound, or what is broken."""
    if isinstance(path, Address):  # what cannot be read is not broken
        from octex.remote import RemoteFile

        RemoteFile(str(path))
    else:
        with open_file(path / INDEX if path.is_dir() else path):
            pass
    broken = None
    try:
        _opened(path).validate()
    except TextureFileError as error:
        broken = str(error)
    if as_json:
        say(json.dumps({"file": str(path), "valid": broken is None, "broken": broken}))
    elif not quiet:
        say(broken or "valid")
    return ExitCode.DONE if broken is None else ExitCode.INVALID
