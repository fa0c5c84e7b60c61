"""octex paint: paints images through cameras, or layers, into an octree texture."""

from __future__ import annotations

from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import octex
from octex.ahead import ahead
from octex.cli.common import Reporter, check_outputs, facts_of, fail, identity, tell_file
from octex.cli.inputs import bare_model, is_texture, only, open_texture, refuse, shaped_model, tell_layers
from octex.cli.layers import Painting, channel_of, with_entries
from octex.cli.options import DEFAULT_CHANNEL
from octex.cli.parser import Options
from octex.cli.shots import NOTHING, flat_shots, images_of, shots_of
from octex.cli.values import TEXTURE_ENDING
from octex.errors import ArgumentError, ExitCode
from octex.parallel import workers

if TYPE_CHECKING:
    from octex.arrays import Float64s
    from octex.painting.unwrap import Patch
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture

#: The options that merging layers accepts.
_OF_LAYERS = {"--blend", "--opacity", "--preview", "--rest", "--pose", "--subdiv"}
_OF_LAYERS |= {"--force", "--threads", "--quiet", "--json"}


def paint(options: Options, program: str) -> int:
    """Run octex paint."""
    has_layers = _check(options, program)
    _check_files(options)
    with ahead("paint") if options.threads is None and not has_layers else nullcontext():
        return _paint(options, program, has_layers)


def _check(options: Options, program: str) -> bool:
    """Refuse contradictory options; return whether to merge layers instead of images."""
    layers = [path for path in options.IMAGE if is_texture(path)]
    if layers:
        if len(layers) < len(options.IMAGE):
            raise ArgumentError(
                f"{layers[0]}: is a layer; merge layers and paint pictures one after the other. A "
                "texture to paint on stands before its model"
            )
        refuse(options, set(options.words) - _OF_LAYERS, "cannot be used with layers")
    elif options.unwrap is not None:
        refuse(options, ["--camera"], "cannot be used with --unwrap, which sets the view")
        if not options.IMAGE:
            raise ArgumentError(f"IMAGE is missing; see {program} --help")
    elif options.camera is None:
        raise ArgumentError(f"--camera is missing; see {program} --help")
    if options.holes is not None and options.TEXTURE is not None:
        raise ArgumentError(f"{options.TEXTURE} has colours; --holes is for a new texture")
    if options.blend == "erase" and options.TEXTURE is None:
        raise ArgumentError("there is no TEXTURE; there is nothing to erase")
    if options.reference is not None and options.balance is None and options.refine_cameras is None:
        raise ArgumentError("--reference needs --balance or --refine-cameras")
    files = [each for each in options.mask if not isinstance(each, tuple)]
    if len(options.mask) - len(files) > 1:
        raise ArgumentError("--mask gives several backdrop colours; give one")
    if any(isinstance(each, str) for each in files) and len(files) > 1:
        raise ArgumentError("--mask gives a pattern and more masks; give one of them")
    if len(files) > 1 and len(files) != len(options.IMAGE):
        raise ArgumentError(
            f"--mask gives {len(files)} for {len(options.IMAGE)} IMAGEs; give one for all, or one an IMAGE"
        )
    return bool(layers)


def _check_files(options: Options) -> None:
    outputs = (
        (options.OUTPUT, (TEXTURE_ENDING,), "OUTPUT"),
        (options.layer_out, (TEXTURE_ENDING,), "--layer-out"),
        (options.refine_cameras, (".json",), "--refine-cameras"),
        (options.preview, (".png",), "--preview"),
    )
    # OUTPUT may replace TEXTURE: the old file stays until all work is done.
    texture = options.TEXTURE
    is_replaced = texture is not None and identity(texture) == identity(options.OUTPUT)
    masks = [each for each in options.mask if not isinstance(each, tuple | str)]
    camera = options.camera and options.camera[0]
    inputs = [options.MODEL, options.rest, camera, *images_of(options), *masks, options.since]
    check_outputs(outputs, [*inputs, None if is_replaced else texture], force=options.force)


def _paint(options: Options, program: str, has_layers: bool) -> int:
    with Reporter(program, options.quiet) as progress:
        by_camera = not (has_layers or options.unwrap)
        shots, skipped = shots_of(options, progress) if by_camera else ([], [])
        texture = None if options.TEXTURE is None else open_texture(options.TEXTURE)
        if texture is None:
            progress.note("there is no texture yet: painting begins a new one")
        else:
            tell_layers(texture, options.TEXTURE, progress.note)
        with progress.stage("read"):
            if options.preview is None:
                surface = whole = bare_model(options.MODEL, options)
            else:
                surface = whole = shaped_model(options.MODEL, options, normals=True)
        if options.unwrap is not None:
            patch, shots = flat_shots(options, whole, texture, progress)
            surface = patch.surface
        for shot in shots:
            if shot.since is not None and shot.path.suffix.lower() in (".jpg", ".jpeg"):
                progress.note(
                    f"{shot.path} is a JPEG: what compression changed is painted, too; save views as PNG"
                )
        with workers() as executor:
            painting = Painting(options, surface, executor, progress)
            if by_camera:
                shots, left_out = painting.fitting(shots)
                skipped = [*skipped, *left_out]
            if options.refine_cameras is not None:
                shots = painting.refined(shots)
            if has_layers:
                layers = [open_texture(path) for path in options.IMAGE]
            else:
                texture, layers = painting.projected(texture, shots)
            base, is_in = painting.started(layers[0], has_layers) if texture is None else (texture, False)
            made = painting.merged(base, layers, options.IMAGE if has_layers else [], int(is_in))
        if made is base and not is_in:
            return _nothing_painted(options, program, any(shot.since for shot in shots))
        entries = painting.entries([shot.path for shot in shots] or options.IMAGE, layers[0])
        made = with_entries(made, surface, entries)
        if options.preview is not None:  # first: if the disk is full, no OUTPUT exists without a report
            with progress.stage("draw"):
                view: dict[str, Any] = {}
                if options.unwrap is not None:
                    view = {"direction": _direction_to(whole, patch)}
                elif shots:
                    from octex.drawing import viewpoint_among

                    seen = viewpoint_among([shot.camera for shot in shots])
                    view = {"direction": seen.direction, "up": seen.up}
                _draw(options, made, whole, channel_of(layers[0]), view)
        with progress.stage("write"):
            if options.layer_out is not None:
                with_entries(layers[0], surface, entries).save(options.layer_out)
            made.save(options.OUTPUT)
    names = [str(entry["image"]) for entry in entries]
    kind = f"{'layer' if has_layers else 'picture'}{'s' if len(names) > 1 else ''}"
    text, facts = facts_of(made)
    facts |= {"painted": names, "skipped": list(skipped)}
    others = {
        "layer": (options.layer_out, "the paint alone"),
        "preview": (options.preview, "a picture of it"),
    }
    return tell_file(options, f"{len(names):,} {kind} painted, {text}", facts, others=others)


def _nothing_painted(options: Options, program: str, compares: bool) -> int:
    reasons = [
        "no camera sees the model (do they look away from it or stand inside it, or have other coordinates?)",
        "the pictures' alpha, the mask or --opacity are zero all over",
        *([f"nothing was drawn on the view (--since {NOTHING} paints all of it)"] if compares else []),
    ]
    reason = ", or ".join(reasons)
    message = f"nothing was painted, and {options.OUTPUT} is not written: {reason}"
    return fail(program, message, ExitCode.NOTHING_PAINTED)


def _direction_to(surface: Surface, patch: Patch) -> Float64s:
    """Return the direction (3,) that the patch faces: its mean normal."""
    import numpy as np

    first, second, third = surface.vertices[surface.triangles[patch.triangles]].swapaxes(0, 1)
    direction: Float64s = np.cross(second - first, third - first).sum(axis=0)
    return direction


def _draw(
    options: Options, texture: OctreeTexture, surface: Surface, channel: str, view: dict[str, Any]
) -> None:
    """Write --preview: next to the model's own colours if it has the channel."""
    shown: Surface | None = surface
    if channel != DEFAULT_CHANNEL:
        has_channel = channel in [form.name for form in surface.channels]
        shown = surface.with_channels([channel]) if has_channel else None
        texture = texture if has_channel else only(texture, channel)
    octex.write_preview(options.preview, texture, shown, **view)
