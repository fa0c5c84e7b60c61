"""octex: one command for all, whose first word says what is done."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Sequence
from difflib import get_close_matches

import octex
from octex.cli import bake, convert, paint, viewer
from octex.cli.bake import BAKE
from octex.cli.common import run, say
from octex.cli.convert_options import COMMANDS
from octex.cli.paint_options import PAINT
from octex.cli.parser import Command
from octex.cli.viewer import VIEW
from octex.docs import TOPICS, topic
from octex.errors import ArgumentError, ExitCode

PROGRAM = "octex"
#: All commands but help.
EVERY: dict[str, Command] = {**COMMANDS, "paint": PAINT, "bake": BAKE, "view": VIEW}
_ORDER = (
    "convert",
    "view",
    "paint",
    "bake",
    "edit",
    "info",
    "diff",
    "validate",
    "overlaps",
    "warm-up",
    "help",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the first word asks for, and return its exit code (octex.errors.ExitCode)."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    first, rest = (words[0], words[1:]) if words else ("", [])
    if first in COMMANDS:
        return convert.main(rest, f"{PROGRAM} {first}", first)
    if first == "paint":
        return paint.main(rest, f"{PROGRAM} paint")
    if first == "bake":
        return bake.main(rest, f"{PROGRAM} bake")
    if first == "view":
        return viewer.main(rest, f"{PROGRAM} view")
    return run(PROGRAM, lambda: _answer(first, rest))


def _answer(first: str, rest: Sequence[str]) -> int:
    if first in ("-h", "--help", "--help-all") or (first == "help" and not rest):
        say(_overview())
    elif first == "--version":
        say(f"{PROGRAM} {octex.__version__}")
    elif first == "help":
        for name in rest:
            if name in EVERY and name not in TOPICS:
                return main([name, "--help-all"])
            say(topic(name))
    else:
        raise ArgumentError(_unknown(first))
    return ExitCode.DONE


def _unknown(word: str) -> str:
    known = f"the commands are {', '.join(_ORDER)}; see {PROGRAM} --help"
    if not word:
        return f"a command is missing: {known}"
    if word.startswith("-"):
        return f"{word} stands before the command: {known}"
    near = get_close_matches(word, _ORDER, 1)
    return f"{word!r} is no command{f', do you mean {near[0]!r}' if near else ''}: {known}"


def _overview() -> str:
    summaries = {name: each.summary for name, each in EVERY.items()}
    summaries["help"] = "Print a page on a topic."
    lines = [
        f"usage: {PROGRAM} COMMAND … [options]",
        "",
        "Octree textures: colour a model without UVs.",
        "",
        *(f"  {name:9} {summaries[name]}" for name in _ORDER),
        "",
        f"{PROGRAM} COMMAND --help shows common options and examples, --help-all every option;",
        f"{PROGRAM} help TOPIC prints one of these pages:",
        *textwrap.wrap(f"{', '.join(TOPICS)}.", 100, initial_indent="  ", subsequent_indent="  "),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
