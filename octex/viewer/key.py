"""A secret of this user, which makes addresses that stay the same and that others cannot guess."""

from __future__ import annotations

import os
import secrets
import tempfile
from pathlib import Path

_BYTES = 32


def user_key() -> bytes:
    """Return this user's secret, made at the first call; empty where other users could read it."""
    try:
        path = _folder() / "viewer.key"
        return _read(path) or _write_new(path)
    except (OSError, RuntimeError):  # no folder to store it in
        return b""


def _folder() -> Path:
    variable = os.environ.get("XDG_STATE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(variable) if variable else Path.home() / ".local" / "state") / "octex"


def _read(path: Path) -> bytes:
    """Return a file's secret; empty for a damaged file, and for one that others own or can read."""
    try:
        with path.open("rb") as file:
            status, secret = os.fstat(file.fileno()), file.read(_BYTES + 1)
    except FileNotFoundError:
        return b""
    if os.name == "posix" and (status.st_uid != os.getuid() or status.st_mode & 0o077):
        return b""
    return secret if len(secret) == _BYTES else b""


def _write_new(path: Path) -> bytes:
    """Write a new secret that only this user can read."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    secret = secrets.token_bytes(_BYTES)
    descriptor, name = tempfile.mkstemp(dir=path.parent)  # readable by its owner only
    with os.fdopen(descriptor, "wb") as file:
        file.write(secret)
    Path(name).replace(path)
    return secret
