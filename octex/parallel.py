"""Parallel work and progress.

Functions that work in parallel take a `Run`, and pass it to `workers`. Code that a worker calls stays in its
thread.

A task returns its result: `start` sends other processes copies of arrays, to read only. A task that writes to
its input arrays takes its workers from `sharing`: threads of this process.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import threading
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

from octex.errors import ArgumentError

Item = TypeVar("Item")
Result = TypeVar("Result")

_MOST_THREADS = 1 << 16


class Progress(Protocol):
    """Called now and then with the name of the stage, the units done and the units in all."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report; must return quickly."""


def silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""


def as_progress(progress: Progress | None) -> Progress:
    """Return a progress function, silent for None, or raise ArgumentError."""
    if progress is not None and not callable(progress):
        raise ArgumentError(f"progress must be a function (stage, done, total), not {progress!r}")
    return silent if progress is None else progress


@dataclass(frozen=True, kw_only=True)
class Run:
    """How octex works: threads, memory and progress. No field changes a result.

    threads   number of threads. Default: all processors for large batches, the calling thread for small ones
    executor  a concurrent.futures.Executor that does the work, instead of threads
    memory    bytes, or a text like "2GB": store the excess in files. ``convert`` takes it with ``path``.
              ``paint``, ``project`` and ``refine_cameras`` need 64 bytes a pixel. Their default is half of
              the machine's memory; merging takes about 700 MB more
    folder    for these files. Default: that of ``path``, or the folder of temporary files
    resume    a folder that stores finished stages of painting. A later call with the same folder reuses
              unchanged stages. It holds 29 bytes a pixel; you may delete it
    progress  called with a stage's name, the units done and the units in all

    Other functions refuse memory, folder and resume. The shortcuts ``threads=`` and ``progress=`` of a
    function set these two fields. Raises ArgumentError for a field that cannot be used.
    """

    threads: int | None = None
    executor: Executor | None = None
    memory: int | str | None = None
    folder: str | os.PathLike[str] | None = None
    resume: str | os.PathLike[str] | None = None
    progress: Progress | None = None

    def __post_init__(self) -> None:
        if self.executor is not None and not callable(getattr(self.executor, "submit", None)):
            raise ArgumentError(f"executor must be a concurrent.futures.Executor, not {self.executor!r}")
        as_progress(self.progress)
        if self.threads is self.memory is self.folder is self.resume is None:
            return
        from octex.checks import as_memory, as_path, as_whole  # numpy, which commands do without at first

        if self.threads is not None:
            as_whole(self.threads, "threads", 1, _MOST_THREADS)
            if self.executor is not None:
                raise ArgumentError("give threads or an executor, not both")
        if self.memory is not None:
            as_memory(self.memory)
        if self.folder is not None:
            if self.memory is None:
                raise ArgumentError("folder needs memory: what exceeds memory goes to that folder")
            as_path(self.folder, "folder")
        if self.resume is not None:
            as_path(self.resume, "resume")

    @property
    def report(self) -> Progress:
        """``progress``, or a silent function for None."""
        return as_progress(self.progress)


#: The default run.
DEFAULT = Run()


def folder_of(run: Run, default: Path) -> Path:
    """Return the folder for a run's files, or raise ArgumentError if it is none."""
    folder = default if run.folder is None else Path(os.fsdecode(run.folder))
    if not folder.is_dir():
        raise ArgumentError(f"folder: {folder} is not a folder; name an existing one")
    return folder


def as_run(run: Run | None, threads: int | None = None, progress: Progress | None = None, *uses: str) -> Run:
    """Return a run with a function's shortcuts in it, or raise ArgumentError.

    ``uses`` names the fields among memory, folder and resume that the function uses.
    """
    run = DEFAULT if run is None else run
    if not isinstance(run, Run):
        raise ArgumentError(f"run must be an octex.Run, not {run!r}")
    for name in ("memory", "folder", "resume"):
        if getattr(run, name) is not None and name not in uses:
            raise ArgumentError(f"{name} of run is not used here; leave it out")
    shortcuts: dict[str, Any] = {"threads": threads, "progress": progress}
    for name, value in shortcuts.items():
        if value is not None and getattr(run, name) is not None:
            raise ArgumentError(f"give {name} or a run with {name}, not both")
        if value is not None:
            run = replace(run, **{name: value})
    return run


def memory_size() -> float:
    """Return the bytes of memory of this machine, or of this container if less; infinity if unknown."""
    sizes = [math.inf]
    with suppress(AttributeError, ValueError, OSError):  # not on this operating system
        sizes.append(float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")))
    with suppress(ValueError, OSError):  # no container, or one without a limit: "max"
        sizes.append(float(Path("/sys/fs/cgroup/memory.max").read_text("utf-8")))
    return min(sizes)


def usual_memory() -> int | None:
    """Return the bytes that images may take by default: half of this machine's; None if unknown."""
    size = memory_size()
    return int(size / 2) if math.isfinite(size) else None


_most: int | None = None  # the limit of ``at_most``
_pools = 0  # number of pools
_thread = threading.local()  # ``is_worker`` in threads of pools


@contextmanager
def at_most(count: int | None) -> Iterator[None]:
    """Let octex start no more than ``count`` threads while the block lasts; None changes nothing."""
    global _most
    before = _most
    _most = before if count is None else count
    try:
        yield
    finally:
        _most = before


def cpu_count() -> int:
    """Return the number of processors that this process may use, or the limit of ``at_most``."""
    if _most is not None:
        return _most
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on this operating system
        return os.cpu_count() or 1


@contextmanager
def pool_of(count: int) -> Iterator[Executor]:
    """Yield a pool of ``count`` threads that ends with the block; an error drops pending tasks."""
    global _pools
    if _most is not None and _pools:  # a pool has all allowed threads
        yield _CallingThread()
        return
    note_worker = partial(setattr, _thread, "is_worker", True)
    with ThreadPoolExecutor(count, thread_name_prefix="octex", initializer=note_worker) as pool:
        _pools += 1
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        finally:
            _pools -= 1


class built_once(cached_property[Result]):  # noqa: N801  (like its base)
    """Like ``cached_property``, but one of several threads computes the value.

    Only threads that need the same value of the same object wait.
    """

    def __get__(self, instance: Any, owner: type[Any] | None = None) -> Any:
        if instance is None:
            return self
        name, values = self.attrname, instance.__dict__
        with _turns_lock:
            turn = _turns.setdefault((id(instance), name), threading.RLock())
        with turn:
            try:
                if name not in values:
                    values[name] = self.func(instance)
                return values[name]
            finally:
                with _turns_lock:
                    _turns.pop((id(instance), name), None)


_turns_lock = threading.Lock()
_turns: dict[tuple[int, str | None], threading.RLock] = {}  # until an object has the value


class _CallingThread(Executor):
    """Works at once, in the calling thread."""

    def submit(self, function: Callable[..., Result], /, *arguments: Any, **named: Any) -> Future[Result]:
        future: Future[Result] = Future()
        try:
            future.set_result(function(*arguments, **named))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def workers(run: Run = DEFAULT, tasks: int | None = None) -> Iterator[Executor]:
    """Yield an executor for a number of ``tasks``, None for many; its threads end with the block.

    The run gives their number; None is a thread for each processor. The calling thread does a single task.
    In a worker thread of octex it does all tasks for None.
    """
    if run.executor is not None:
        yield run.executor
        return
    counts = cpu_count() if run.threads is None else int(run.threads), _most, tasks
    count = min(each for each in counts if each is not None)
    if count <= 1 or (run.threads is None and getattr(_thread, "is_worker", False)):
        yield _CallingThread()
        return
    with pool_of(count) as pool:
        yield pool


def shares_memory(executor: Executor) -> bool:
    """Return whether an executor surely works in this process."""
    return isinstance(executor, (_CallingThread, ThreadPoolExecutor))


def start(executor: Executor, function: Callable[..., Result], /, *arguments: Any) -> Future[Result]:
    """Submit a task; other processes get copies of its arrays, which it must not write to.

    Raises ArgumentError for a task that cannot be sent to them.
    """
    if shares_memory(executor) or hasattr(executor, "here"):
        return executor.submit(function, *arguments)
    buffers: list[pickle.PickleBuffer] = []
    text = io.BytesIO()
    try:
        _Pickler(text, protocol=5, buffer_callback=buffers.append).dump((function, arguments))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ArgumentError(
            f"executor: a task cannot be sent to its processes: {error}; define functions in a module, or "
            "give threads"
        ) from error
    return executor.submit(_do, text.getvalue(), [buffer.raw().tobytes() for buffer in buffers])


class _Pickler(pickle.Pickler):
    """Pickles the elements of all arrays separately."""

    def reducer_override(self, value: Any) -> Any:
        flags = getattr(value, "flags", None)
        if flags is None or getattr(flags, "forc", True):
            return NotImplemented
        return value.copy().__reduce_ex__(5)


def _do(text: bytes, copies: list[bytes]) -> Any:
    """Do a task in another process; raises RuntimeError for one that writes to its arguments."""
    sums = [zlib.adler32(copy) for copy in copies]
    function, arguments = pickle.loads(text, buffers=copies)  # arrays of bytes are read-only
    result = function(*arguments)
    if sums != [zlib.adler32(copy) for copy in copies]:  # kernels write to read-only arrays, too
        raise RuntimeError(f"{function} writes to arrays that are not shared; `sharing` has workers for that")
    return result


@contextmanager
def sharing(executor: Executor) -> Iterator[Executor]:
    """Yield an executor for tasks that write to arrays of this process.

    That is ``executor``, or its attribute ``here``, if that works in this process; else threads that end with
    the block.
    """
    local = getattr(executor, "here", executor)
    if local is not None and shares_memory(local):
        yield local
        return
    with workers() as threads:
        yield threads


def ordered_map(
    executor: Executor,
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    stage: str = "",
    progress: Progress = silent,
    window: int = 64,
) -> Iterator[Result]:
    """Yield ``function(item)`` for each item, in the order of the items.

    At most ``window`` items are in flight, so that results do not pile up. The first error ends the map and
    cancels waiting tasks.
    """
    if len(items) == 1 and shares_memory(executor):  # as fast, without waking a thread
        executor = _CallingThread()
    window = 1 if isinstance(executor, _CallingThread) else window
    pending: deque[Future[Result]] = deque()
    total = len(items)
    done = 0
    try:
        for item in items:
            pending.append(start(executor, function, item))
            if len(pending) >= window:
                yield pending.popleft().result()
                done += 1
                progress(stage, done, total)
        while pending:
            yield pending.popleft().result()
            done += 1
            progress(stage, done, total)
    finally:
        for future in pending:
            future.cancel()
