"""The pages of ``octex help`` and of the documentation site: NAME.md, which begins with its title."""

from __future__ import annotations

import re
import textwrap
from difflib import get_close_matches
from importlib.resources import files

from octex.errors import ArgumentError

#: The names of all pages by group, in the order in which a reader may want them.
GROUPS = {
    "start": "tutorial concepts",
    "tasks": (
        "convert page render no-uvs paint-browser paint-view paint-python photographs bake finish print "
        "blender three arrays"
    ),
    "reference": (
        "commands models surfaces channels lookups filters adaptive parts previews viewer painting cameras "
        "processing baking ptex files large remote"
    ),
    "about": "figures limits contributing changelog",
}
#: The longest line of text on a terminal; some in the sources are longer.
_WIDTH = 130
TOPICS = tuple(name for names in GROUPS.values() for name in names.split())


def topic(name: str) -> str:
    """Return a page as text for a terminal: code is indented, images are left out.

    Raises ArgumentError for an unknown name.
    """
    if name not in TOPICS:
        near = [each for each in TOPICS if name.startswith(each)] or get_close_matches(name, TOPICS, 1)
        hint = f"do you mean {near[0]!r}? octex help lists all" if near else f"there are {', '.join(TOPICS)}"
        raise ArgumentError(f"there is no page on {name!r}; {hint}")
    text = (files(__name__) / f"{name}.md").read_text("utf-8").rstrip()
    text = re.sub(r"```\w+\n(.*?)```\n?", _indented, text, flags=re.DOTALL)
    return "\n\n".join(_wrapped(each) for each in text.split("\n\n") if not each.startswith("!["))


def _wrapped(paragraph: str) -> str:
    """Wrap the lines of a paragraph that are too long; those of titles, tables and code stay."""
    if re.match(r"#|\||    ", paragraph):
        return paragraph
    lines = paragraph.splitlines()
    return "\n".join(
        textwrap.fill(line, _WIDTH, subsequent_indent="  " * line.startswith("* ")) for line in lines
    )


def _indented(block: re.Match[str]) -> str:
    return re.sub(r"^(?=.)", "    ", block[1], flags=re.MULTILINE)
