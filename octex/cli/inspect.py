"""octex info, validate, diff and overlaps: describes, checks and compares textures; octex warm-up."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import octex
from octex.ahead import SECTIONS, ahead, compile_listed
from octex.cli.common import Reporter, print_result, report, say
from octex.cli.convert import INDEX, overlaps_as_json
from octex.cli.inputs import check_model, check_texture, is_texture, open_texture, read_model, refuse
from octex.cli.parser import Options
from octex.cli.values import Address
from octex.errors import ExitCode, TextureFileError
from octex.files import count_text, open_file

if TYPE_CHECKING:
    from octex.drawing.compare import Difference, Differences, Side
    from octex.texture import OctreeTexture, TextureSet


def info(options: Options, _program: str) -> int:
    """Run octex info."""
    information = _opened(options.TEXTURE).info()
    lines = _set_text if "parts" in information else _texture_text
    print_result(options, information, lines(information))
    return ExitCode.DONE


def validate(options: Options, _program: str) -> int:
    """Run octex validate."""
    path = options.TEXTURE
    if isinstance(path, Address):  # an unreadable file is not a broken one
        from octex.remote import RemoteFile

        RemoteFile(str(path))
    else:
        with open_file(path / INDEX if path.is_dir() else path):
            pass
    broken = None
    try:
        _opened(path).validate()
    except TextureFileError as error:
        broken = str(error)
    facts = {"file": str(path), "valid": broken is None, "broken": broken}
    report(options, facts, broken or "valid")
    return ExitCode.DONE if broken is None else ExitCode.INVALID


def overlaps(options: Options, program: str) -> int:
    """Run octex overlaps."""
    path = options.MODEL
    with Reporter(program, options.quiet) as progress:
        with progress.stage("read"):
            surface = octex.load_surface(path, options.rest, channels=["alpha"], sources={"alpha": 1.0})
        with progress.stage("compare"):
            pairs = surface.overlapping_parts(options.margin)
    facts = {"model": str(path), "margin": pairs.margin, **overlaps_as_json(pairs)}
    print_result(options, facts, [f"{path}: {pairs}"])
    return ExitCode.DONE


def diff(options: Options, program: str) -> int:
    """Run octex diff."""
    paths = options.TEXTURE, options.OTHER
    if is_texture(options.OTHER):
        words = "--points", "--source", "--rest", "--subdiv"
        refuse(options, words, f"needs a model, but {paths[0]} and {paths[1]} are textures")
    else:
        check_model(options, options.OTHER)
    with Reporter(program, options.quiet) as progress:
        with progress.stage("read"):
            texture = open_texture(options.TEXTURE)
            # Light is multiplied by alpha, so a model's alpha is needed if the texture has one.
            extra = ["alpha"] if "alpha" in texture.channels else []
            other: Side
            if is_texture(options.OTHER):
                other = open_texture(options.OTHER)
            else:
                other = read_model(options.OTHER, options, extra)
        points = {} if options.points is None else {"points": options.points}
        differences = octex.difference(texture, other, channels=options.channels, **points, progress=progress)
    facts = {
        "a": str(paths[0]),
        "b": str(paths[1]),
        "points": differences.points,
        "width": differences.width,
        "channels": {name: _as_json(result) for name, result in differences.items()},
        "unmatched": dict(zip("ab", map(list, differences.unmatched), strict=True)),
        "areas": dict(zip("ab", differences.areas, strict=True)),
        "uncovered": dict(zip("ab", differences.uncovered, strict=True)),
    }
    print_result(options, facts, _readable(paths, (texture, other), differences))
    return ExitCode.DONE


def warm_up(options: Options, program: str) -> int:
    """Run octex warm-up."""
    with Reporter(program, options.quiet, announce=False) as progress, ahead(*SECTIONS):
        compile_listed(progress)
    if not options.quiet:
        say(f"compiled and cached in {time.perf_counter() - options.began:.1f} s")
    return ExitCode.DONE


def _opened(path: Path | Address) -> OctreeTexture | TextureSet:
    if path.is_dir():
        return octex.TextureSet.open(path)
    check_texture(path)
    return octex.open(str(path))


def _texture_text(information: dict[str, Any]) -> Iterator[str]:
    placement, bounds, parts = (information[key] for key in ("placement", "bounds", "bytes"))
    yield f"depth       {information['depth']}, finest cells of edge {information['finest_cell']:.6g}"
    yield f"root cell   edge {placement['size']:.6g} at {triple(placement['origin'])}"
    yield f"bounds      {triple(bounds[0])} to {triple(bounds[1])}"
    longest = max((len(channel["name"]) for channel in information["channels"]), default=0)
    for number, channel in enumerate(information["channels"]):
        stored = f"{channel['components']} x {channel['dtype']:7}  {channel['space']}"
        yield f"{'' if number else 'channels':10}  {channel['name']:{longest}}  {stored}"
    yield ""
    yield f"{'level':>5} {'leaves':>15} {'nodes':>15}"
    for level in information["levels"]:
        yield f"{level['level']:5} {level['leaves']:15,} {level['nodes']:15,}"
    yield f"{'all':>5} {information['leaves']:15,} {information['nodes']:15,}"
    yield ""
    leaves = max(information["leaves"], 1)
    archive = information.get("archive", {})
    if archive:
        parts = {f"archive: {part}": size for part, size in archive.items()}
        parts |= {"archive: total": sum(archive.values()), "as .octex": information["bytes"]["total"]}
    yield f"{'part':32} {'bytes':>15} {'a leaf':>7}"
    for part, size in parts.items():
        yield f"{part:32} {size:15,} {size / leaves:7.2f}"
    if information["provenance"]:
        yield ""
    width = max(map(len, information["provenance"]), default=0)
    for name, text in information["provenance"].items():
        for number, line in enumerate(_lines(text)):
            yield f"{'' if number else name:{width}}  {line}"


def _lines(text: str) -> list[str]:
    """Return a text, or each entry of a JSON object, as lines."""
    with suppress(ValueError):
        entries = json.loads(text)
        if isinstance(entries, dict) and entries:
            return [
                f"{key}: {value if isinstance(value, str) else json.dumps(value)}"
                for key, value in entries.items()
            ]
    return [text]


def triple(numbers: Sequence[float]) -> str:
    """Format a position."""
    return "(" + ", ".join(f"{number:.6g}" for number in numbers) + ")"


def _set_text(information: dict[str, Any]) -> Iterator[str]:
    parts = information["parts"]
    width = max(len("part"), *map(len, parts))
    yield f"{'part':{width}} {'depth':>5} {'finest cell':>12} {'leaves':>15} {'nodes':>15} {'bytes':>15}"
    for name, part in parts.items():
        yield (
            f"{name:{width}} {part['depth']:5} {part['finest_cell']:12.6g} {part['leaves']:15,} "
            f"{part['nodes']:15,} {part['bytes']['total']:15,}"
        )
    leaves, nodes = (sum(part[each] for part in parts.values()) for each in ("leaves", "nodes"))
    yield f"{'all':{width}} {'':5} {'':12} {leaves:15,} {nodes:15,} {information['bytes']:15,}"


def _as_json(result: Difference) -> dict[str, Any]:
    """Return a difference for JSON; non-finite numbers become null."""
    fields: dict[str, Any] = result._asdict()
    if fields.pop("angle") is not None and result.angle is not None:
        fields["angle"] = _as_json(result.angle)
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in fields.items()
    }


def _readable(paths: Sequence[Path], sides: Sequence[Side], differences: Differences) -> Iterator[str]:
    from octex.source.surface import Surface

    for letter, path, side in zip("AB", paths, sides, strict=True):
        if isinstance(side, Surface):
            yield f"{letter}  {path}: a model of {count_text(len(side.triangles), 'triangle')}"
        else:
            leaves = count_text(side.tree.n_leaves, "leaf", "leaves")
            yield f"{letter}  {path}: an octree texture of depth {side.tree.max_depth}, {leaves}"
    if differences.width is None:
        yield f"at the centres of {differences.points:,} leaves, those of both, by area"
    else:
        yield f"at {differences.points:,} points, uniform by area, both averaged over {differences.width:.4g}"
    for letter, names in zip("AB", differences.unmatched, strict=True):
        if names:
            yield f"only {letter} has the channel{'s' if len(names) > 1 else ''} {', '.join(names)}"
    for letter, other, part in zip("AB", "BA", differences.uncovered, strict=True):
        if part:
            yield f"{100 * part:.3g} % of {letter}'s surface is not in {other}; it is left out"
    if abs(differences.areas[0] - differences.areas[1]) > 0.1 * max(differences.areas):
        yield f"A has an area of {differences.areas[0]:.4g}, B of {differences.areas[1]:.4g}"
    yield ""
    rows: list[tuple[str, ...]] = [
        ("channel", "measure", "rms", "PSNR", "p99", "maximum", "where", "A there", "B there")
    ]
    for name, result in differences.items():
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
    """Format a value with about three digits."""
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.4f}".rstrip("0").rstrip(".")
