"""Entry points; an interrupt during the imports ends in one line, too."""

from __future__ import annotations

import sys


def octex() -> int:
    """Run octex, and return its exit code."""
    return _start("octex")


def octree_convert() -> int:
    """Run octex convert under its own name, and return its exit code."""
    return _start("octree-convert", "convert")


def octree_paint() -> int:
    """Run octex paint under its own name, and return its exit code."""
    return _start("octree-paint", "paint")


def _start(program: str, *command: str) -> int:
    try:
        from octex.cli.main import main

        return main([*command, *sys.argv[1:]], program if command else None)
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return 130  # ExitCode.INTERRUPTED, which is not imported yet
