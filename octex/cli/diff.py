"""octree-convert --diff: how two textures, or a texture and a model, differ over the surface."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octex.cli.addresses import TEXTURE_ENDINGS
from octex.cli.common import Reporter, check_outputs, tell
from octex.cli.convert_options import OF_MODELS
from octex.cli.inspect import triple
from octex.cli.models import input_files, open_sound, read_model
from octex.cli.parser import words_given
from octex.errors import ArgumentError, ExitCode

if TYPE_CHECKING:
    from octex.drawing.compare import Difference, Differences, Side


def diff(command: str, options: argparse.Namespace) -> int:
    """Say how A and B differ; draw it if asked to."""
    paths: list[Path] = options.diff
    if options.preview is not None:
        inputs = [*paths, *input_files(options)]
        check_outputs([(options.preview, (".png",), "--preview")], inputs, force=options.force)
    if all(path.suffix.lower() in TEXTURE_ENDINGS for path in paths):
        for word in words_given(options):
            if word in OF_MODELS:
                raise ArgumentError(f"{word} needs a model, but {paths[0]} and {paths[1]} are textures")
    elif not any(path.suffix.lower() in TEXTURE_ENDINGS for path in paths):
        raise ArgumentError(
            f"{paths[0]} and {paths[1]}: neither is an .octex file; convert one of them first"
        )

    from octex.drawing.compare import DEFAULT_POINTS, difference

    with Reporter(command, options.quiet) as progress:
        with progress.stage("read"):
            a, b = _sides(paths, options)
        found = difference(
            a, b, channels=options.channels, points=options.points or DEFAULT_POINTS, progress=progress
        )
        if options.preview is not None:
            from octex.drawing import write_difference

            with progress.stage("draw"):
                write_difference(options.preview, a, b, found, (paths[0].name, paths[1].name))
    picture = [] if options.preview is None else ["", f"{options.preview}: a picture of it"]
    told = {"a": str(paths[0]), "b": str(paths[1]), **as_json(found)}
    tell(options, told, *_readable(paths, (a, b), found), *picture)
    return ExitCode.DONE


def _sides(paths: Sequence[Path], options: argparse.Namespace) -> list[Side]:
    """Read both; of a model also alpha, by which light is multiplied, if the texture has it."""
    sides: dict[Path, Side] = {}
    beside: list[str] = []
    for path in paths:
        if path.suffix.lower() in TEXTURE_ENDINGS:
            sides[path] = texture = open_sound(path)
            beside = ["alpha"] if "alpha" in texture.channels else beside
    return [sides[path] if path in sides else read_model(path, options, beside) for path in paths]


def as_json(found: Differences) -> dict[str, Any]:
    """Return differences for a machine; what is not finite becomes null."""
    return {
        "points": found.points,
        "width": found.width,
        "channels": {name: _as_json(result) for name, result in found.items()},
        "unmatched": dict(zip("ab", map(list, found.unmatched), strict=True)),
        "areas": dict(zip("ab", found.areas, strict=True)),
        "uncovered": dict(zip("ab", found.uncovered, strict=True)),
    }


def _as_json(result: Difference) -> dict[str, Any]:
    fields: dict[str, Any] = result._asdict()
    if fields.pop("angle") is not None and result.angle is not None:
        fields["angle"] = _as_json(result.angle)
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in fields.items()
    }


def _readable(paths: Sequence[Path], sides: Sequence[Side], found: Differences) -> Iterator[str]:
    """Yield the lines of differences for a person."""
    for letter, path, side in zip("AB", paths, sides, strict=True):
        yield f"{letter}  {path}: {_described(side)}"
    if found.width is None:
        yield f"at the centres of {found.points:,} leaves, those of both, by area"
    else:
        yield f"at {found.points:,} points, uniform by area, the model averaged over {found.width:.4g}"
    yield from _notes(found)
    yield ""
    rows: list[tuple[str, ...]] = [
        ("channel", "measure", "rms", "PSNR", "p99", "maximum", "where", "A there", "B there")
    ]
    for name, result in found.items():
        rows.append(_row(name, result))
        if result.angle is not None:
            rows.append(_row("", result.angle))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    right = range(2, 6)
    for row in rows:
        cells = [
            text.rjust(width) if column in right else text.ljust(width)
            for column, (text, width) in enumerate(zip(row, widths, strict=True))
        ]
        yield "  ".join(cells).rstrip()


def _row(name: str, result: Difference) -> tuple[str, ...]:
    psnr = "exact" if math.isinf(result.psnr) else f"{result.psnr:.2f} dB"
    numbers = (number(result.rms), psnr, number(result.p99), number(result.maximum))
    a, b = (", ".join(number(value) for value in values) for values in (result.a, result.b))
    return (name, result.measure, *numbers, triple(result.where), a, b)


def number(value: float) -> str:
    """Return a value of three digits or so."""
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.4f}".rstrip("0").rstrip(".")


def _notes(found: Differences) -> Iterator[str]:
    for letter, names in zip("AB", found.unmatched, strict=True):
        if names:
            yield f"only {letter} has the channel{'s' if len(names) > 1 else ''} {', '.join(names)}"
    for letter, other, part in zip("AB", "BA", found.uncovered, strict=True):
        if part:
            yield f"{100 * part:.3g} % of {letter}'s surface is not in {other}; it is left out"
    a, b = found.areas
    if abs(a - b) > 0.1 * max(a, b):
        yield f"A has an area of {a:.4g}, B of {b:.4g}"


def _described(side: Side) -> str:
    from octex.source.surface import Surface

    if isinstance(side, Surface):
        return f"a model of {len(side.triangles):,} triangles"
    tree = side.tree
    return f"an octree texture of depth {tree.max_depth}, {tree.n_leaves:,} leaves"
