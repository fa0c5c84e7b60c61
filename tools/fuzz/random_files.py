"""Try the models, voxels and images of OCTEX_TEST_MODELS as a user would, whole and then damaged.

The first seeds take one file each; later ones take a file that needs no other, and overwrite a few bytes, in
a .glb those behind its JSON. Models and voxels are converted, images are decoded. Each file must convert
silently, or be refused in one line. It may take 268 MB, or 50 times the bytes of the file and of all that it
refers to.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from functools import cache
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory, TemporaryFile
from urllib.parse import unquote

from octex.cli.common import TRACEBACK_VARIABLE, bytes_text
from octex.cli.main import main as octex_main
from octex.errors import ExitCode, ImageError, OctexError
from octex.source.images.decode import decode_image
from octex.source.load import MODEL_ENDINGS, load_surface
from octex.source.voxels import VOXEL_ENDINGS

IMAGE_ENDINGS = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".gif", ".tga", ".tif", ".tiff", ".exr", ".hdr"}
IMAGE_ENDINGS |= {".ktx2", ".avif", ".jp2"}
ALONE = {".glb", ".stl", ".off", ".ply", *VOXEL_ENDINGS, *IMAGE_ENDINGS}  # files that need no other
MOST_PER_BYTE = 50
MOST_ANYWAY = 256 << 20
OUT_OF_MEMORY = ("out of memory", "more memory than there is", "does not fit into memory")


def check(seed: int) -> str:
    """Try a file, or a damaged copy; return what became of it."""
    if "OCTEX_TEST_MODELS" not in os.environ:
        return "OCTEX_TEST_MODELS names no folder"
    paths = files()
    number, copy = seed % len(paths), seed // len(paths)
    with TemporaryDirectory() as scratch:
        path = paths[number]
        if copy:
            path = damaged(path, Random(seed), Path(scratch))
        return f"{path.suffix.lower()}: {attempt(path, Path(scratch))}"


@cache
def files() -> list[Path]:
    """Return the models and images; converts a triangle first, for what that compiles."""
    with TemporaryDirectory() as scratch:
        plain = Path(scratch, "plain.obj")
        plain.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", encoding="ascii")
        assert attempt(plain, Path(scratch)) == "converted"
    every = sorted(Path(os.environ["OCTEX_TEST_MODELS"]).rglob("*"))
    return [
        each for each in every if each.is_file() and each.suffix.lower() in {*MODEL_ENDINGS, *IMAGE_ENDINGS}
    ]


def damaged(path: Path, chance: Random, scratch: Path) -> Path:
    """Write a copy of a file with some bytes overwritten; return the file itself where it needs others."""
    data = bytearray(path.read_bytes())
    first = 20 + int.from_bytes(data[12:16], "little") if path.suffix.lower() == ".glb" else 0
    if path.suffix.lower() not in ALONE or first >= len(data):
        return path
    for _ in range(chance.randint(1, 12)):
        at = chance.randrange(first, len(data))
        run = chance.choice((1, 1, 1, 4, 40))
        data[at : at + run] = chance.randbytes(len(data[at : at + run]))
    copy = scratch / f"damaged{path.suffix}"
    copy.write_bytes(data)
    return copy


def attempt(path: Path, scratch: Path) -> str:
    """Convert a model or decode an image; return "converted" or "refused"."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # its peak begins anew
    before = _peak()
    with _heard() as said:
        code = converted(path, scratch)
    limit = max(MOST_PER_BYTE * bytes_with_references(path), MOST_ANYWAY)
    peak = _peak() - before
    assert peak <= limit, f"{bytes_text(peak)}, where {bytes_text(limit)} are allowed"
    assert not any(words in line for line in said for words in OUT_OF_MEMORY), said[-1]
    if code == ExitCode.DONE:
        assert not said, said
        return "converted"
    assert code == ExitCode.REFUSED, (code, said)
    assert len(said) == 1, said
    return "refused"


def converted(path: Path, scratch: Path) -> int:
    """Do it; return an exit code. Voxels are also read as a surface, which may be refused."""
    if path.suffix.lower() in MODEL_ENDINGS:
        options = ["--depth", "5"]
        if path.suffix.lower() in VOXEL_ENDINGS:
            options = []
            with suppress(OctexError):
                load_surface(path)
        return octex_main(["convert", str(path), str(scratch / "out.octex"), *options, "--quiet", "--force"])
    try:
        texels = decode_image(path.read_bytes(), path.name)
    except ImageError as error:
        print(error, file=sys.stderr)
        return ExitCode.REFUSED
    assert texels.shape[2] == 4
    assert texels.size
    assert texels.dtype in ("uint16", "float32"), texels.dtype
    return ExitCode.DONE


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


@contextmanager
def _heard() -> Iterator[list[str]]:
    """List the lines that go to stdout and stderr, of libraries too."""
    lines: list[str] = []
    os.environ[TRACEBACK_VARIABLE] = "1"
    with TemporaryFile("w+", encoding="utf-8", errors="replace") as file:
        usual = os.dup(1), os.dup(2)
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
        try:
            with redirect_stdout(file), redirect_stderr(file):
                yield lines
        finally:
            for stream, each in enumerate(usual, 1):
                os.dup2(each, stream)
                os.close(each)
            file.seek(0)
            lines += file.read().splitlines()


def _peak() -> int:
    """Return the bytes that this process has had at most."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024
