#!/usr/bin/env python
"""Try every model and image below a folder as a user would, and list what becomes of each.

usage: tools/fuzz/fragile.py FOLDER... [--depth 5] [--seconds 10] [--damage N] [--json]

Each file is tried in a process of its own, forked from one that is warm: models and voxels are converted,
images are decoded. With --damage so many copies of each file that needs no other are tried as well, a few
bytes of each overwritten, in a .glb those behind its JSON. Good results are "converted" and "refused" (in one
line); bad ones are TRACEBACK (an error that is not octex's own), HANG (more than --seconds), MEMORY (more
than 50 times the bytes of the file and of what it refers to, and more than 256 MB) and CRASH (ended by a
signal, or something was said besides one line). Beside models that convert although a .report.json of the
glTF validator names errors, those errors stand.
Exit code 1 if anything is bad. Linux only.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from urllib.parse import unquote

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # a fork takes no threads along

from octex.ahead import compile_listed
from octex.cli.common import TRACEBACK_VARIABLE, bytes_text
from octex.cli.main import main as octex_main
from octex.errors import ExitCode, ImageError, OctexError
from octex.parallel import silent
from octex.source.images.decode import decode_image
from octex.source.load import MODEL_ENDINGS, load_surface
from octex.source.voxels import VOXEL_ENDINGS

IMAGE_ENDINGS = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".gif", ".tga", ".tif", ".tiff", ".exr", ".hdr"}
IMAGE_ENDINGS |= {".ktx2", ".avif", ".jp2"}
ALONE = {".glb", ".stl", ".off", ".ply", *VOXEL_ENDINGS, *IMAGE_ENDINGS}  # files that need no other
GOOD = ("converted", "refused")
PROGRAM = "octree-convert"
MOST_PER_BYTE = 50
MOST_ANYWAY = 256 << 20
# Stacks and arenas of threads are reserved, not used; beyond the limit and this, allocations fail.
RESERVED = 1 << 30
OUT_OF_MEMORY = ("out of memory", "more memory than there is", "does not fit into memory")


class Ended(NamedTuple):
    """How a forked process ended."""

    status: int  # exit code, or −signal
    said: str  # stdout and stderr
    seconds: float
    peak: int  # bytes resident at most


class Trial(NamedTuple):
    """What became of one file."""

    file: str
    bytes: int  # of the file
    result: str  # GOOD, or TRACEBACK, HANG, MEMORY, CRASH
    message: str
    seconds: float
    peak: int  # bytes above a warm base line
    limit: int  # of the peak
    validator: list[str]  # codes of errors that the validator found in what octex took


def forked(work: Callable[[], int], scratch: Path, seconds: int, memory: int) -> Ended:
    """Run some work in a fork with limits on its time and memory; it returns an exit code."""
    said = scratch / "said.txt"
    sys.stdout.flush()
    began = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other threads idle
        child = os.fork()
    if child == 0:
        code = int(ExitCode.CRASHED)
        try:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(seconds)
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
            most = pages * resource.getpagesize() + memory
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            os.environ[TRACEBACK_VARIABLE] = "1"
            with said.open("w", encoding="utf-8") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
                code = work()
                sys.stdout.flush()
                sys.stderr.flush()
        except BaseException:
            traceback.print_exc()
            sys.stderr.flush()
        finally:
            os._exit(code)
    _, status, usage = os.wait4(child, 0)
    return Ended(
        os.waitstatus_to_exitcode(status),
        said.read_text(encoding="utf-8", errors="replace") if said.exists() else "",
        time.perf_counter() - began,
        usage.ru_maxrss * 1024,
    )


def attempt(path: Path, scratch: Path, depth: int) -> int:
    """Convert a model or voxels, or decode an image; say why not on stderr; return an exit code.

    Voxels are also read as a surface, which may be refused.
    """
    if path.suffix.lower() in MODEL_ENDINGS:
        options = ["--depth", str(depth)]
        if path.suffix.lower() in VOXEL_ENDINGS:
            options = []
            with suppress(OctexError):
                load_surface(path)
        words = ["convert", str(path), str(scratch / "out.octex"), *options, "--quiet", "--force"]
        return octex_main(words, PROGRAM)
    try:
        texels = decode_image(path.read_bytes(), path.name)
    except ImageError as error:
        print(error, file=sys.stderr)
        return ExitCode.REFUSED
    assert texels.ndim == 3
    assert texels.shape[2] == 4
    assert texels.size
    assert texels.dtype in ("uint16", "float32"), texels.dtype
    return ExitCode.DONE


def judged(ended: Ended, peak: int, limit: int) -> tuple[str, str]:
    """Return the result and the message of a trial."""
    lines = ended.said.strip().splitlines()
    last = lines[-1] if lines else ""
    if ended.status == -signal.SIGALRM:
        return "HANG", "took too long"
    if ended.status < 0:
        return "CRASH", signal.Signals(-ended.status).name
    if peak > limit or any(words in last for words in OUT_OF_MEMORY):
        return "MEMORY", last or f"{bytes_text(peak)}, where {bytes_text(limit)} are allowed"
    if "Traceback" in ended.said:
        where = [line.strip() for line in lines if line.lstrip().startswith("File ")][-1:]
        return "TRACEBACK", " ".join([last, *where])
    if ended.status == ExitCode.DONE and not lines:
        return "converted", ""
    if ended.status == ExitCode.REFUSED and len(lines) == 1:
        return "refused", last.removeprefix(f"{PROGRAM}: ").removeprefix("error: ")
    return "CRASH", f"exit code {ended.status} and {len(lines)} lines: {' | '.join(lines)}"


def bytes_with_references(path: Path) -> int:
    """Return the bytes of a file and of all files below its folder whose names it, or those, mention."""
    if path.suffix.lower() not in MODEL_ENDINGS:
        return path.stat().st_size
    others = {other for other in path.parent.rglob("*") if other.is_file()} - {path}
    total, pending = 0, [path]
    while pending:
        file = pending.pop()
        data = file.read_bytes()
        total += len(data)
        if file == path or file.suffix.lower() == ".mtl":
            text = unquote(data.decode("utf-8", "replace"))
            named = {other for other in others if other.name in text}
            others -= named
            pending += named
    return total


def validator_errors(path: Path) -> list[str]:
    """Return the codes of the errors in the validator's report beside a model."""
    report = path.with_name(path.name + ".report.json")
    if not report.exists():
        return []
    messages = json.loads(report.read_text(encoding="utf-8"))["issues"]["messages"]
    return sorted({message["code"] for message in messages if message["severity"] == 0})


def files(folders: Iterable[Path]) -> Iterator[tuple[str, Path]]:
    """Yield the models and images below some folders, with the names to list them by."""
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path.suffix.lower() in {*MODEL_ENDINGS, *IMAGE_ENDINGS}:
                yield path.relative_to(folder).as_posix(), path


def damaged(name: str, path: Path, scratch: Path, copies: int) -> Iterator[tuple[str, Path]]:
    """Yield copies of a file with some bytes overwritten, each time the same ones."""
    if path.suffix.lower() not in ALONE:
        return
    data = path.read_bytes()
    first = 20 + int.from_bytes(data[12:16], "little") if path.suffix.lower() == ".glb" else 0
    copy = scratch / f"damaged{path.suffix}"
    for number in range(copies if first < len(data) else 0):
        chance = random.Random(f"{name} {number}")
        changed = bytearray(data)
        for _ in range(chance.randint(1, 12)):
            at = chance.randrange(first, len(data))
            run = chance.choice((1, 1, 1, 4, 40))
            changed[at : at + run] = chance.randbytes(len(changed[at : at + run]))
        copy.write_bytes(changed)
        yield f"{name} damaged {number}", copy


def tried(folders: Iterable[Path], depth: int, seconds: int, copies: int) -> Iterator[Trial]:
    """Try all models, voxels and images below some folders, and damaged copies of each."""
    with TemporaryDirectory(prefix="octex-fragile-") as name_of_scratch:
        scratch = Path(name_of_scratch)
        compile_listed(silent)
        plain = scratch / "plain.obj"
        plain.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", encoding="ascii")
        plainly = [forked(lambda: attempt(plain, scratch, depth), scratch, 60, RESERVED) for _ in range(2)]
        if plainly[-1].status != ExitCode.DONE:
            raise RuntimeError(f"a plain triangle does not convert: {plainly[-1].said}")
        base = min(ended.peak for ended in plainly)  # the first may still have compiled something
        each = (
            trial
            for name, path in files(folders)
            for trial in chain([(name, path)], damaged(name, path, scratch, copies))
        )
        for name, path in each:
            limit = max(MOST_PER_BYTE * bytes_with_references(path), MOST_ANYWAY)
            ended = forked(
                lambda path=path: attempt(path, scratch, depth), scratch, seconds, limit + RESERVED
            )
            peak = max(ended.peak - base, 0)
            result, message = judged(ended, peak, limit)
            errors = validator_errors(path) if result == "converted" else []
            size = path.stat().st_size
            yield Trial(name, size, result, message, round(ended.seconds, 3), peak, limit, errors)


def row(trial: Trial) -> str:
    """Return one line of the table."""
    note = trial.message or (f"the validator says {', '.join(trial.validator)}" if trial.validator else "")
    peak = f"{trial.peak / 2**20:7.1f} MB"
    size = bytes_text(trial.bytes)
    return f"{trial.result:9} {trial.seconds:7.2f} s {peak} {size:>11}  {trial.file}  {note}".rstrip()


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="a folder")
    parser.add_argument("--depth", type=int, default=5, help="of conversions (5)")
    parser.add_argument("--seconds", type=int, default=10, help="after which a file counts as hanging (10)")
    parser.add_argument("--damage", type=int, default=0, metavar="N", help="damaged copies of each file (0)")
    parser.add_argument("--json", action="store_true", help="print a list of JSON objects")
    options = parser.parse_args(arguments)
    for path in options.folders:
        if not path.is_dir():
            parser.error(f"there is no folder {path}")

    trials = []
    for trial in tried(options.folders, options.depth, options.seconds, options.damage):
        trials.append(trial)
        if not options.json:
            print(row(trial), flush=True)
    counts = Counter(trial.result for trial in trials)
    if options.json:
        print(json.dumps([trial._asdict() for trial in trials], indent=1))
    else:
        doubtful = sum(bool(trial.validator) for trial in trials)
        print(f"\n{len(trials)} files:", ", ".join(f"{n} {result}" for result, n in counts.most_common()))
        print(f"{doubtful} converted although the validator found errors")
    return int(any(result not in GOOD for result in counts))


if __name__ == "__main__":
    sys.exit(main())
