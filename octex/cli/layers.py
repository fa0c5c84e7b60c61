"""Layers of paint as the options say: projected, merged into a texture, and told of in its metadata."""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import octex
from octex.cli.common import Reporter
from octex.cli.models import DEFAULT_CHANNEL
from octex.cli.shots import Shot
from octex.errors import ArgumentError
from octex.files import open_file

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from octex.painting.picture import Projection
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture


def projected(
    options: argparse.Namespace,
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
        "back_faces": options.back_faces,
        "executor": executor,
        "progress": progress,
        **_room(options),
    }
    for name in ("channel", "max_depth", "max_angle", "edge_feather"):
        if getattr(options, name) is not None:
            settings[name] = getattr(options, name)
    given = [_projection(options, shot) for shot in shots]
    background = None if options.background is None else _background_value(options)
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
    options: argparse.Namespace,
    surface: Surface,
    shots: Sequence[Shot],
    executor: Executor | None,
    progress: Reporter,
) -> list[Shot]:
    """Return pictures with cameras by which they agree best."""
    names = [shot.name for shot in shots]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None and options.save_cameras is not None:
        raise ArgumentError(
            f"--save-cameras: {twice!r} is the camera of several pictures; refine these apart"
        )
    cameras = octex.refine_cameras(
        surface,
        [_projection(options, shot) for shot in shots],
        reference=_reference(options, shots),
        executor=executor,
        progress=progress,
        **_room(options),
    )
    return [shot._replace(camera=camera) for shot, camera in zip(shots, cameras, strict=True)]


def _room(options: argparse.Namespace) -> dict[str, Any]:
    """Return where pictures lie beyond --memory, and where what is done is kept."""
    room = {} if options.resume is None else {"resume": options.resume}
    if options.memory is not None:
        room |= {"memory": options.memory, "folder": options.out.absolute().parent}
    return room


def _projection(options: argparse.Namespace, shot: Shot) -> Projection:
    since: Any = shot.since
    if isinstance(since, bytes):
        from octex.source.images.decode import decode_image

        where = "of --unwrap" if options.camera is None else f"in {options.camera[0]}"
        since = decode_image(since, f"the view {where}")
    return octex.Projection(
        shot.path, shot.camera, shot.mask, blend=options.blend or "over", since=since, key=options.key
    )


def _reference(options: argparse.Namespace, shots: Sequence[Shot]) -> int | None:
    """Return the number of the picture that stays as light as it is."""
    if options.reference is None:
        return None
    paths = [shot.path for shot in shots]
    for found in (
        [each == options.reference for each in paths],
        [e.name == options.reference.name for e in paths],
    ):
        if sum(found) == 1:
            return found.index(True)
    raise ArgumentError(f"--reference {options.reference} is none of the pictures, or several of them")


def _background_value(options: argparse.Namespace) -> tuple[float, ...]:
    """Return the background as the channel has it decoded, linear light for colours."""
    import numpy as np

    from octex.channels import CHANNELS, decode
    from octex.checks import as_choice

    form = CHANNELS[as_choice(options.channel or DEFAULT_CHANNEL, CHANNELS, "channel")]
    codes: tuple[int, ...] = options.background
    if form.space == "direction":
        raise ArgumentError(f"--background is a colour; {form.name} has directions")
    if form.components == 1:
        if len(set(codes)) > 1:
            raise ArgumentError(f"--background gives a colour; {form.name} has one component, give a grey")
        codes = codes[:1]
    return tuple(decode(np.array(codes, np.uint8), form.space).tolist())


def channel_of(layer: OctreeTexture) -> str:
    """Return what a layer paints."""
    return next((name for name in layer.channels if name != "alpha"), "alpha")


def begun(
    options: argparse.Namespace,
    layer: OctreeTexture,
    surface: Surface,
    executor: Executor,
    progress: Reporter,
) -> OctreeTexture:
    """Return a new texture for a layer to be merged into: where pictures saw nothing, it may be filled."""
    from octex.painting import holes

    mode: Any = "leave" if options.layer else options.holes or "smooth"
    return holes.begun(layer, surface, mode, executor, progress)


def merged(
    options: argparse.Namespace,
    texture: OctreeTexture,
    layers: Sequence[OctreeTexture],
    surface: Surface,
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
            if options.layer:
                raise ArgumentError(f"{options.layer[number]}: {error}") from None
            raise
    if options.coverage and any(layer.tree.n_leaves for layer in layers):
        from octex.painting.holes import with_coverage

        texture = with_coverage(texture, layers)
    return texture


def entries_of(
    options: argparse.Namespace, files: Sequence[Path], layer: OctreeTexture
) -> list[dict[str, str | float]]:
    """Return what provenance says of the paint in files."""
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
    """Append to what a texture's provenance says of paint; a new texture's also names the model."""
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
