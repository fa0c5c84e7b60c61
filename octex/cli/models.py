"""Reads models as the options say."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import octex
from octex.errors import ArgumentError

if TYPE_CHECKING:
    from octex.source.surface import Surface

DEFAULT_FILTER = "ewa"


def sources_of(options: argparse.Namespace) -> dict[str, object]:
    """Return what channels are to come from, by their names.

    Raises ArgumentError for a channel given twice or not among those that are wanted.
    """
    sources: dict[str, object] = {}
    for name, given in options.source or []:
        if name in sources:
            raise ArgumentError(f"--source gives {name} twice")
        if options.channels is not None and name not in options.channels:
            raise ArgumentError(f"--source gives {name}, but --channels leaves it out")
        sources[name] = given
    return sources


def source_files(options: argparse.Namespace) -> list[Path]:
    """Return the image files that channels are to come from."""
    return [given for _, given in options.source or [] if isinstance(given, Path)]


def read_model(path: Path, options: argparse.Namespace) -> Surface:
    """Read a model at its rest positions, with the channels that are wanted, wherever they come from."""
    return octex.load_surface(
        path,
        options.rest,
        channels=options.channels,
        sources=sources_of(options),
        filter=options.filter or DEFAULT_FILTER,
    )
