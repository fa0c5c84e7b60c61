"""octex: one program, whose first word names the command."""

from __future__ import annotations

import sys
import textwrap
import time
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module

import octex
from octex.cli.common import limited, run, say
from octex.cli.options import COMMANDS
from octex.cli.parser import Parser
from octex.docs import TOPICS, topic
from octex.errors import ArgumentError, ExitCode

PROGRAM = "octex"
#: The module of each command; its function of the same name runs the command.
_MODULES = {
    **dict.fromkeys(("info", "diff", "validate", "overlaps", "warm-up"), "inspect"),
    "edit": "convert",
}
_NAMES = (*COMMANDS, "help")


def main(arguments: Sequence[str] | None = None, program: str | None = None) -> int:
    """Run the command that the first word names, and return its exit code (octex.errors.ExitCode)."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    name, rest = (words[0], words[1:]) if words else ("", [])
    program = program or (f"{PROGRAM} {name}" if name in COMMANDS else PROGRAM)
    return run(program, lambda: _run(name, rest, program))


def _run(name: str, rest: Sequence[str], program: str) -> int:
    if name not in COMMANDS:
        return _answer(name, rest)
    began = time.perf_counter()
    options = Parser(program, COMMANDS[name], COMMANDS).parsed(rest)
    options.began = began
    module = import_module(f"octex.cli.{_MODULES.get(name, name)}")
    with limited(getattr(options, "threads", None)):
        try:
            code: int = getattr(module, name.replace("-", "_"))(options, program)
        except ArgumentError as error:
            parameter, must, limits = str(error).partition(" must ")
            option = f"--{parameter.replace('_', '-')}"
            if not must or not COMMANDS[name].has(option):
                raise
            raise ArgumentError(f"{option}{must}{limits}") from error
    return code


def _answer(first: str, rest: Sequence[str]) -> int:
    if first in ("-h", "--help") or (first == "help" and rest[:1] in ([], ["-h"], ["--help"])):
        say(_overview())
    elif first == "--version":
        say(f"{PROGRAM} {octex.__version__}")
    elif first == "help":
        for name in rest:
            if name in COMMANDS and name not in TOPICS:
                say(Parser(f"{PROGRAM} {name}", COMMANDS[name], COMMANDS).help())
            else:
                say(topic(name))
    else:
        similar = get_close_matches(first, _NAMES, 1)
        fault = f"{first!r} is not a command{f', do you mean {similar[0]!r}' if similar else ''}"
        if not first or first.startswith("-"):
            fault = f"{first} stands before the command" if first else "a command is missing"
        raise ArgumentError(f"{fault}: the commands are {', '.join(_NAMES)}; see {PROGRAM} --help")
    return ExitCode.DONE


def _overview() -> str:
    summaries = {name: each.summary.partition(". ")[0].rstrip(".") + "." for name, each in COMMANDS.items()}
    summaries["help"] = "Print a page on a topic, or the help of a command."
    lines = [
        f"usage: {PROGRAM} COMMAND … [options]",
        "",
        "Octree textures: colour a model without UVs.",
        "",
        *(f"  {name:9} {summaries[name]}" for name in _NAMES),
        "",
        f"{PROGRAM} COMMAND --help shows a command's options; {PROGRAM} help TOPIC prints one of:",
        *textwrap.wrap(f"{', '.join(TOPICS)}.", 100, initial_indent="  ", subsequent_indent="  "),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
