"""Commands as tables of options, from which both what is parsed and what --help shows are made."""

from __future__ import annotations

import argparse
import shutil
import sys
import textwrap
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, NamedTuple, NoReturn

import octex
from octex.cli.arguments import count
from octex.cli.common import say
from octex.errors import ArgumentError, ExitCode

_WIDEST = 110  # columns of help
_ALIKE = 0.8  # difflib's ratio, from which on a word may be meant for an option


class Option(NamedTuple):
    """A word of the command line, "--depth", or a file that stands alone, "INPUT"."""

    word: str
    settings: Mapping[str, Any]  # as argparse takes them

    @property
    def usage(self) -> str:
        """The word with its values, as a usage line has it."""
        metavar = self.settings.get("metavar")
        values = " ".join(metavar) if isinstance(metavar, tuple) else metavar
        if not self.word.startswith("-"):
            alone = str(values or self.word)
            return f"[{alone} ...]" if self.settings.get("nargs") == "*" else alone
        return self.word if values is None else f"{self.word} {values}"


def option(word: str, help: str, **settings: Any) -> Option:
    """Describe an option by argparse's settings."""
    return Option(word, {**settings, "help": help})


#: How any command works, and what it prints.
RUNNING = (
    option("--force", "overwrite existing files", action="store_true"),
    option("--threads", "number of threads (default: all processors)", metavar="N", type=count),
    option("--quiet", "print only errors (and the result of --json)", action="store_true"),
    option("--json", "print the result as one JSON object", action="store_true"),
)


class Command(NamedTuple):
    """What one command does, and the words that it takes."""

    summary: str
    files: Sequence[Option]
    options: Sequence[Option]
    examples: Sequence[str]  # what stands behind the command's name
    usual: Collection[str] = ()  # the options that the first screen of help lists; none: all
    usages: Sequence[Sequence[str]] = ()  # the words of each thing that it does; none: the files

    def has(self, word: str) -> bool:
        """Say whether a word is an option of the command."""
        return any(each.word == word for each in self.options)


class Parser(argparse.ArgumentParser):
    """An argument parser that refuses in one line and knows no abbreviations; its help has two sizes.

    Options may stand before, between and behind the files.
    """

    def __init__(self, program: str, command: Command) -> None:
        super().__init__(prog=program, allow_abbrev=False, add_help=False)
        self._command = command
        for each in (*command.files, *command.options):
            self.add_argument(each.word, **each.settings)
        self.add_argument("-h", "--help", action=_Help, help="show a screen of help")
        self.add_argument("--help-all", action=_Help, help="show every option, and the exit codes")
        version = f"{program} {octex.__version__}"
        self.add_argument("--version", action="version", version=version, help="show octex's version")
        self._options = {word: action for action in self._actions for word in action.option_strings}

    def error(self, message: str) -> NoReturn:
        """Raise ArgumentError."""
        raise ArgumentError(f"{message.removeprefix('argument ')}; see {self.prog} --help")

    def help_text(self, every: bool = True) -> str:
        """Return all help, or the screen of it that lists the usual options."""
        command = self._command
        every = every or not command.usual
        width = min(shutil.get_terminal_size().columns, _WIDEST)
        by_word = {each.word: each for each in (*command.files, *command.options)}
        files = [each.word for each in command.files]
        shown = {*files, *(by_word if every else command.usual), "--help-all"}
        usages = [
            " ".join([self.prog, *(by_word[word].usage for word in words), "[options]"])
            for words in command.usages or [files]
            if shown.issuperset(words)
        ]
        formatter = argparse.HelpFormatter(self.prog, max_help_position=26, width=width)
        formatter.start_section("files and options" if command.files else "options")
        formatter.add_arguments(
            action
            for action in self._actions
            if every or shown.intersection(action.option_strings or [action.dest])
        )
        formatter.end_section()
        parts = [
            "usage: " + "\n       ".join(usages),
            textwrap.fill(command.summary, width),
            "\n".join(["examples:", *(f"  {self.prog} {each}".rstrip() for each in command.examples)]),
            formatter.format_help().strip(),
        ]
        if every:
            parts.append("\n".join(["exit codes:", *(f"  {code:3}  {code.meaning}" for code in ExitCode)]))
        return "\n\n".join(parts) + "\n"

    def parsed(self, arguments: Sequence[str] | None) -> argparse.Namespace:
        """Parse arguments in any order, those of the process for None; what follows -- is no option.

        A value that an option may go without is one if it is a number. Raises ArgumentError.
        """
        words = deque(sys.argv[1:] if arguments is None else arguments)
        options: list[str] = []
        files: list[str] = []
        while words:
            word = words.popleft()
            if word == "--":
                files += words
                break
            if not word.startswith("-") or word == "-":
                files.append(word)
                continue
            name = word if word in self._options else word.partition("=")[0]
            action = self._options.get(name)
            if action is None:
                self._refuse(name)
            options.append(word)
            if word != name:
                continue
            if action.nargs is None:
                if not words or words[0] in self._options:
                    self.error(f"{word} needs a value, {action.metavar}")
                options[-1] += f"={words.popleft()}"  # which may begin with a minus
            elif action.nargs == "?" and words and _is_number(words[0]):
                options[-1] += f"={words.popleft()}"
            elif isinstance(action.nargs, int):
                options += [words.popleft() for _ in range(min(action.nargs, len(words)))]
        self._check_files(files, options)
        return self.parse_args([*options, "--", *files] if files else options)

    def _refuse(self, word: str) -> NoReturn:
        """Say that a word is no option, and where it is one or what it may be meant for."""
        from octex.cli.main import EVERY

        others = [f"octex {name}" for name, each in EVERY.items() if each.has(word)]
        if others:
            self.error(f"{word} is an option of {' and of '.join(others)}, not of {self.prog}")
        near = get_close_matches(word, self._options, 1, _ALIKE)
        self.error(f"{word} is no option{f': do you mean {near[0]}' if near else ''}")

    def _check_files(self, files: Sequence[str], options: Sequence[str]) -> None:
        """Refuse too few or too many files, but for a command that only shows its help."""
        wanted = [action for action in self._actions if not action.option_strings]
        names = " ".join(str(action.metavar or action.dest) for action in wanted)
        counts = [each.nargs if isinstance(each.nargs, int) else 1 for each in wanted]
        most = sum(counts)
        if len(files) > most and all(each.nargs != "*" for each in wanted):
            self.error(f"{files[most]} is one file too many for {self.prog} {names}".rstrip())
        least = sum(count for each, count in zip(wanted, counts, strict=True) if each.nargs not in ("?", "*"))
        if len(files) < least and not {"-h", "--help", "--help-all", "--version"}.intersection(options):
            self.error(f"{names} {'are' if least > 1 else 'is'} missing")


class _Help(argparse.Action):
    """Shows help and ends the command."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str) -> None:
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help=help)

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,  # noqa: ARG002
        values: object,  # noqa: ARG002
        option_string: str | None = None,
    ) -> None:
        assert isinstance(parser, Parser)
        say(parser.help_text(every=option_string == "--help-all").rstrip())
        parser.exit()


def words_given(options: argparse.Namespace) -> list[str]:
    """Return the words on the command line that were used, as the user knows them."""
    return [
        word if word.isupper() else "--" + word.replace("_", "-")
        for word, value in vars(options).items()
        if value is not None and value is not False and value != []
    ]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
