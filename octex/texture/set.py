"""TextureSet: parts of a model with textures of their own (paper 4.3.1); and its folder.

The folder has an .octex file for each part, and an index of them, which is written last:

    set.json    {"format": "octex set", "format_version": 1,
                 "parts": {name: file, …}, "provenance": {name: text, …}}
"""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, Unpack, overload

import numpy as np
import numpy.typing as npt

from octex import container, files
from octex.arrays import Array, Bools, Float32s, Int64s
from octex.checks import as_array, as_choice, as_entries, as_flag, as_path
from octex.errors import ArgumentError, OutputError, TextureFileError
from octex.field.field import NotFiniteError
from octex.parallel import Run, as_run
from octex.texture.file import ENDING, are_texts, wrong_version
from octex.texture.lookup import (
    Answers,
    FootprintOptions,
    Inputs,
    LookUp,
    LookupOptions,
    Names,
    Request,
    SurfacePoints,
    checked_request,
    in_blocks,
    points_with_normals,
)
from octex.texture.open import open_texture
from octex.texture.texture import OctreeTexture, as_metadata

#: Number of parts that `repr` names.
_SHOWN = 5


class TextureSet(Mapping[str, OctreeTexture]):
    """Textures for the parts of a model, by name and in order.

    Parts that intersect or nearly touch would share the cells of one texture, and their colours would mix
    (Benson & Davis 2002, 4.3.1). Parts also have numbers, from 0. A set is immutable; a part's file is opened
    when it is first needed. ``metadata`` is provenance, as for a texture.

    Raises ArgumentError for an empty set, for names that are not text, and for anything but textures.
    """

    def __init__(
        self, textures: Mapping[str, OctreeTexture], metadata: Mapping[str, str] | None = None
    ) -> None:
        parts = as_entries(textures, "parts")
        if not parts:
            raise ArgumentError("a texture set needs at least one part")
        for name, texture in parts.items():
            if not name:
                raise ArgumentError(f"parts must have names, not {name!r}")
            if not isinstance(texture, OctreeTexture):
                raise ArgumentError(f"part {name!r} must be an OctreeTexture, not {type(texture).__name__}")
        self.metadata = MappingProxyType(as_metadata(metadata))
        self._textures: dict[str, OctreeTexture | Path] = dict(parts)
        self.names = tuple(self._textures)

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> TextureSet:
        """Open the folder of a set. Reads the index; each part's file is opened when it is needed.

        Raises TextureFileError for an index that is missing, damaged or of a newer version, and for missing
        or damaged files.
        """
        folder = as_path(folder, "folder")
        files, metadata = read_index(folder)
        texture_set = cls.__new__(cls)
        texture_set.metadata = MappingProxyType(metadata)
        texture_set._textures = {name: folder / file for name, file in files.items()}
        texture_set.names = tuple(texture_set._textures)
        return texture_set

    def __reduce__(self) -> tuple[Any, ...]:
        return TextureSet, (dict(self), dict(self.metadata))

    def __getitem__(self, name: str) -> OctreeTexture:
        texture = self._textures[name]
        if isinstance(texture, Path):
            texture = self._textures[name] = open_texture(texture)
        return texture

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        more = f" and {len(self) - _SHOWN} more" if len(self) > _SHOWN else ""
        count = f"{len(self)} part{'' if len(self) == 1 else 's'}"
        return f"<TextureSet of {count}: {', '.join(self.names[:_SHOWN])}{more}>"

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays of all textures."""
        return sum(texture.nbytes for texture in self.values())

    @overload
    def sample(
        self,
        points: npt.ArrayLike | SurfacePoints,
        parts: npt.ArrayLike,
        channel: str = "base_color",
        filter: str = "quadratic",
        *,
        gradient: Literal[False] = False,
        out: Float32s | None = None,
        **options: Unpack[LookupOptions],
    ) -> Float32s: ...
    @overload
    def sample(
        self,
        points: npt.ArrayLike | SurfacePoints,
        parts: npt.ArrayLike,
        channel: list[str] | tuple[str, ...],
        filter: str = "quadratic",
        *,
        gradient: Literal[False] = False,
        out: Mapping[str, Float32s] | None = None,
        **options: Unpack[LookupOptions],
    ) -> dict[str, Float32s]: ...
    @overload
    def sample(
        self,
        points: npt.ArrayLike | SurfacePoints,
        parts: npt.ArrayLike,
        channel: str = "base_color",
        filter: str = "quadratic",
        *,
        gradient: Literal[True],
        out: tuple[Float32s, Float32s] | None = None,
        **options: Unpack[LookupOptions],
    ) -> tuple[Float32s, Float32s]: ...
    @overload
    def sample(
        self,
        points: npt.ArrayLike | SurfacePoints,
        parts: npt.ArrayLike,
        channel: list[str] | tuple[str, ...],
        filter: str = "quadratic",
        *,
        gradient: Literal[True],
        out: tuple[Mapping[str, Float32s], Mapping[str, Float32s]] | None = None,
        **options: Unpack[LookupOptions],
    ) -> tuple[dict[str, Float32s], dict[str, Float32s]]: ...
    def sample(
        self,
        points: npt.ArrayLike | SurfacePoints,
        parts: npt.ArrayLike,
        channel: Names = "base_color",
        filter: str = "quadratic",
        *,
        gradient: bool = False,
        out: Any = None,
        normalize: bool = True,
        threads: int | None = None,
        run: Run | None = None,
        **options: Unpack[FootprintOptions],
    ) -> Any:
        """Sample rest positions (n, 3), or points of a surface, each in the texture of its part.

        ``parts`` are numbers or names: (n,), or one for all points. All other arguments are those of
        ``OctreeTexture.sample``, and so is the result.

        Raises ArgumentError as ``OctreeTexture.sample`` does, for unknown parts, and for a channel that a
        part lacks or has with other components.
        """
        gradient, normalize = as_flag(gradient, "gradient"), as_flag(normalize, "normalize")
        request = checked_request(points, channel, filter, gradient, **options)
        numbers = self._numbers(parts, len(request.inputs["points"]))
        inputs = {**request.inputs, "parts": numbers}
        components = self._components(np.flatnonzero(np.bincount(numbers)).tolist() or [0], channel)
        answers = Answers(components, channel, inputs, gradient, out)
        request = Request(inputs, answers.channels, request.settings)
        look_ups = {
            part: partial(texture._lookups.look_up, answers.channels, request.settings, normalize)
            for part, texture in self._ready_for(request)
        }
        in_blocks(inputs, answers.arrays, partial(_by_part, look_ups), as_run(run, threads))
        return answers.returned

    def contains(
        self,
        points: npt.ArrayLike | SurfacePoints,
        parts: npt.ArrayLike,
        *,
        threads: int | None = None,
        run: Run | None = None,
    ) -> Bools:
        """Return for each rest position (n, 3) whether a leaf of its part's texture holds it.

        ``parts`` are as for ``sample``; ``run`` says how to work (octex.Run). Raises ArgumentError for
        positions that are not finite (n, 3), and for unknown parts.
        """
        inputs = {"points": points_with_normals(points)[0]}
        inputs["parts"] = self._numbers(parts, len(inputs["points"]))
        inside = np.empty(len(inputs["points"]), np.bool_)
        look_ups = {part: texture._lookups.contain for part, texture in self._ready_for(Request(inputs))}
        in_blocks(inputs, [inside], partial(_by_part, look_ups), as_run(run, threads))
        return inside

    def _ready_for(self, request: Request) -> Iterator[tuple[int, OctreeTexture]]:
        """Yield the parts in use and the textures that answer for them: see `Storage.prepare`."""
        for part, count in enumerate(np.bincount(request.inputs["parts"]).tolist()):
            if count:
                texture, part_request = self[self.names[part]], partial(_of_part, request, part)
                yield part, texture.storage.prepare(texture, count, part_request)

    def _numbers(self, parts: npt.ArrayLike, count: int) -> Int64s:
        """Return each point's part (n,) as a number, or raise ArgumentError."""
        array = as_array(parts)
        if array.shape == (0,) and count == 0:
            return np.empty(0, np.int64)
        if array.dtype.kind not in "iuUO" or array.shape not in ((), (count,)):
            raise ArgumentError(
                f"parts must be numbers or names, one for all or ({count},), not {array.dtype} {array.shape}"
            )
        if array.dtype.kind in "UO":
            numbers = {name: number for number, name in enumerate(self.names)}
            names = array.ravel().tolist()
            for name in names:
                if not isinstance(name, str) or name not in numbers:
                    as_choice(name, numbers, "part")
            array = np.array([numbers[name] for name in names], np.int64).reshape(array.shape)
        elif array.size and not 0 <= array.min() <= array.max() < len(self):
            worst = array.min() if array.min() < 0 else array.max()
            raise ArgumentError(f"there is no part {worst}; there are 0 to {len(self) - 1}: {self!r}")
        return np.broadcast_to(array.astype(np.int64, copy=False), (count,))

    def _components(self, parts: list[int], channel: Names) -> dict[str, int]:
        """Return the components of the wanted channels, which must be the same in all parts."""
        components_of: dict[str, int] = {}
        names = channel if isinstance(channel, (list, tuple)) else [channel]
        for part in parts:
            name = self.names[part]
            channels = self[name].channels
            for channel_name in names:
                as_choice(channel_name, channels, f"channel of part {name!r}:")
                components = channels[channel_name].format.components
                if components_of.setdefault(channel_name, components) != components:
                    raise ArgumentError(
                        f"channel {channel_name!r} has {components} components in part {name!r}, "
                        f"and {components_of[channel_name]} in {self.names[parts[0]]!r}; sample these parts "
                        "one by one"
                    )
        return components_of

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write a folder with an ``.octex`` file for each part and an index, ``set.json``.

        The same set gives the same bytes in a new folder. A set that the folder holds is replaced at the very
        end, and its files are removed; all other files stay.

        Raises OutputError if a file cannot be written, or if the folder's ``set.json`` is not a set's index;
        an older set then stays.
        """
        folder = as_path(folder, "folder")
        old = _files_there(folder)
        is_new = not os.path.lexists(folder)
        written: dict[str, str] = {}

        def undo() -> None:
            """Remove new files that no index names."""
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
                for name, texture in self.items():
                    written[name] = _free_name(name, taken)
                    texture.save(folder / written[name])
                index = {
                    "format": FORMAT,
                    "format_version": FORMAT_VERSION,
                    "parts": written,
                    "provenance": dict(self.metadata),
                }
                with files.replacing(folder / INDEX) as file:
                    file.write(json.dumps(index, indent=1).encode() + b"\n")
        except OSError as error:
            raise OutputError(
                f"{folder}: cannot be written: {error.strerror or error}; choose another place"
            ) from error
        for file_name in old - set(written.values()):
            with contextlib.suppress(OSError):  # some systems do not remove open files; no index names it now
                (folder / file_name).unlink()

    def validate(self) -> None:
        """Check that every part's tree is sound and all values are finite.

        Raises TextureFileError that names the first broken part and its fault.
        """
        for name in self.names:
            try:
                self[name].validate()
            except TextureFileError as error:
                raise TextureFileError(f"part {name!r}: {error}") from None

    def info(self) -> dict[str, Any]:
        """Describe the set and, by name, its ``parts`` (see ``OctreeTexture.info``), ready for JSON.

        ``bytes`` are those of the parts' files.
        """
        parts = {name: texture.info() for name, texture in self.items()}
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "parts": parts,
            "bytes": sum(each["bytes"]["total"] for each in parts.values()),
            "provenance": dict(self.metadata),
        }


def _of_part(request: Request, part: int) -> Request:
    """Return a part's question, without rows that are not finite: the lookup itself refuses these."""
    arrays = {name: array for name, array in request.inputs.items() if name != "parts"}
    is_asked = request.inputs["parts"] == part
    for array in arrays.values():
        is_asked = is_asked & np.isfinite(array.reshape(len(array), -1)).all(axis=1)
    if "width" in arrays:
        is_asked &= arrays["width"] >= 0
    return request._replace(inputs={name: array[is_asked] for name, array in arrays.items()})


def _by_part(look_ups: Mapping[int, LookUp], inputs: Inputs, answers: list[Array]) -> None:
    """Look up a block of points, each in its part's texture. Raises NotFiniteError for the first row."""
    parts = inputs["parts"].astype(np.int64)
    arrays = {name: array for name, array in inputs.items() if name != "parts"}
    order = np.argsort(parts, kind="stable")
    starts = np.flatnonzero(np.diff(parts[order]))
    if not starts.size:
        look_ups[int(parts[0])](arrays, answers)
        return
    faults = []
    for rows in np.split(order, starts + 1):
        part_inputs = {name: array[rows] for name, array in arrays.items()}
        part_answers = [np.empty((len(rows), *answer.shape[1:]), answer.dtype) for answer in answers]
        try:
            look_ups[int(parts[rows[0]])](part_inputs, part_answers)
        except NotFiniteError as error:
            faults.append(int(rows[error.row]))
        for answer, values in zip(answers, part_answers, strict=True):
            answer[rows] = values
    if faults:
        raise NotFiniteError(min(faults))


INDEX = "set.json"
FORMAT = "octex set"
FORMAT_VERSION = 1
_LONGEST_NAME = 100
# Windows reserves these names, with any ending.
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\.|$)", re.IGNORECASE)


def read_index(folder: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Read the index of a folder: file names by part, and the provenance.

    Raises TextureFileError for an index that is missing, damaged or newer, and for a file that is missing or
    lies outside the folder.
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
    if not (are_texts(parts) and parts and all(parts) and are_texts(metadata)):
        raise TextureFileError(f"{path}: its parts or its provenance are damaged; make the set again")
    for name, file in parts.items():
        # On no system may a set's file lie outside its folder.
        if not file.lower().endswith(ENDING) or re.search(r"[/\\:\0]", file):
            raise TextureFileError(
                f"{path}: part {name!r} is in {file!r}, which is not an {ENDING} file next to it"
            )
        if not (folder / file).is_file():
            raise TextureFileError(
                f"{folder / file}: the file of part {name!r} is missing; copy the folder again"
            )
    return dict(parts), dict(metadata)


def _files_there(folder: Path) -> set[str]:
    """Return the files of the set in a folder; raises OutputError for an index of anything else."""
    if not os.path.lexists(folder / INDEX):
        return set()
    try:
        return set(read_index(folder)[0].values())
    except TextureFileError as error:
        raise OutputError(f"{error}; remove {INDEX}, or choose another folder") from error


def _free_name(part: str, taken: set[str]) -> str:
    """Return an unused file name for a part, also where the system ignores case."""
    base = re.sub(r"[^A-Za-z0-9._-]+", "-", part)[:_LONGEST_NAME].strip("-.") or "part"
    if _RESERVED.match(base):
        base = f"part-{base}"
    name, number = f"{base}{ENDING}", 1
    while name.lower() in taken:
        number += 1
        name = f"{base}-{number}{ENDING}"
    taken.add(name.lower())
    return name
