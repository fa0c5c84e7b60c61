"""Tables of commands and options, which define both the parser and the help."""

from __future__ import annotations

import textwrap
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple, NoReturn

import octex
from octex.cli.common import say
from octex.errors import ArgumentError

_WIDTH, _COLUMN = 100, 24  # width of help, and column of descriptions
_ALIKE = 0.8  # difflib's ratio at which help suggests an option

#: Values by name: ``options.max_error`` for --max-error, ``options.MODEL`` for a file, ``options.words`` for
#: the options on the command line. Missing ones, also of other commands, are the default, None, False or [].
Options = SimpleNamespace


def arguments(options: Options, *names: str) -> dict[str, Any]:
    """Return options as keyword arguments of the same names."""
    return {name: getattr(options, name) for name in names}


class Option(NamedTuple):
    """An option such as --depth."""

    word: str
    value: str  # its value in help, "N"; "" for a flag
    read: Callable[[str], Any] | None
    help: str
    repeats: bool = False
    default: Any = None

    @property
    def name(self) -> str:
        """The attribute of Options."""
        return self.word.removeprefix("--").replace("-", "_")

    @property
    def usage(self) -> str:
        """The word with its value."""
        return f"{self.word} {self.value}".rstrip()


class File(NamedTuple):
    """A file that a command takes as a plain word."""

    word: str
    read: Callable[[str], Any]
    help: str
    number: Literal["one", "maybe", "any"] = "one"
    fits: Callable[[str], bool] = bool  # whether a word can be this file, if it is optional

    @property
    def usage(self) -> str:
        """The word, in brackets if optional."""
        return {"one": self.word, "maybe": f"[{self.word}]", "any": f"[{self.word} ...]"}[self.number]


class Command(NamedTuple):
    """A command: its files and options."""

    name: str
    summary: str
    files: Sequence[File]
    options: Sequence[Option]
    examples: Sequence[str]  # without the command's name

    def has(self, word: str) -> bool:
        """Return whether a word is an option of the command."""
        return any(each.word == word for each in self.options)


class Parser:
    """Parses the words of a command, in any order, and refuses in one line; it accepts no abbreviations."""

    def __init__(self, program: str, command: Command, commands: Mapping[str, Command]) -> None:
        self.program = program
        self._command = command
        self._commands = commands
        self._options = {each.word: each for each in command.options}

    def help(self) -> str:
        """Return a screen of help."""
        command = self._command
        lines = [f"usage: {self.program} {' '.join([*(each.usage for each in command.files), '[options]'])}"]
        lines += ["", *textwrap.wrap(command.summary, _WIDTH), ""]
        lines += [f"  {self.program} {example}".rstrip() for example in command.examples]
        lines.append("")
        rows = [(each.word, each.help) for each in command.files]
        rows += [(each.usage, each.help) for each in command.options]
        for usage, help in rows:
            texts = textwrap.wrap(help, _WIDTH - _COLUMN)
            if len(usage) > _COLUMN - 4:
                lines.append(f"  {usage}")
                usage = ""
            lines += [f"  {usage if n == 0 else '':{_COLUMN - 2}}{text}" for n, text in enumerate(texts)]
        return "\n".join(lines)

    def parsed(self, words: Sequence[str]) -> Options:
        """Parse words; those after -- are files. Raises ArgumentError, and SystemExit after --help."""
        values: dict[str, Any] = {
            each.name: [] if each.repeats else each.default if each.read else False
            for command in self._commands.values()
            for each in command.options
        }
        values["words"] = []
        rest = deque(words)
        files: list[str] = []
        while rest:
            word = rest.popleft()
            if word == "--":
                files += rest
                break
            if word in ("-h", "--help", "--version"):
                say(f"{self.program} {octex.__version__}" if word == "--version" else self.help())
                raise SystemExit(0)
            if not word.startswith("-") or word == "-":
                files.append(word)
                continue
            word, equals, value = word.partition("=")
            option = self._options.get(word)
            if option is None:
                self._refuse(word)
            is_repeated = word in values["words"]
            values["words"].append(word)
            if option.read is None:
                if equals:
                    self.error(f"{word} takes no value")
                values[option.name] = True
                continue
            if not equals:
                if not rest or rest[0] in self._options:
                    self.error(f"{word} needs a value, {option.value}")
                value = rest.popleft()  # may begin with a minus
            read = self._read(option.read, word, value)
            if is_repeated and not option.repeats:
                self.error(f"{word} is given twice; it takes one value")
            values[option.name] = [*values[option.name], read] if option.repeats else read
        values.update(self._files(files))
        return Options(**values)

    def _files(self, words: list[str]) -> dict[str, Any]:
        """Return files by name, or refuse too few or too many."""
        files: dict[str, Any] = {}
        rest = deque(words)
        misplaced = None  # a file after a missing one
        for each in self._command.files:
            if each.number == "any":
                files[each.word] = [self._read(each.read, each.word, word) for word in rest]
                rest.clear()
            elif rest and (each.number == "one" or each.fits(rest[0])):
                files[each.word] = self._read(each.read, each.word, rest.popleft())
            elif each.number == "maybe":
                files[each.word] = None
                misplaced = misplaced or next(filter(each.fits, rest), None)
        usage = " ".join(each.usage for each in self._command.files)
        if rest:
            if misplaced is not None:
                self.error(f"{misplaced} stands in the wrong place: write {self.program} {usage}")
            self.error(f"{rest[0]} is one file too many for {self.program} {usage}".rstrip())
        missing = [
            each.word for each in self._command.files if each.number == "one" and each.word not in files
        ]
        if missing:
            self.error(f"{' '.join(missing)} {'are' if len(missing) > 1 else 'is'} missing")
        return files

    def _read(self, read: Callable[[str], Any], word: str, value: str) -> Any:
        try:
            return read(value)
        except ValueError as error:  # an ArgumentError is one, too
            self.error(f"{word}: {error}")

    def error(self, message: str) -> NoReturn:
        """Raise ArgumentError."""
        raise ArgumentError(f"{message}; see {self.program} --help")

    def _refuse(self, word: str) -> NoReturn:
        """Refuse an unknown option; name the commands that have it, or a similar option."""
        others = [f"octex {name}" for name, each in self._commands.items() if each.has(word)]
        if others:
            self.error(f"{word} is an option of {', '.join(others)}, not of {self.program}")
        similar = get_close_matches(word, self._options, 1, _ALIKE)
        self.error(f"{word} is not an option{f': do you mean {similar[0]}' if similar else ''}")
