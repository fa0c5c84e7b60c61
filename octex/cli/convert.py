"""octex convert and octex edit: write an octree texture, or a folder of parts."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import octex
from octex.ahead import ahead
from octex.cli.common import Reporter, check_folder, check_outputs, facts_of, report_file
from octex.cli.inputs import check_model, kind_of, note_layers, open_texture, read_model, refuse, repair_facts
from octex.cli.options import RUNNING
from octex.cli.parser import Options, arguments
from octex.cli.values import (
    ARCHIVE_ENDING,
    BAKED_ENDINGS,
    PAGE_ENDING,
    PTEX_ENDING,
    TEXTURE_ENDINGS,
    Address,
    FunctionName,
)
from octex.errors import ArgumentError, InputError, OutputError
from octex.files import count_text

if TYPE_CHECKING:
    from octex.source.cloud import PointCloud
    from octex.source.parts import Overlaps
    from octex.source.surface import Surface
    from octex.source.voxels import Voxels
    from octex.texture import OctreeTexture

INDEX = "set.json"  # equals octex.texture.set.INDEX
OUTPUT_ENDINGS = *TEXTURE_ENDINGS, ".ply", ".npz", ".osl"
_LINES = 10  # largest number of parts in the report
_SETTINGS = "depth", "cell", "channels", "dtype", "max_error", "detail"
_STORED = {"--channels", "--dtype", "--preview"}
#: The options for each kind of INPUT; a model takes all.
_FOR: dict[str, set[str]] = {
    "texture": {"--preview"},
    "cloud": {"--depth", "--cell", *_STORED},
    "voxels": _STORED,
}
_WHY = {
    "texture": "needs the model, but this is a texture made from it; see octex edit",
    "cloud": "needs a surface, and these are points",
    "voxels": "is not for voxels, which have their own depth",
}


def convert(options: Options, program: str) -> int:
    """Run octex convert."""
    _check(options)
    return _convert_parts(options, program) if options.parts else _convert(options, program)


def _check(options: Options) -> None:
    """Refuse options that contradict each other or the kind of INPUT."""
    path, kind = options.INPUT, kind_of(options.INPUT)
    if path.suffix.lower() == PTEX_ENDING:
        raise ArgumentError(f"{path}: holds texels of a mesh: convert its mesh with --transfer {path}")
    check_model(options, path)
    if options.depth is not None and options.cell is not None:
        raise ArgumentError("--depth and --cell both set the cell size; give one of them")
    if options.parts:
        refuse(options, ("--separate", "--preview", "--memory"), "cannot be used with --parts")
    if kind != "model":
        refuse(options, set(options.words).difference(_FOR[kind], RUNNING), _WHY[kind], path)
    check_output_kind(path, options.OUTPUT)


def check_output_kind(path: Path | Address, output: Path) -> None:
    """Refuse an output that another command writes."""
    ending = output.suffix.lower()
    model = "MODEL" if path.suffix.lower() in TEXTURE_ENDINGS else path
    if ending == PAGE_ENDING:
        raise ArgumentError(f"{output}: a page is written by octex view TEXTURE {model} {output}")
    if ending in BAKED_ENDINGS and ending not in OUTPUT_ENDINGS:
        raise ArgumentError(
            f"{output}: a texture is baked onto its model: octex bake TEXTURE {model} {output}"
        )


def _convert(options: Options, program: str) -> int:
    path, output = options.INPUT, options.OUTPUT
    outputs = (output, OUTPUT_ENDINGS, "OUTPUT"), (options.preview, (".png",), "--preview")
    sources = [each.path if isinstance(each, FunctionName) else each for _, each in options.source]
    sources = [each for each in sources if isinstance(each, Path)]
    inputs = [path, *sources, options.rest, options.transfer, *options.also]
    check_outputs(outputs, inputs, force=options.force)
    kind = kind_of(path)
    if kind == "texture" and output.suffix.lower() == path.suffix.lower():
        raise ArgumentError(f"{path}: is an octree texture already; octex edit makes it coarser or smaller")
    overlaps: Overlaps | None = None
    model: PointCloud | Voxels | Surface
    surface: Surface | None = None
    stages = ("convert", "preview") if options.preview is not None else ("convert",)
    is_shared = options.threads is None and kind == "model"
    with Reporter(program, options.quiet) as progress, ahead(*stages if is_shared else ()):
        if kind == "texture":
            texture = open_texture(path)
        else:
            with progress.stage("read"):
                if kind == "cloud":
                    model = octex.PointCloud.load(path)
                elif kind == "voxels":
                    model = octex.Voxels.load(path)
                else:
                    model = surface = read_model(path, options)
            if options.separate is not None and surface is not None:
                with progress.stage("separate"):
                    model, overlaps = octex.separate(
                        surface, options.separate, depth=options.depth, cell=options.cell
                    )
                    surface = model
            target = None if options.memory is None else output
            run = octex.Run(memory=options.memory, progress=progress)
            texture = octex.convert(
                model, **arguments(options, *_SETTINGS), fit=not options.no_fit, path=target, run=run
            )
        if options.preview is not None:  # first: if the disk is full, no OUTPUT exists without a report
            with progress.stage("draw"):
                octex.write_preview(options.preview, texture, surface)
        if options.memory is None:
            write_texture(texture, output, progress)
    text, facts = facts_of(texture)
    lines: list[str] = []
    empty = 0 if surface is None else json.loads(texture.metadata["convert"]).get("empty", 0)
    if empty:
        facts["empty"] = empty
        # With leaves of several sizes, the number of finest cells says little.
        is_even = options.max_error is None and options.detail is None
        share = f" ({100 * empty / (empty + texture.tree.n_leaves):.3g} %)" if is_even else ""
        faces = " with the same facing" if "max_angle" in options.within else ""
        lines.append(f"{empty:,} finest cells{share} stay empty: no source is near enough{faces}")
    repair, repair_lines = repair_facts(surface)
    facts |= repair
    lines += repair_lines
    if overlaps is not None:
        separation = json.loads(texture.metadata.get("separation", '{"moved": {}}'))
        facts["separated"] = {**overlaps_as_json(overlaps), "moved": separation["moved"]}
        lines += _separated_text(separation["moved"], overlaps)
    others = {"preview": (options.preview, "an image of it")}
    return report_file(options, text, facts, *lines, others=others)


def write_texture(texture: OctreeTexture, path: Path, progress: Reporter, loss: int = 0) -> None:
    """Write a texture in the format of the ending; .octz may change stored integers by up to ``loss``."""
    ending = path.suffix.lower()
    if ending in TEXTURE_ENDINGS:
        with progress.stage("write"):
            texture.save(path, max_error=loss)
    elif ending == ".npz":
        from octex.formats.npz import write_arrays

        write_arrays(texture, path, progress)
    elif ending == ".osl":
        with progress.stage("write"):
            octex.write_osl(texture, path)
    else:
        from octex.formats.ply import write_points

        write_points(texture, path, progress)


def overlaps_as_json(parts: Overlaps) -> dict[str, Any]:
    """Return overlapping parts for JSON; a gap beyond the margin, and an unknown volume, are null."""
    pairs = [pair._asdict() for pair in parts.pairs]
    for pair in pairs:
        pair["gap"] = pair["gap"] if math.isfinite(pair["gap"]) else None
    return {"parts": parts.n_parts, "pairs": pairs, "unchecked": [each._asdict() for each in parts.unchecked]}


def _separated_text(moved: dict[str, list[float]], parts: Overlaps) -> Iterator[str]:
    if moved:
        yield f"{len(moved):,} of {parts.n_parts:,} parts moved apart; Surface.rest_positions says where to"
        for part, offset in list(moved.items())[:_LINES]:
            yield f"  part {part} by {', '.join(f'{step:.6g}' for step in offset)}"
        if len(moved) > _LINES:
            yield f"  and {len(moved) - _LINES:,} more; --json lists them"
    elif parts.n_parts > 1:
        yield f"{parts.n_parts:,} parts, none too close to another: none moved"
    else:
        yield "one part: nothing to move apart, even where it intersects itself"
    if parts.unchecked:
        yield (
            f"{len(parts.unchecked):,} of them are not closed solids: only their surfaces were checked, not "
            "their inside; octex overlaps lists them"
        )


def _convert_parts(options: Options, program: str) -> int:
    folder = options.OUTPUT
    _check_folder(folder, force=options.force)
    with Reporter(program, options.quiet) as progress:
        with progress.stage("read"):
            surface = read_model(options.INPUT, options)
        settings = arguments(options, *_SETTINGS)
        textures = octex.convert_set(surface, **settings, fit=not options.no_fit, progress=progress)
        with progress.stage("write"):
            textures.save(folder)
    leaves = sum(texture.tree.n_leaves for texture in textures.values())
    repair, repair_lines = repair_facts(surface)
    facts = {"parts": len(textures), "leaves": leaves, "bytes": textures.info()["bytes"], **repair}
    text = f"{count_text(len(textures), 'part')}, {count_text(leaves, 'leaf', 'leaves')}"
    return report_file(options, text, facts, *repair_lines)


def _check_folder(folder: Path, *, force: bool) -> None:
    """Refuse a folder that cannot or must not be written, before any work starts."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; --parts writes a folder, give OUTPUT another name")
    if folder.suffix.lower() in OUTPUT_ENDINGS:
        raise ArgumentError(f"{folder}: --parts writes a folder; give OUTPUT no ending")
    if (folder / INDEX).exists() and not force:
        raise OutputError(f"{folder}: holds a texture set already; --force replaces it")
    check_folder(folder, folder if folder.exists() else folder.parent)


def edit(options: Options, program: str) -> int:
    """Run octex edit."""
    check_output_kind(options.TEXTURE, options.OUTPUT)
    if options.OUTPUT.suffix.lower() != ARCHIVE_ENDING:
        refuse(options, ["--loss"], f"is for NAME{ARCHIVE_ENDING}")
    others = [options.combine, options.mix and options.mix[0]]
    outputs = [(options.OUTPUT, OUTPUT_ENDINGS, "OUTPUT")]
    check_outputs(outputs, [options.TEXTURE, *others], force=options.force)
    with Reporter(program, options.quiet) as progress:
        texture = _edited(options, progress)
        write_texture(texture, options.OUTPUT, progress, options.loss)
    return report_file(options, *facts_of(texture))


def _edited(options: Options, progress: Reporter) -> OctreeTexture:
    from octex.processing.edit import with_operation

    texture = open_texture(options.TEXTURE)
    note_layers(texture, options.TEXTURE, progress.note)
    if options.channels is not None:
        from octex.checks import as_choice

        for name in options.channels:
            as_choice(name, texture.channels, f"channel of {options.TEXTURE}:")
    if options.crop is not None:
        texture = octex.crop(texture, options.crop[:3], options.crop[3:])
    if options.depth is not None:
        deepest = texture.tree.max_depth
        if options.depth > deepest:
            raise InputError(
                f"{options.TEXTURE}: has depth {deepest}; for --depth {options.depth} convert the model again"
            )
        # octex.resize would also divide the leaves above it, into cells without new detail.
        coarse = texture.level(options.depth)
        metadata = with_operation(texture.metadata, "resize", depth=options.depth)
        texture = texture.with_cells(coarse.tree, coarse.channels, metadata)
    if options.combine is not None:
        texture = octex.combine(texture, open_texture(options.combine), over=True)
    if options.mix is not None:
        other, amount = options.mix
        texture = octex.mix(texture, open_texture(other), amount)
    if options.blur is not None:
        texture = octex.blur(texture, options.blur)
    if options.levels is not None:
        texture = octex.levels(texture, "base_color", *options.levels)
    if options.channels is not None or options.dtype is not None:
        texture = octex.cast(texture, options.dtype, options.channels)
    return texture
