"""Types of arguments as text: ``uint8:2C`` is an array of two axes in C order."""

from __future__ import annotations

import re
from importlib import import_module
from typing import Any

from numba import types

_ARRAY = re.compile(r"(\w+):(\d+)([ACF])")


def types_text(arguments: Any) -> str:
    """Return the names of the types of arguments."""
    return ", ".join(map(_type_text, arguments))


def _type_text(kind: Any) -> str:
    if isinstance(kind, types.Array):
        return f"{kind.dtype}:{kind.ndim}{kind.layout}"
    if not isinstance(kind, types.BaseTuple):
        return str(kind)
    of = getattr(kind, "instance_class", tuple)
    return f"{of.__module__}.{of.__qualname__}({types_text(kind.types)})"


def read_types(text: str) -> tuple[Any, ...]:
    """Return the types that a text of ``types_text`` names; raises an error for unknown ones."""
    found, start, depth = [], 0, 0
    for end, letter in enumerate(f"{text}," if text else ""):
        depth += (letter == "(") - (letter == ")")
        if letter == "," and depth == 0:
            found.append(_read_type(text[start:end].strip()))
            start = end + 1
    return tuple(found)


def _read_type(text: str) -> Any:
    array = _ARRAY.fullmatch(text)
    if array is not None:
        dtype, dimensions, layout = array.groups()
        return types.Array(_read_type(dtype), int(dimensions), layout)
    if not text.endswith(")"):
        return types.boolean if text == "bool" else getattr(types, text)
    name, _, inner = text[:-1].partition("(")
    module, _, name = name.rpartition(".")
    of, within = getattr(import_module(module), name), read_types(inner)
    if len(getattr(of, "_fields", within)) != len(within):
        raise ValueError(f"{of} has not {len(within)} fields")
    return types.BaseTuple.from_types(within, None if of is tuple else of)
