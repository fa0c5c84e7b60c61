"""An extension of mkdocstrings: it makes lists of the aligned tables of parameters in docstrings."""

from __future__ import annotations

import re
from typing import Any

import griffe

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
    """Rewrites each docstring as it is read."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite an object's docstring."""
        if obj.docstring:
            obj.docstring.value = with_lists(obj.docstring.value)
