"""Layers of paint: pictures are projected into them, they are merged and recorded in the metadata."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import octex
from octex.cli.common import Reporter
from octex.cli.options import DEFAULT_CHANNEL
from octex.cli.parser import Options
from octex.cli.shots import Shot
from octex.errors import ArgumentError
from octex.files import open_file

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from octex.painting.pictures import Projection
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture


def projected(
    options: Options,
    texture: OctreeTexture | None,
    surface: Surface,
    shots: Sequence[Shot],
    executor: Executor | None,
    progress: Reporter,
) -> tuple[OctreeTexture | None, list[OctreeTexture]]:
    """Project pictures; return what to merge them into, None for nothing yet, and the layer that they are."""
    settings: dict[str, Any] = {
        "fit": not options.no_fit,
        "pictures": options.pictures,
        "balance": options.balance,
        "reference": _reference(options, shots),
        "executor": executor,
        "progress": progress,
        **_room(options),
    }
    for name in ("channel", "max_depth", "edge_feather"):
        if getattr(options, name) is not None:
            settings[name] = getattr(options, name)
    if options.max_angle is not None:
        settings["max_angle"], settings["back_faces"] = options.max_angle
    given = [_projection(options, shot) for shot in shots]
    background = _background_value(options) if isinstance(options.holes, tuple) else None
    layer = octex.project(surface, given, like=texture, **settings)
    if texture is not None and layer.tree.n_leaves > texture.tree.n_leaves:
        progress.note(
            f"the paint has {layer.tree.n_leaves:,} leaves, the texture {texture.tree.n_leaves:,}; "
            f"--max-depth {texture.tree.max_depth} paints with cells as small as the texture's"
        )
    if background is None or not layer.tree.n_leaves:
        return texture, [layer]
    depth = layer.tree.max_depth if options.max_depth is None else options.max_depth
    channel = channel_of(layer)
    texture = octex.convert(
        surface,
        depth,
        channels=[channel],
        sources={channel: background},
        fit=not options.no_fit,
        executor=executor,
        progress=progress,
    )
    if texture.placement != layer.placement:
        layer = octex.project(surface, given, like=texture, **settings)
    return texture, [layer]


def refined(
    options: Options,
    surface: Surface,
    shots: Sequence[Shot],
    executor: Executor | None,
    progress: Reporter,
) -> list[Shot]:
    """Return pictures with cameras through which they agree best, and write these."""
    cameras = octex.refine_cameras(
        surface,
        [_projection(options, shot) for shot in shots],
        reference=_reference(options, shots),
        executor=executor,
        progress=progress,
        **_room(options),
    )
    # What comes next may take hours, so they are written now.
    octex.write_cameras(options.refine_cameras, dict(zip(_camera_names(shots), cameras, strict=True)))
    return [shot._replace(camera=camera) for shot, camera in zip(shots, cameras, strict=True)]


def _camera_names(shots: Sequence[Shot]) -> list[str]:
    """Return a name for the camera of each picture: the frame's, or the picture's where frames repeat."""
    for names in ([shot.name for shot in shots], [shot.path.name for shot in shots]):
        if len(set(names)) == len(names):
            return names
    raise ArgumentError("--refine-cameras: pictures of one name have one camera; refine these apart")


def _room(options: Options) -> dict[str, Any]:
    """Return the settings of --memory and --resume."""
    room = {} if options.resume is None else {"resume": options.resume}
    if options.memory is not None:
        room |= {"memory": options.memory, "folder": options.OUTPUT.absolute().parent}
    return room


def _projection(options: Options, shot: Shot) -> Projection:
    since: Any = shot.since
    if isinstance(since, bytes):
        from octex.source.images.decode import decode_image

        where = "of --unwrap" if options.camera is None else f"in {options.camera[0]}"
        since = decode_image(since, f"the view {where}")
    key = next((each for each in options.mask if isinstance(each, tuple)), None)
    return octex.Projection(
        shot.path, shot.camera, shot.mask, blend=options.blend or "over", since=since, key=key
    )


def _reference(options: Options, shots: Sequence[Shot]) -> int | None:
    """Return the number of the picture of --reference."""
    if options.reference is None:
        return None
    paths = [shot.path for shot in shots]
    for names, name in ((paths, options.reference), ([path.name for path in paths], options.reference.name)):
        if names.count(name) == 1:
            return names.index(name)
    raise ArgumentError(f"--reference {options.reference} is none of the pictures, or several of them")


def _background_value(options: Options) -> tuple[float, ...]:
    """Return the colour of --holes as the channel's decoded value, linear light for colours."""
    import numpy as np

    from octex.channels import CHANNELS, decode
    from octex.checks import as_choice

    form = CHANNELS[as_choice(options.channel or DEFAULT_CHANNEL, CHANNELS, "channel")]
    codes: tuple[int, ...] = options.holes
    if form.space == "direction":
        raise ArgumentError(f"--holes is a colour; {form.name} has directions")
    if form.components == 1:
        if len(set(codes)) > 1:
            raise ArgumentError(f"--holes is a colour; {form.name} has one component, give a grey")
        codes = codes[:1]
    return tuple(decode(np.array(codes, np.uint8), form.space).tolist())


def channel_of(layer: OctreeTexture) -> str:
    """Return the channel that a layer paints."""
    return next((name for name in layer.channels if name != "alpha"), "alpha")


def begun(
    options: Options,
    layer: OctreeTexture,
    surface: Surface,
    is_layer: bool,
    executor: Executor,
    progress: Reporter,
) -> OctreeTexture:
    """Return a new texture for a layer to be merged into; its unseen part may be filled."""
    from octex.painting import holes

    mode: Any = options.holes if isinstance(options.holes, str) else "smooth"
    if is_layer:
        mode = "leave"
    return holes.begun(layer, surface, mode, executor, progress)


def merged(
    options: Options,
    texture: OctreeTexture,
    layers: Sequence[OctreeTexture],
    surface: Surface,
    is_layer: bool,
    executor: Executor | None,
    progress: Reporter,
) -> OctreeTexture:
    """Merge layers; return the very same texture if they paint nothing."""
    strength = 1.0 if options.opacity is None else options.opacity
    for number, layer in enumerate(layers):
        if not layer.tree.n_leaves:
            continue
        try:
            texture = octex.merge(
                texture,
                layer,
                surface,
                opacity=strength,
                blend=options.blend or "over",
                executor=executor,
                progress=progress,
            )
        except ArgumentError as error:
            if is_layer:
                raise ArgumentError(f"{options.IMAGE[number]}: {error}") from None
            raise
    if options.coverage and any(layer.tree.n_leaves for layer in layers):
        from octex.painting.holes import with_coverage

        texture = with_coverage(texture, layers)
    return texture


def entries_of(options: Options, files: Sequence[Path], layer: OctreeTexture) -> list[dict[str, str | float]]:
    """Return the provenance of the paint in files."""
    found: list[dict[str, str | float]] = []
    for path in files:
        with open_file(path) as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        found.append(
            {
                "image": path.name,
                "sha256": digest,
                "blend": options.blend or "over",
                "opacity": 1.0 if options.opacity is None else options.opacity,
                "channel": channel_of(layer),
            }
        )
    return found


def with_entries(
    texture: OctreeTexture, surface: Surface, entries: Sequence[dict[str, str | float]]
) -> OctreeTexture:
    """Append to the provenance of a texture's paint; that of a new texture also names the model."""
    from octex.texture import OctreeTexture

    metadata = dict(texture.metadata)
    if not metadata:
        names = ("source", "sha256", "rest", "rest_sha256")
        metadata = {name: surface.provenance[name] for name in names if name in surface.provenance}
        metadata["octex"] = octex.__version__
    try:
        before = json.loads(metadata.get("paint", "[]"))
    except ValueError:
        before = metadata["paint"]
    if not isinstance(before, list):  # somebody else's
        before = [before]
    metadata["paint"] = json.dumps([*before, *entries])
    return OctreeTexture(texture.tree, texture.channels, texture.placement, texture.bounds, metadata)
