"""Settings of the whole process, changed for a moment by one thread at a time."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

_one = threading.RLock()


@contextmanager
def alone() -> Iterator[None]:
    """Let a block change the warning filters, or another library's globals that it sets back itself.

    Two threads that did so at once would restore each other's changes and leave them behind.
    """
    with _one, warnings.catch_warnings():
        yield
