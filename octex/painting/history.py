"""Strokes that can be undone: the last ones in memory, those before them in a file, if asked for."""

from __future__ import annotations

import pickle
import tempfile
import weakref
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from octex.editing.draft import Change

#: What a call has changed: a Change for each layer, in order.
Stroke = tuple[Change, ...]

#: Strokes that stay in memory.
_IN_MEMORY = 4


class History:
    """A stack of strokes."""

    def __init__(self) -> None:
        self._strokes: list[Stroke] = []  # the last ones
        self._ends: list[int] = [0]  # where in the file each of those before them ends
        self._file: IO[bytes] | None = None

    def __len__(self) -> int:
        return len(self._ends) - 1 + len(self._strokes)

    def __iter__(self) -> Iterator[Stroke]:
        yield from (self._stored(number) for number in range(len(self._ends) - 1))
        yield from self._strokes

    @property
    def last(self) -> Stroke:
        """The last stroke; an empty one if there is none."""
        if self._strokes:
            return self._strokes[-1]
        return self._stored(len(self._ends) - 2) if len(self._ends) > 1 else ()

    def append(self, stroke: Stroke) -> None:
        """Put a stroke on the stack."""
        self._strokes.append(stroke)

    def pop(self) -> Stroke:
        """Take the last stroke from the stack."""
        stroke = self.last
        (self._strokes or self._ends).pop()
        return stroke

    def clear(self) -> None:
        """Take all strokes from the stack."""
        self._strokes.clear()
        del self._ends[1:]

    def store(self, folder: Path | None) -> None:
        """Write strokes but the last few to a temporary file. Raises OSError, and is then as before."""
        while len(self._strokes) > _IN_MEMORY:
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            self._file.seek(self._ends[-1])
            self._file.write(zlib.compress(pickle.dumps(self._strokes[0], 5), 1))
            self._file.flush()
            self._ends.append(self._file.tell())
            self._file.truncate()
            del self._strokes[0]

    def _stored(self, number: int) -> Stroke:
        """Return a stroke that is in the file."""
        assert self._file is not None
        begin, end = self._ends[number : number + 2]
        self._file.seek(begin)
        stroke: Stroke = pickle.loads(zlib.decompress(self._file.read(end - begin)))
        return stroke
