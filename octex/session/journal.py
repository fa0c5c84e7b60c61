"""The journal of a session: all commands in order, so that a crash loses nothing."""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from octex.conversion.large import digest_of
from octex.errors import OutputError
from octex.source.motion import Motion
from octex.source.surface import Surface
from octex.texture import OctreeTexture

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

_ENDING = ".strokes"
_HEAD = struct.Struct("<II")  # of each record: size in bytes, CRC-32
_VERSION = 1


class Journal:
    """A file next to OUTPUT with records, each after its size and checksum; the first identifies the inputs.

    A record that a crash cut off is ignored.
    """

    def __init__(
        self, output: Path, texture: OctreeTexture, surface: Surface, motion: Motion | None = None
    ) -> None:
        self.path = output.with_name(output.name + _ENDING)
        channels = [(name, *channel[1:]) for name, channel in sorted(texture.channels.items())]
        tree = texture.tree
        made_of = [[*tree.arrays], [*tree.split], [*tree.kept], channels, str(texture.placement)]
        model = [surface.vertices, surface.rest, surface.triangles, *(motion or ())]
        head = {
            "octex_strokes": _VERSION,
            "texture": digest_of(made_of).hex(),
            "model": digest_of(model).hex(),
        }
        self._head = json.dumps(head).encode()
        self._file = -1

    def begin(self, recover: bool) -> list[bytes]:
        """Open and lock the file; return its records.

        Raises OutputError if the file cannot be written, another process has locked it, or it belongs to
        another texture or model; also for existing records unless ``recover``.
        """
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o600)
            if fcntl is not None:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with os.fdopen(os.dup(self._file), "rb") as file:
                content = file.read()
        except BlockingIOError:
            os.close(self._file)
            self._file = -1
            raise OutputError(f"{self.path}: another octex view paints this file; close it first") from None
        except OSError as error:
            raise OutputError(f"{self.path}: {error.strerror or error}") from None
        head, *records = [*_records(content)] or [b""]
        if records and not recover:
            noun, pronoun = (
                ("command that was", "it") if len(records) == 1 else ("commands that were", "them")
            )
            raise OutputError(
                f"{self.path} has {len(records)} {noun} not saved; --recover paints {pronoun} again, "
                "or delete the file"
            )
        if records and head != self._head:
            raise OutputError(
                f"{self.path} is of another texture or model; give the painted ones, or delete it"
            )
        if not records:
            os.ftruncate(self._file, 0)
            self._end = 0
            self.append(self._head)
        else:
            self._end = sum(_HEAD.size + len(each) for each in (head, *records))
            os.ftruncate(self._file, self._end)
        return records

    def append(self, record: bytes) -> None:
        """Write a record and wait for the disk; on OutputError the file is unchanged."""
        data = _HEAD.pack(len(record), zlib.crc32(record)) + record
        try:
            os.lseek(self._file, self._end, os.SEEK_SET)
            remaining = memoryview(data)
            while remaining:
                remaining = remaining[os.write(self._file, remaining) :]
            os.fsync(self._file)
        except OSError as error:
            os.ftruncate(self._file, self._end)
            raise OutputError(f"{self.path}: {error.strerror or error}") from None
        self._end += len(data)

    def close(self, *, remove: bool) -> None:
        """Close the file; remove it if everything is saved."""
        if self._file >= 0:
            if remove:
                self.path.unlink(missing_ok=True)
            os.close(self._file)
            self._file = -1

    @contextmanager
    def undone_on_failure(self) -> Iterator[None]:
        """Close the file if the block fails."""
        try:
            yield
        except BaseException:
            self.close(remove=False)
            raise


def layers_file(output: Path) -> Path:
    """Return the path of a session's layers file, next to its output."""
    return output.with_name(f"{output.stem}.layers.octex")


def _records(content: bytes) -> Iterator[bytes]:
    at = 0
    while at + _HEAD.size <= len(content):
        length, check = _HEAD.unpack_from(content, at)
        record = content[at + _HEAD.size : at + _HEAD.size + length]
        if len(record) < length or zlib.crc32(record) != check:
            return
        yield record
        at += _HEAD.size + length
