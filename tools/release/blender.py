#!/usr/bin/env python
"""Build Blender's extension for some platforms, with the wheels that it needs.

usage: tools/release/blender.py OUTPUT [PLATFORM ...] [--pythons 3.14 ...] [--check PYTHON]
needs: pip install build

Each PLATFORM (default: linux-x64; others windows-x64, macos-arm64) gets OUTPUT/octex-VERSION-PLATFORM.zip,
with wheels for the Pythons of Blender 4.5 to 5.0 (3.11) and from 5.1 on (3.13), or for those of --pythons:
a Linux distribution may build Blender with its own. Blender brings numpy. With
--check, a PYTHON that has bpy validates the linux-x64 file, installs it in an empty folder and uses it.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

import octex

ROOT = Path(__file__).parents[2]
EXTENSION = ROOT / "tools" / "blender" / "extension"
PYTHONS = "3.11", "3.13"
#: What pip calls the platforms.
PLATFORMS = {
    "linux-x64": ["manylinux_2_28_x86_64", "manylinux_2_27_x86_64", "manylinux2014_x86_64"],
    "windows-x64": ["win_amd64"],
    "macos-arm64": ["macosx_14_0_arm64", "macosx_12_0_arm64", "macosx_11_0_arm64"],
}
_CHECK = """
import sys
import bpy
archive, folder = sys.argv[1:]
bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
bpy.ops.wm.read_homefile(use_factory_startup=False, use_empty=True)
bpy.ops.mesh.primitive_cube_add()
bpy.ops.wm.save_as_mainfile(filepath=folder + "/cube.blend")
bpy.context.active_object.octex.origin = "GREY"
assert bpy.ops.octex.make() == {"FINISHED"}
assert bpy.ops.octex.colors() == {"FINISHED"}
assert bpy.ops.octex.exact() == {"FINISHED"}
import octex
assert octex.__file__.startswith(folder), octex.__file__
"""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("platforms", nargs="*", choices=[*PLATFORMS, []], metavar="PLATFORM")
    parser.add_argument("--pythons", nargs="+", default=PYTHONS, metavar="VERSION")
    parser.add_argument("--check", type=Path, metavar="PYTHON")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        build = [sys.executable, "-m", "build", "--wheel", "--outdir", folder, ROOT]
        subprocess.run(build, check=True, stdout=subprocess.DEVNULL)
        (wheel,) = Path(folder).glob("octex-*.whl")
        for name in options.platforms or ["linux-x64"]:
            path = built(options.output, name, wheel, options.pythons)
            print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
            if options.check and name == "linux-x64":
                check(path.resolve(), options.check)
    return 0


def built(output: Path, platform: str, wheel: Path, pythons: Sequence[str]) -> Path:
    """Write the extension for a platform, and return its path."""
    path = output / f"octex-{octex.__version__}-{platform}.zip"
    with tempfile.TemporaryDirectory() as folder:
        for python in pythons:
            places = [part for each in PLATFORMS[platform] for part in ("--platform", each)]
            subprocess.run(
                [sys.executable, "-m", "pip", "download", "--quiet", "--only-binary=:all:", "--dest", folder,
                 "--python-version", python, *places, wheel], check=True,
            )  # fmt: skip
        wheels = sorted(each for each in Path(folder).glob("*.whl") if not each.name.startswith("numpy-"))
        manifest = (EXTENSION / "blender_manifest.toml").read_text(encoding="utf-8")
        manifest = re.sub(
            r'^version = ".*"', f'version = "{octex.__version__}"', manifest, flags=re.MULTILINE
        )
        lists = {"platforms": [platform], "wheels": [f"./wheels/{each.name}" for each in wheels]}
        lines = [f"{name} = {json.dumps(items)}" for name, items in lists.items()]
        head, mark, rest = manifest.partition("\n[permissions]")
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("blender_manifest.toml", "\n".join([head.rstrip(), *lines, ""]) + mark + rest)
            for each in sorted(EXTENSION.glob("*.py")):
                archive.write(each, each.name)
            for each in wheels:
                archive.write(each, f"wheels/{each.name}", zipfile.ZIP_STORED)
    return path


def check(path: Path, python: Path) -> None:
    """Have Blender validate an extension, install it, and make a texture with it."""
    where = subprocess.run(
        [python, "-c", "import bpy; print(bpy.utils.resource_path('LOCAL'))"], capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    tool = (
        Path(where.stdout.splitlines()[-1]) / "scripts" / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
    )
    subprocess.run([python, tool, "validate", path], check=True)
    with tempfile.TemporaryDirectory() as folder:
        variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        subprocess.run(
            [python, "-c", _CHECK, path, folder],
            env=variables | {"BLENDER_USER_RESOURCES": folder},
            cwd=folder,
            check=True,
        )
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
