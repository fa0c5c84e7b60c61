"""An extension of mkdocstrings: lists for the tables of parameters in docstrings, and exported names."""

from __future__ import annotations

import re
from typing import Any

import griffe

from octex import _HOMES

#: By path: the names of objects that octex exports under other names.
EXPORTED = {".".join(home): name for name, home in _HOMES.items() if home[1] != name}
ROW = re.compile(r"^(\w+(?:, \w+)*) {2,}(\S.*)$")


def with_lists(text: str) -> str:
    """Return a docstring as Markdown: `name   text` and the deeper lines after it are one item of a list."""
    lines: list[str] = []
    for line in text.splitlines():
        row = ROW.match(line)
        if row:
            lines += [] if lines and lines[-1].startswith(("- ", "  ")) else [""]
            lines.append(f"- `{row[1]}`: {row[2]}")
        elif line.startswith("      ") and lines and lines[-1].startswith(("- ", "  ")):
            lines.append(f"  {line.strip()}")
        else:
            lines.append(line)
    return "\n".join(lines)


class Parameters(griffe.Extension):
    """Rewrites each docstring as it is read, and names objects as octex exports them."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite an object's docstring."""
        if obj.docstring:
            obj.docstring.value = with_lists(obj.docstring.value)

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Name objects as octex exports them."""
        for path, name in EXPORTED.items():
            pkg[path.split(".", 1)[1]].name = name
