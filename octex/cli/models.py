"""Reads models as the options say."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import octex
from octex.cli.arguments import STRETCH
from octex.errors import ArgumentError

if TYPE_CHECKING:
    from octex.source.surface import Surface

DEFAULT_FILTER = "ewa"


def sources_of(options: argparse.Namespace) -> dict[str, object]:
    """Return what channels are to come from, by their names.

    Raises ArgumentError for a channel given twice or not among those that are wanted.
    """
    sources: dict[str, object] = {}
    wanted = _wanted(options)
    for name, given in options.source or []:
        if name in sources:
            raise ArgumentError(f"--source gives {name} twice")
        if wanted is not None and name not in wanted:
            raise ArgumentError(f"--source gives {name}, but --channels leaves it out")
        sources[name] = given
    return sources


def _wanted(options: argparse.Namespace) -> list[str] | None:
    """Return the channels to read: those to convert or compare, and the one that says how deep to go."""
    steering = None if options.detail == STRETCH else options.detail
    if options.channels is None or steering is None or steering in options.channels:
        return options.channels  # type: ignore[no-any-return]
    return [*options.channels, steering]


def source_files(options: argparse.Namespace) -> list[Path]:
    """Return the image files that channels are to come from."""
    return [given for _, given in options.source or [] if isinstance(given, Path)]


def read_model(path: Path, options: argparse.Namespace) -> Surface:
    """Read a model at its rest positions, with the channels that are used, wherever they come from."""
    return octex.load_surface(
        path,
        options.rest,
        channels=_wanted(options),
        sources=sources_of(options),
        filter=options.filter or DEFAULT_FILTER,
    )
