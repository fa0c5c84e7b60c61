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


def load(path: Path, options: argparse.Namespace) -> Surface:
    """Read a model, and of its materials what is wanted and does not come from elsewhere."""
    wanted = options.channels
    if wanted is not None:
        wanted = [name for name in wanted if name not in sources_of(options)] or None
    return octex.load_surface(path, channels=wanted, filter=options.filter or DEFAULT_FILTER)


def completed(surface: Surface, options: argparse.Namespace) -> Surface:
    """Return a model at its rest positions, with what comes from elsewhere."""
    sources = sources_of(options)
    if options.rest is not None:
        from octex.source.load import at_rest

        surface = at_rest(surface, options.rest)
    if sources:
        surface = surface.with_sources(sources, options.filter or DEFAULT_FILTER)
    return surface if options.channels is None else surface.with_channels(options.channels)
