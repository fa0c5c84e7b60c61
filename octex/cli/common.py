"""Shared by all commands: one-line errors, exit codes, progress, and checks before any work."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import TYPE_CHECKING, Any, NoReturn, Self, TextIO

from octex.ahead import at_first_compilation, use_shipped_code
from octex.errors import ExitCode, InputError, ModelWarning, OctexError, OutputError
from octex.files import bytes_text, count_text, undo_all
from octex.parallel import at_most

if TYPE_CHECKING:
    from octex.texture import OctreeTexture

# Numpy and OpenImageIO start no threads of their own, since octex spreads the work.
_NO_THREADS = {
    **dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"), "1"),
    "VECLIB_MAXIMUM_THREADS": "1",
    "OPENIMAGEIO_OPTIONS": "threads=1,exr_threads=-1",
}
#: If set, unexpected errors show their traceback.
TRACEBACK_VARIABLE = "OCTEX_TRACEBACK"


@contextmanager
def limited(count: int | None) -> Iterator[None]:
    """Use ``count`` threads within the block, which imports numpy; None: all processors."""
    added = {} if count is None else {name: _NO_THREADS[name] for name in _NO_THREADS.keys() - os.environ}
    os.environ.update(added)
    try:
        with at_most(count):
            yield
    finally:
        for name in added:
            os.environ.pop(name, None)


class _TerminatedError(KeyboardInterrupt):
    """SIGTERM."""


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Turn the first SIGINT or SIGTERM into an exception; the second ends the process."""
    is_ending = False

    def end(number: int, _frame: FrameType | None) -> NoReturn:
        nonlocal is_ending
        if is_ending:
            undo_all()
            os._exit(128 + number)
        is_ending = True
        raise _TerminatedError if number == signal.SIGTERM else KeyboardInterrupt

    replaced = {}
    if threading.current_thread() is threading.main_thread():
        for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
            if signal.getsignal(number) is usual:  # unless the caller ignores it
                replaced[number] = usual
                signal.signal(number, end)
    try:
        yield
    finally:
        if is_ending:
            undo_all()
        for number, usual in replaced.items():
            signal.signal(number, usual)


def run(command: str, body: Callable[[], int]) -> int:
    """Run the body of a command and return its exit code; every failure becomes one line on stderr.

    After SIGINT or SIGTERM no file is half-written; a second signal does not wait for threads.
    """
    use_shipped_code()
    with _ended_by_signals():
        try:
            try:
                code = body()
            except SystemExit as wanted:  # from --help and --version
                code = int(wanted.code or 0)
            _write(sys.stdout, "")
            return code
        except OctexError as error:
            return fail(command, f"error: {error}", ExitCode.REFUSED)
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            return fail(command, f"error: {where}{error.strerror or error}", ExitCode.REFUSED)
        except MemoryError as error:
            reason = f" ({error})" if str(error) else ""
            return fail(
                command, f"error: out of memory{reason}; a smaller depth needs less", ExitCode.REFUSED
            )
        except _TerminatedError:
            return fail(command, "ended by SIGTERM", ExitCode.TERMINATED)
        except KeyboardInterrupt:
            return fail(command, "interrupted", ExitCode.INTERRUPTED)
        except Exception as error:
            if TRACEBACK_VARIABLE in os.environ:
                traceback.print_exc()
            defect = f"{type(error).__name__}: {error}".removesuffix(": ")
            hint = f"run with {TRACEBACK_VARIABLE}=1 for the traceback"
            return fail(command, f"this is a defect of octex: {defect}; {hint}", ExitCode.CRASHED)


def say(text: str) -> None:
    """Print a result on stdout; raises OutputError, except when the reader has closed the pipe."""
    _write(sys.stdout, text + "\n")


def _write(stdout: TextIO | None, text: str) -> None:
    if stdout is None:  # closed by the caller
        return
    try:
        encoding = stdout.encoding or "utf-8"
        stdout.write(text.encode(encoding, "backslashreplace").decode(encoding))
        stdout.flush()
    except OSError as error:
        # The rest of the buffer must not fail again when the interpreter ends.
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            raise OutputError(f"standard output cannot be written: {error.strerror or error}") from error


def print_result(options: SimpleNamespace, facts: Mapping[str, Any], lines: Iterable[str]) -> None:
    """Print a result: with --json as a JSON object, else as lines."""
    say(json.dumps(facts) if options.json else "\n".join(lines))


def report(options: SimpleNamespace, facts: Mapping[str, Any], *lines: str) -> None:
    """Print a report of written files: with --json as a JSON object, with --quiet nothing, else as lines."""
    if options.json or not options.quiet:
        print_result(options, facts, lines)


def report_file(
    options: SimpleNamespace,
    text: str,
    details: Mapping[str, Any],
    *lines: str,
    others: Mapping[str, tuple[Path | None, str]] | None = None,
    path: Path | None = None,
) -> ExitCode:
    """Report the written OUTPUT, or ``path``: ``text`` or ``details`` describe it, with its size and time.

    ``others`` are further files by their names in JSON, each with a description; None is left out.
    """
    path, seconds = path or options.OUTPUT, time.perf_counter() - options.began
    size = path.stat().st_size
    written = {name: other for name, other in (others or {}).items() if other[0] is not None}
    facts = {"output": str(path), "bytes": size, **details, "seconds": round(seconds, 3)}
    facts |= {name: str(file) for name, (file, _) in written.items()}
    first = ", ".join([*filter(None, [text]), bytes_text(facts["bytes"]), f"{seconds:.1f} s"])
    files = [f"{file}: {description}" for file, description in written.values()]
    report(options, facts, f"{path}: {first}", *files, *lines)
    return ExitCode.DONE


def facts_of(texture: OctreeTexture) -> tuple[str, dict[str, Any]]:
    """Return the facts of a texture as text and for JSON."""
    tree = texture.tree
    cell = texture.placement.size / 2**tree.max_depth
    facts = {"leaves": tree.n_leaves, "nodes": tree.n_nodes, "depth": tree.max_depth, "cell": cell}
    return (
        f"{count_text(tree.n_leaves, 'leaf', 'leaves')}, depth {tree.max_depth} (cells of {cell:.4g})",
        facts,
    )


def fail(command: str, message: str, code: ExitCode) -> ExitCode:
    """Print an error in one line on stderr, and return the exit code."""
    if sys.stderr is not None:  # closed by the caller
        with suppress(OSError):
            print(f"{command}: {' '.join(message.split())}", file=sys.stderr)
    return code


class Reporter:
    """Progress on stderr: a bar on a terminal, else a line for each finished stage.

    Call it with (stage, done, total), within its context. It notes once that kernels are compiled, unless
    ``announce`` is False. An error of stderr does not stop the work.
    """

    def __init__(self, command: str, quiet: bool = False, announce: bool = True) -> None:
        self._command = command
        self._announce = announce
        self._quiet = quiet or sys.stderr is None
        self._on_terminal = not self._quiet and sys.stderr.isatty()
        self._bar: Any = None
        self._stage: str | None = None
        self._began = 0.0
        self._stack = ExitStack()
        self._show_warning: Callable[..., None] = warnings.showwarning

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` units of a stage are done."""
        if self._quiet:
            return
        try:
            if stage != self._stage:
                self._end_stage()
                self._begin_stage(stage)
            if self._bar is not None:
                self._bar.total = total
                self._bar.update(done - self._bar.n)
        except OSError:
            self._quiet = True

    def _begin_stage(self, stage: str) -> None:
        self._stage = stage
        self._began = time.perf_counter()
        if self._on_terminal:
            from tqdm import tqdm

            tqdm.monitor_interval = 0  # no thread that redraws idle bars

            columns, lines = shutil.get_terminal_size()
            self._bar = tqdm(
                desc=stage,
                total=1,
                file=sys.stderr,
                leave=False,
                ncols=columns,
                nrows=lines,
                bar_format="{desc} {percentage:3.0f}% |{bar}| {elapsed} < {remaining}",
            )

    def _end_stage(self) -> None:
        if self._stage is None:
            return
        if self._bar is not None:
            self._bar.close()
            self._bar = None
        else:
            self._line(f"{self._stage}: done in {time.perf_counter() - self._began:.1f} s")
        self._stage = None

    def _line(self, text: str) -> None:
        line = f"{self._command}: {text}"
        if self._bar is not None:
            self._bar.write(line, file=sys.stderr)
        else:
            print(line, file=sys.stderr, flush=True)

    def note(self, text: str) -> None:
        """Print a line between the stages."""
        if not self._quiet:
            with suppress(OSError):
                self._line(text)

    def _warn(self, message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if issubclass(category, ModelWarning):
            self.note(f"warning: {message}")
        else:
            self._show_warning(message, category, *place, **more)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Report a stage without progress."""
        self(name, 0, 1)
        yield
        self(name, 1, 1)

    def __enter__(self) -> Self:
        """Start to report compilation, and warnings about models."""
        self._stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("always", ModelWarning)
        self._show_warning, warnings.showwarning = warnings.showwarning, self._warn
        if self._announce and not self._quiet:
            text = "compiling kernels, once (octex warm-up compiles all)"
            self._stack.enter_context(at_first_compilation(lambda: self.note(text)))
        return self

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        """End the last stage; after an error without a report."""
        self._stack.close()
        if kind is not None and self._bar is None:
            self._stage = None
        with suppress(OSError):
            self._end_stage()


def check_outputs(
    outputs: Iterable[tuple[Path | None, Iterable[str], str]], inputs: Iterable[Path | None], *, force: bool
) -> None:
    """Refuse outputs that cannot or must not be written, before any work starts.

    outputs    (path or None, its possible endings, its word on the command line)
    inputs     paths or None; no output may be one of them
    """
    taken = {identity(path): "an input" for path in inputs if path is not None}
    for path, endings, word in outputs:
        if path is None:
            continue
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; give {word} a file name")
        if Path(os.path.realpath(path)).is_symlink():
            raise OutputError(f"{path}: is a symbolic link to itself; remove it, or give {word} another name")
        known = list(endings)
        if path.suffix.lower() not in known:
            ending = f"the ending {path.suffix!r}" if path.suffix else "no ending"
            raise InputError(f"{path}: {word} has {ending}; octex writes {listed(known)} here")
        check_folder(path, path.parent)
        other = taken.setdefault(identity(path), word)
        if other != word:
            raise OutputError(f"{path}: {word} is also {other}; give it another name")
        if path.exists() and not force:
            raise OutputError(f"{path}: exists already; --force overwrites it")


def check_folder(path: Path, folder: Path) -> None:
    """Refuse a folder for the output ``path`` that is missing or cannot be written."""
    if not folder.is_dir():
        raise OutputError(f"{path}: there is no folder {folder}; make it first")
    if not os.access(folder, os.W_OK):
        raise OutputError(f"{path}: the folder {folder} cannot be written")


def listed(words: Sequence[str]) -> str:
    """Join words by commas and "and"."""
    return " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def identity(path: Path) -> tuple[int, int] | Path:
    """Return an identity of a file that is equal for all its names."""
    with suppress(OSError):
        status = path.stat()
        return status.st_dev, status.st_ino
    return Path(os.path.realpath(path))  # works for links to themselves, too
