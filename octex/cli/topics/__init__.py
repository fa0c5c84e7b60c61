"""The pages that octex help prints: files beside this one, NAME.md, whose first line is the title."""

from __future__ import annotations

from importlib.resources import files

from octex.errors import ArgumentError

#: In the order in which a reader may want them.
TOPICS = (
    *("models", "surfaces", "viewer", "channels", "lookups", "filters", "adaptive", "parts"),
    *("pictures", "painting", "cameras", "processing", "baking", "ptex", "files", "figures"),
)


def topic(name: str) -> str:
    """Return the page on a topic; raises ArgumentError for one that there is not."""
    if name not in TOPICS:
        raise ArgumentError(f"there is no page on {name!r}; there are {', '.join(TOPICS)}")
    return (files(__name__) / f"{name}.md").read_text("utf-8").rstrip()
