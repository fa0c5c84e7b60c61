"""octex paint: paints images through cameras, or layers, into an octree texture."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import octex
from octex.ahead import ahead
from octex.cli.common import Reporter, check_outputs, facts_of, fail, identity, report_file
from octex.cli.inputs import bare_model, is_texture, note_layers, only, open_texture, refuse, shaped_model
from octex.cli.options import DEFAULT_CHANNEL, RUNNING, SHAPE
from octex.cli.parser import Options, arguments
from octex.cli.shots import NOTHING, InputImage, flat_shots, images_of, shots_of
from octex.cli.values import TEXTURE_ENDING
from octex.errors import ArgumentError, ExitCode
from octex.files import open_file
from octex.parallel import Run, usual_memory, workers

if TYPE_CHECKING:
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture

#: The options that merging layers accepts.
_OF_LAYERS = {"--blend", "--opacity", "--preview", *SHAPE, *RUNNING}


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
                f"{layers[0]}: is a layer; merge layers and paint images one after the other. A "
                "texture to paint on stands before its model"
            )
        refuse(options, set(options.words) - _OF_LAYERS, "cannot be used with layers")
    elif options.unwrap is not None:
        refuse(options, ["--camera"], "cannot be used with --unwrap, which sets the view")
        if not options.IMAGE:
            raise ArgumentError(f"IMAGE is missing; see {program} --help")
    elif options.camera is None:
        raise ArgumentError("--camera is missing: give the file with the cameras; see octex help cameras")
    if options.holes is not None and options.TEXTURE is not None:
        raise ArgumentError(f"{options.TEXTURE} has colours; --holes is for a new texture: leave it out")
    if options.blend == "erase" and options.TEXTURE is None:
        raise ArgumentError("--blend erase needs a TEXTURE to erase; name it before MODEL")
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
            note_layers(texture, options.TEXTURE, progress.note)
        with progress.stage("read"):
            if options.preview is None:
                surface = whole = bare_model(options.MODEL, options)
            else:
                surface = whole = shaped_model(options.MODEL, options, normals=True)
        if options.unwrap is not None:
            patch, shots = flat_shots(options, whole, texture, progress)
            surface = patch.surface
        for shot in shots:
            if shot.image.since is not None and shot.path.suffix.lower() in (".jpg", ".jpeg"):
                progress.note(
                    f"{shot.path} is a JPEG: what compression changed is painted, too; save views as PNG"
                )
        with workers() as executor:
            run = octex.Run(executor=executor, progress=progress)
            memory = options.memory or usual_memory()
            room = None if memory is None else options.OUTPUT.absolute().parent
            stored = replace(run, memory=memory, folder=room, resume=options.resume)
            if by_camera:
                shots, left_out = _fitting(surface, shots, run, progress)
                skipped += left_out
            if options.refine_cameras is not None:
                shots = _refined(options, surface, shots, stored)
            if has_layers:
                layers = [open_texture(path) for path in options.IMAGE]
                painted = _merged(options, surface, texture, layers, run)
            else:
                painted, layers = _painted(options, surface, texture, shots, stored, progress)
        if painted is None or options.opacity == 0:
            compares = any(shot.image.since is not None for shot in shots)
            return _nothing_painted(options, program, compares)
        channel = next((name for name in layers[0].channels if name != "alpha"), "alpha")
        entries = _entries(options, [shot.path for shot in shots] or options.IMAGE, channel)
        painted = _with_entries(painted, surface, entries)
        if options.preview is not None:  # first: if the disk is full, no OUTPUT exists without a report
            with progress.stage("draw"):
                view: dict[str, Any] = {}
                if options.unwrap is not None:
                    from octex.view.shading import face_normals

                    normals, areas = face_normals(whole.vertices, whole.triangles[patch.triangles])
                    view = {"direction": areas @ normals}
                elif shots:
                    from octex.drawing import viewpoint_among

                    cameras: Any = [shot.image.camera for shot in shots]
                    seen = viewpoint_among(cameras)
                    view = {"direction": seen.direction, "up": seen.up}
                _draw(options, painted, whole, channel, view)
        with progress.stage("write"):
            if options.layer_out is not None:
                _with_entries(layers[0], surface, entries).save(options.layer_out)
            painted.save(options.OUTPUT)
    names = [str(entry["image"]) for entry in entries]
    kind = f"{'layer' if has_layers else 'image'}{'s' if len(names) > 1 else ''}"
    text, facts = facts_of(painted)
    facts |= {"painted": names, "skipped": skipped}
    others = {
        "layer": (options.layer_out, "the paint alone"),
        "preview": (options.preview, "an image of it"),
    }
    return report_file(options, f"{len(names):,} {kind} painted, {text}", facts, others=others)


def _fitting(
    surface: Surface, shots: list[InputImage], run: Run, progress: Reporter
) -> tuple[list[InputImage], list[str]]:
    """Return the images that fit the model, and the names of the others; note why."""
    images = [shot.image for shot in shots]
    if len(shots) < 2 or any(image.since is not None for image in images):
        return shots, []
    from octex.photos.misfits import misfits

    assert run.executor is not None
    reasons, better = misfits(surface, images, run.executor)
    for number, reason in sorted(reasons.items()):
        progress.note(f"{shots[number].path} is left out: {reason}")
    if better:
        progress.note(f"the mesh does not fit the cameras: {better}")
    fitting = [shot for number, shot in enumerate(shots) if number not in reasons]
    return fitting, [shots[number].path.name for number in sorted(reasons)]


def _refined(options: Options, surface: Surface, shots: Sequence[InputImage], run: Run) -> list[InputImage]:
    """Return the images with refined cameras, and write these cameras."""
    # By the frames' names, or the images' where a frame has several images.
    names = [shot.name for shot in shots]
    if len(set(names)) < len(names):
        names = [shot.path.name for shot in shots]
    if len(set(names)) < len(names):
        raise ArgumentError("--refine-cameras finds cameras by file name: rename images that have one name")
    images, reference = [shot.image for shot in shots], _reference(options, shots)
    cameras = octex.refine_cameras(surface, images, reference=reference, run=run)
    # The next steps may take hours, so the cameras are written now.
    octex.write_cameras(options.refine_cameras, dict(zip(names, cameras, strict=True)))
    pairs = zip(shots, cameras, strict=True)
    return [shot._replace(image=replace(shot.image, camera=camera)) for shot, camera in pairs]


def _painted(
    options: Options,
    surface: Surface,
    texture: OctreeTexture | None,
    shots: Sequence[InputImage],
    run: Run,
    progress: Reporter,
) -> tuple[OctreeTexture | None, list[OctreeTexture]]:
    """Paint images; return the texture, None for no paint, and the layers of paint."""
    from octex.painting.paint import painted_by
    from octex.painting.surface import PaintOptions

    settings = PaintOptions(
        **arguments(options, "max_depth", "edge_feather", "pictures", "balance"),
        **options.max_angle,
        channel=options.channel or DEFAULT_CHANNEL,
        reference=_reference(options, shots),
        fit=not options.no_fit,
    )
    images = [replace(shot.image, opacity=options.opacity) for shot in shots]
    layers: list[OctreeTexture] = []
    painted = painted_by(
        texture, surface, images, settings, run, _holes(options), coverage=options.coverage, layers=layers
    )
    count = sum(layer.tree.n_leaves for layer in layers)
    if texture is not None and count > texture.tree.n_leaves:
        progress.note(
            f"the paint has {count:,} leaves, the texture {texture.tree.n_leaves:,}; "
            f"--max-depth {texture.tree.max_depth} paints with cells as small as the texture's"
        )
    return painted if count and painted is not texture else None, layers


def _merged(
    options: Options,
    surface: Surface,
    texture: OctreeTexture | None,
    layers: Sequence[OctreeTexture],
    run: Run,
) -> OctreeTexture | None:
    """Merge layers, the IMAGEs, into a texture or a new one; None if they paint nothing."""
    has_first_layer = False
    if texture is None:
        from octex.painting.first import started
        from octex.painting.surface import Job, PaintedSurface

        assert run.executor is not None
        job = Job(PaintedSurface(surface), run.executor, run.report)
        texture, has_first_layer = started(job, layers[0], "leave", options.blend)
    merged = texture
    for number, layer in enumerate(layers):
        if layer.tree.n_leaves and not (has_first_layer and number == 0):
            try:
                merged = octex.merge(
                    merged, layer, surface, opacity=options.opacity, blend=options.blend, run=run
                )
            except ArgumentError as error:
                raise ArgumentError(f"{options.IMAGE[number]}: {error}") from None
    return merged if has_first_layer or merged is not texture else None


def _reference(options: Options, shots: Sequence[InputImage]) -> int | None:
    path = options.reference
    if path is None:
        return None
    paths = [shot.path for shot in shots]
    for names, name in ((paths, path), ([path.name for path in paths], path.name)):
        if names.count(name) == 1:
            return names.index(name)
    raise ArgumentError(f"--reference {path} must name exactly one of the images")


def _holes(options: Options) -> Any:
    """Return the argument ``holes`` of octex.paint."""
    from octex.channels import CHANNELS

    if not isinstance(options.holes, tuple):
        return options.holes or "smooth"
    form = CHANNELS.get(options.channel or DEFAULT_CHANNEL)
    if form is not None and form.components == 1 and len(set(options.holes)) == 1:
        return options.holes[0] / 255
    return "#" + bytes(options.holes).hex()


def _entries(options: Options, files: Sequence[Path], channel: str) -> list[dict[str, str | float]]:
    """Return the provenance of the paint in files."""
    how = {"blend": options.blend, "opacity": options.opacity, "channel": channel}
    entries: list[dict[str, str | float]] = []
    for path in files:
        with open_file(path) as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        entries.append({"image": path.name, "sha256": digest, **how})
    return entries


def _with_entries(
    texture: OctreeTexture, surface: Surface, entries: Sequence[dict[str, str | float]]
) -> OctreeTexture:
    """Append paint to a texture's provenance; for a new texture also record the model."""
    from octex.processing.edit import with_listed

    metadata = dict(texture.metadata)
    if not metadata:
        names = ("source", "sha256", "rest", "rest_sha256")
        metadata = {name: surface.provenance[name] for name in names if name in surface.provenance}
        metadata["octex"] = octex.__version__
    metadata = with_listed(metadata, "paint", entries)
    return texture.with_cells(texture.tree, texture.channels, metadata)


def _nothing_painted(options: Options, program: str, compares: bool) -> int:
    reasons = [
        *([f"nothing was drawn on the view (--since {NOTHING} paints all of it)"] if compares else []),
        "no camera sees the model (do they look away from it or stand inside it, or have other coordinates?)",
        "the images' alpha, the mask or --opacity are zero all over",
    ]
    reason = ", or ".join(reasons)
    message = f"nothing was painted, and {options.OUTPUT} is not written: {reason}"
    return fail(program, message, ExitCode.NOTHING_PAINTED)


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
