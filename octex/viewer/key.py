"""A secret of this user, from which addresses are made that stay the same and that nobody else can guess."""

from __future__ import annotations

import os
import secrets
import tempfile
from pathlib import Path

_BYTES = 32


def user_key() -> bytes:
    """Return this user's secret, made at the first call; no bytes where it cannot be kept from others."""
    try:
        path = _folder() / "viewer.key"
        return _read(path) or _made(path)
    except (OSError, RuntimeError):  # there is no place to keep it
        return b""


def _folder() -> Path:
    given = os.environ.get("XDG_STATE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(given) if given else Path.home() / ".local" / "state") / "octex"


def _read(path: Path) -> bytes:
    """Return a file's secret; no bytes for a damaged file, and for one that others own or can read."""
    try:
        with path.open("rb") as file:
            status, found = os.fstat(file.fileno()), file.read(_BYTES + 1)
    except FileNotFoundError:
        return b""
    if os.name == "posix" and (status.st_uid != os.getuid() or status.st_mode & 0o077):
        return b""
    return found if len(found) == _BYTES else b""


def _made(path: Path) -> bytes:
    """Write a new secret for this user alone."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    made = secrets.token_bytes(_BYTES)
    descriptor, name = tempfile.mkstemp(dir=path.parent)  # which only its owner can read
    with os.fdopen(descriptor, "wb") as file:
        file.write(made)
    Path(name).replace(path)
    return made
