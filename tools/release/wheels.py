"""Build and test what a release uploads: an sdist, a plain wheel, and a wheel with compiled kernels a Python.

usage: python tools/release/wheels.py OUTPUT [PYTHON ...]     needs: pip install build twine wheel

Each PYTHON (default: the one that runs this) gets a wheel whose kernels are compiled already, for x86-64
processors with AVX2 (`octex/ahead.py`), by the numba that pip installs with it: with another one they are
compiled on first use. The test is README's first command, in a new environment: nothing may be compiled, and
the files must be those that native code writes, to the byte.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
_COMPILE = "from octex import ahead; ahead.compile_listed(lambda *_: None)"
_PORTABLE = "from octex.ahead import PORTABLE; print(*PORTABLE.values())"
_KERNELS = """
from octex import ahead
print(*dict.fromkeys(line.split(" ")[0] for line in ahead.lines(*ahead.SECTIONS)))
"""
_VARIABLES = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
_TAG = "import sys; print('cp%d%d' % sys.version_info[:2])"


def run(*call: str | Path, **variables: str) -> str:
    """Run a command away from the clone, and return what it says."""
    environment = _VARIABLES | variables
    done = subprocess.run(
        call, stdout=subprocess.PIPE, env=environment, cwd=tempfile.gettempdir(), text=True, check=True
    )
    return done.stdout


def environment_of(python: str, wheel: Path, folder: Path) -> Path:
    """Make an environment with a wheel in it, and return its folder of programs."""
    run(python, "-m", "venv", folder)
    run(folder / "bin" / "pip", "install", "--quiet", wheel)
    return folder / "bin"


def first_command(programs: Path, folder: Path, cache: Path) -> tuple[list[str], float]:
    """Run README's first command; return the digests of what it writes, and the seconds that it takes."""
    texture, preview = folder / "droid.octex", folder / "droid.png"
    began = time.perf_counter()
    call = "octree-convert", ROOT / "samples" / "droid.glb", texture, "--preview", preview, "--force"
    run(programs / call[0], *call[1:], "--quiet", NUMBA_CACHE_DIR=str(cache))
    seconds = time.perf_counter() - began
    return [hashlib.sha256(path.read_bytes()).hexdigest() for path in (texture, preview)], seconds


def compiled_wheel(plain: Path, python: str, folder: Path) -> Path:
    """Return a wheel like ``plain`` with kernels compiled by and for a Python."""
    programs = environment_of(python, plain, folder / "builder")
    processor, features = run(programs / "python", "-P", "-c", _PORTABLE).split()
    settings = {"NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": features}
    cache = {"NUMBA_CACHE_DIR": str(folder / "portable")}
    subprocess.run(
        [programs / "python", "-P", "-c", _COMPILE], env=_VARIABLES | settings | cache, cwd=folder, check=True
    )
    run(sys.executable, "-m", "wheel", "unpack", plain, "--dest", folder)
    (unpacked,) = folder.glob("octex-*")
    shipped = unpacked / "octex" / "compiled"
    # Parts are compiled into kernels: they are of no use by themselves.
    for kernel in run(programs / "python", "-P", "-c", _KERNELS).split():
        module, _, name = kernel.rpartition(":")
        files = (folder / "portable").glob(f"{module}.{'?' * 16}/*/{module.rpartition('.')[2]}.{name}-*.nb?")
        for path in files:
            to = shipped / path.relative_to(folder / "portable")
            to.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, to)
            shutil.copy(path.with_name("checksums"), to.with_name("checksums"))
    description = next(unpacked.glob("*.dist-info")) / "WHEEL"
    description.write_text(description.read_text().replace("Root-Is-Purelib: true", "Root-Is-Purelib: false"))
    run(sys.executable, "-m", "wheel", "pack", unpacked, "--dest-dir", folder)
    tag = run(python, "-c", _TAG).strip()
    tags = f"--python-tag={tag}", f"--abi-tag={tag}", "--platform-tag=manylinux_2_28_x86_64"
    name = run(sys.executable, "-m", "wheel", "tags", *tags, folder / plain.name).split()[-1]
    return folder / name


def check(wheel: Path, plain: list[str], python: str, folder: Path) -> None:
    """Install a wheel with kernels, and see that it compiles nothing and writes what native code writes."""
    programs = environment_of(python, wheel, folder / "user")
    digests, seconds = first_command(programs, folder, folder / "own")
    (shipped,) = (folder / "user").rglob("octex/compiled")
    brought = {(path.parents[1].name, path.name): path.read_bytes() for path in shipped.rglob("*.nbc")}
    own = (folder / "own").rglob("*.nbc")  # what the wheel brought is copied there when it is used
    found = {(path.parents[1].name, path.name): path.read_bytes() for path in own}
    compiled = [name for name, content in found.items() if brought.get(name) != content]
    if compiled or digests != plain:
        raise SystemExit(f"{wheel.name}: compiles {compiled}, writes {digests}, native code {plain}")
    print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB; the first command took {seconds:.1f} s")


def main(arguments: list[str]) -> int:
    if not arguments:
        print(__doc__, file=sys.stderr)
        return 2
    if platform.machine() != "x86_64" or platform.system() != "Linux":
        raise SystemExit("compiled wheels are built on Linux, on x86-64")
    output, pythons = Path(arguments[0]).absolute(), arguments[1:] or [sys.executable]
    run(sys.executable, "-m", "build", ROOT, "--outdir", output)
    (plain,) = output.glob("octex-*-none-any.whl")
    for python in pythons:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            wheel = compiled_wheel(plain, python, folder)
            native, _ = first_command(folder / "builder" / "bin", folder, folder / "native")
            check(wheel, native, python, folder)
            shutil.copy(wheel, output)
    run(sys.executable, "-m", "twine", "check", "--strict", *sorted(output.glob("octex-*")))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
