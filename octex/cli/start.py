"""Starts the commands: also one that is interrupted while Python imports it says so in one line."""

from __future__ import annotations

import sys
from importlib import import_module

#: The module of each command.
MODULES = {
    "octex": "octex.cli.main",
    "octree-convert": "octex.cli.convert",
    "octree-paint": "octex.cli.paint",
}


def octex() -> int:
    """Run octex, and return its exit code."""
    return _start("octex")


def octree_convert() -> int:
    """Run octree-convert, and return its exit code."""
    return _start("octree-convert")


def octree_paint() -> int:
    """Run octree-paint, and return its exit code."""
    return _start("octree-paint")


def _start(command: str) -> int:
    try:
        code: int = import_module(MODULES[command]).main()
    except KeyboardInterrupt:
        print(f"{command}: interrupted", file=sys.stderr)
        return 130  # ExitCode.INTERRUPTED, which is not imported yet
    return code
