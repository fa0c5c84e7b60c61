"""Projects images into layers of paint, merges layers, and records them in the metadata."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
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
    from octex.painting.picture import Projection
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture


class Painting:
    """Paints as the options ask: projects images to a layer, and merges layers into a texture."""

    def __init__(self, options: Options, surface: Surface, executor: Executor, progress: Reporter) -> None:
        self._options, self._surface = options, surface
        self._executor, self._progress = executor, progress
        self._run = octex.Run(executor=executor, progress=progress)
        room = None if options.memory is None else options.OUTPUT.absolute().parent
        self._stored = replace(self._run, memory=options.memory, folder=room, resume=options.resume)
        self._blend: Any = options.blend or "over"
        self._opacity = 1.0 if options.opacity is None else options.opacity

    def fitting(self, shots: list[Shot]) -> tuple[list[Shot], list[str]]:
        """Return the images that fit the model, and the names of the others; note why."""
        if len(shots) < 2 or any(shot.since for shot in shots):
            return shots, []
        from octex.photos.misfits import misfits

        reasons, better = misfits(self._surface, [self._projection(shot) for shot in shots], self._executor)
        for number, reason in sorted(reasons.items()):
            self._progress.note(f"{shots[number].path} is left out: {reason}")
        if better:
            self._progress.note(f"the mesh does not fit the cameras: {better}")
        kept = [shot for number, shot in enumerate(shots) if number not in reasons]
        return kept, [shots[number].path.name for number in sorted(reasons)]

    def projected(
        self, texture: OctreeTexture | None, shots: Sequence[Shot]
    ) -> tuple[OctreeTexture | None, list[OctreeTexture]]:
        """Project images; return the texture to merge them into (None: a new one), and their layer."""
        options, surface = self._options, self._surface
        settings: dict[str, Any] = {
            "fit": not options.no_fit,
            "pictures": options.pictures,
            "balance": options.balance,
            "reference": self._reference(shots),
            "run": self._stored,
        }
        for name in ("channel", "max_depth", "edge_feather"):
            if getattr(options, name) is not None:
                settings[name] = getattr(options, name)
        if options.max_angle is not None:
            settings["max_angle"], settings["back_faces"], settings["hidden"] = options.max_angle
        projections = [self._projection(shot) for shot in shots]
        background = _value_of(options) if isinstance(options.holes, tuple) else None
        layer = octex.project(surface, projections, like=texture, **settings)
        if texture is not None and layer.tree.n_leaves > texture.tree.n_leaves:
            self._progress.note(
                f"the paint has {layer.tree.n_leaves:,} leaves, the texture {texture.tree.n_leaves:,}; "
                f"--max-depth {texture.tree.max_depth} paints with cells as small as the texture's"
            )
        if background is None or not layer.tree.n_leaves:
            return texture, [layer]
        depth = layer.tree.max_depth if options.max_depth is None else options.max_depth
        wanted: dict[str, Any] = {"channels": [channel_of(layer)], "sources": {channel_of(layer): background}}
        texture = octex.convert(surface, depth, **wanted, fit=not options.no_fit, run=self._run)
        if texture.placement != layer.placement:
            layer = octex.project(surface, projections, like=texture, **settings)
        return texture, [layer]

    def refined(self, shots: Sequence[Shot]) -> list[Shot]:
        """Return the images with refined cameras, and write these cameras."""
        pictures, reference = [self._projection(shot) for shot in shots], self._reference(shots)
        cameras = octex.refine_cameras(self._surface, pictures, reference=reference, run=self._stored)
        # The next steps may take hours, so the cameras are written now.
        octex.write_cameras(
            self._options.refine_cameras, dict(zip(_camera_names(shots), cameras, strict=True))
        )
        return [shot._replace(camera=camera) for shot, camera in zip(shots, cameras, strict=True)]

    def started(self, layer: OctreeTexture, has_layers: bool) -> tuple[OctreeTexture, bool]:
        """Return a new texture, filled where unseen as asked, and whether it includes a layer already."""
        from octex.painting import first
        from octex.painting.surface import PaintedSurface

        chosen, surface = self._options.holes, PaintedSurface(self._surface)
        mode: Any = "leave" if has_layers else chosen if isinstance(chosen, str) else "smooth"
        task = mode, self._blend, self._executor, self._progress
        return first.started(layer, surface, *task)

    def merged(
        self, texture: OctreeTexture, layers: Sequence[OctreeTexture], files: Sequence[Path], first: int
    ) -> OctreeTexture:
        """Merge layers, read from ``files`` if any, from number ``first`` on.

        Returns the same texture if they paint nothing.
        """
        painting = [number for number, layer in enumerate(layers) if layer.tree.n_leaves and number >= first]
        blending = {"opacity": self._opacity, "blend": self._blend, "run": self._run}
        for number in painting:
            try:
                texture = octex.merge(texture, layers[number], self._surface, **blending)
            except ArgumentError as error:
                raise ArgumentError(f"{files[number]}: {error}" if files else str(error)) from None
        if self._options.coverage and any(layer.tree.n_leaves for layer in layers):
            from octex.painting.first import with_coverage

            texture = with_coverage(texture, layers)
        return texture

    def entries(self, files: Sequence[Path], layer: OctreeTexture) -> list[dict[str, str | float]]:
        """Return the provenance of the paint in files."""
        paint: list[dict[str, str | float]] = []
        for path in files:
            with open_file(path) as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            entry = {"image": path.name, "sha256": digest, "blend": self._blend, "opacity": self._opacity}
            paint.append({**entry, "channel": channel_of(layer)})
        return paint

    def _projection(self, shot: Shot) -> Projection:
        since: Any = shot.since
        if isinstance(since, bytes):
            from octex.source.images.decode import decode_image

            where = "of --unwrap" if self._options.camera is None else f"in {self._options.camera[0]}"
            since = decode_image(since, f"the view {where}")
        key = next((each for each in self._options.mask if isinstance(each, tuple)), None)
        return octex.Projection(shot.path, shot.camera, shot.mask, blend=self._blend, since=since, key=key)

    def _reference(self, shots: Sequence[Shot]) -> int | None:
        """Return the number of the picture of --reference."""
        path = self._options.reference
        if path is None:
            return None
        paths = [shot.path for shot in shots]
        for names, name in ((paths, path), ([path.name for path in paths], path.name)):
            if names.count(name) == 1:
                return names.index(name)
        raise ArgumentError(f"--reference {path} must name exactly one of the pictures")


def _camera_names(shots: Sequence[Shot]) -> list[str]:
    """Return a name for the camera of each picture: the frame's, or the picture's where frames repeat."""
    for names in ([shot.name for shot in shots], [shot.path.name for shot in shots]):
        if len(set(names)) == len(names):
            return names
    raise ArgumentError("--refine-cameras: pictures of one name have one camera; refine those separately")


def _value_of(options: Options) -> tuple[float, ...]:
    """Return the colour of --holes as the channel's decoded value, linear light for colours."""
    import numpy as np

    from octex.channels import CHANNELS, decode
    from octex.checks import as_choice

    form = CHANNELS[as_choice(options.channel or DEFAULT_CHANNEL, CHANNELS, "channel")]
    codes: tuple[int, ...] = options.holes
    if form.space == "direction":
        raise ArgumentError(f"--holes is a colour, but {form.name} holds directions")
    if form.components == 1:
        if len(set(codes)) > 1:
            raise ArgumentError(f"--holes is a colour, but {form.name} has one component; give a grey")
        codes = codes[:1]
    return tuple(decode(np.array(codes, np.uint8), form.space).tolist())


def channel_of(layer: OctreeTexture) -> str:
    """Return the channel that a layer paints."""
    return next((name for name in layer.channels if name != "alpha"), "alpha")


def with_entries(
    texture: OctreeTexture, surface: Surface, entries: Sequence[dict[str, str | float]]
) -> OctreeTexture:
    """Append paint to a texture's provenance; for a new texture also record the model."""
    from octex.processing.edit import with_listed
    from octex.texture import OctreeTexture

    metadata = dict(texture.metadata)
    if not metadata:
        names = ("source", "sha256", "rest", "rest_sha256")
        metadata = {name: surface.provenance[name] for name in names if name in surface.provenance}
        metadata["octex"] = octex.__version__
    metadata = with_listed(metadata, "paint", entries)
    return OctreeTexture(texture.tree, texture.channels, texture.placement, texture.bounds, metadata)
