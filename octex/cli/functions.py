"""Functions in Python files, as options name them: FILE.py:NAME."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from octex.errors import InputError


class FunctionName(NamedTuple):
    """A function in a file."""

    path: Path
    name: str

    def __str__(self) -> str:
        return f"{self.path}:{self.name}"


def function_name(text: str) -> FunctionName | None:
    """Return what FILE.py:NAME names; None for another text."""
    path, colon, name = text.rpartition(":")
    return FunctionName(Path(path), name) if colon and path.endswith(".py") and name.isidentifier() else None


def load_function(named: FunctionName) -> Callable[..., Any]:
    """Run a file and return its function.

    The file can import others in its folder, as ``python FILE.py`` lets it. Raises InputError for a file that
    cannot be read or raises, and for a name that is no function in it.
    """
    path = named.path.resolve()
    spec = importlib.util.spec_from_file_location(f"octex_functions:{path}", path)
    assert spec is not None and spec.loader is not None  # by its ending
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look their annotations up
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))  # for good: functions may import when they are called
    try:
        spec.loader.exec_module(module)
    except OSError as error:
        raise InputError(f"{named.path} cannot be read: {error.strerror or error}") from None
    except Exception as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{named.path} raised {type(error).__name__}: {reason}; mend it") from error
    function = getattr(module, named.name, None)
    if not callable(function):
        known = [name for name, each in vars(module).items() if callable(each) and not name.startswith("_")]
        raise InputError(f"{named.path} has no function {named.name}; it has {', '.join(known) or 'none'}")
    return function  # type: ignore[no-any-return]
