"""Finds the camera, size and mask of each image to paint."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import octex
from octex.cli.common import Reporter
from octex.cli.inputs import only
from octex.cli.options import DEFAULT_CHANNEL
from octex.cli.parser import Options
from octex.errors import ArgumentError, CameraError, ImageError
from octex.files import listing

if TYPE_CHECKING:
    from octex.arrays import Array
    from octex.cameras.camera import Camera
    from octex.cameras.files import Frame
    from octex.painting.image import Projection
    from octex.painting.unwrap import Patch
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture

#: The value of --since that paints all pixels.
NOTHING = Path("nothing")


class InputImage(NamedTuple):
    """An image to paint."""

    path: Path
    image: Projection
    name: str  # of its camera


def shots_of(options: Options, progress: Reporter) -> tuple[list[InputImage], list[str]]:
    """Return images with their cameras, and the names of missing or damaged images."""
    from octex.source.images.decode import decode_image

    pairs, missing = _pairs(options)
    if missing:
        which = f"skipped {len(missing)} of {len(pairs) + len(missing)} images"
        reason = f", which have no camera in {options.camera[0]}" if options.IMAGE else ""
        progress.note(f"{which}{reason}: {listing(missing)}")
    masks = _masks(options, [path for path, _ in pairs])
    shots: list[InputImage] = []
    damaged: list[Path] = []
    for (path, frame), mask in zip(pairs, masks, strict=True):
        try:
            size = _size(path, frame)
        except ImageError as error:
            if len(pairs) - len(damaged) == 1:
                raise ImageError(f"{error} (for frame {frame.name!r} of {frame.file})") from None
            progress.note(f"{path} is left out: {error}")
            damaged.append(path)
            continue
        try:
            camera = frame.camera(size)
            since: Path | Array | None = options.since
            if since is None and options.TEXTURE is not None and frame.view is not None:
                if size != frame.size:
                    raise CameraError(
                        f"has {size[0]}×{size[1]} pixels, another number than the view in frame "
                        f"{frame.name!r} of {frame.file}, so octex cannot tell which pixels you changed; "
                        f"scale the image, or give --since {NOTHING}"
                    )
                since = decode_image(frame.view, f"the view in {frame.file}")
        except CameraError as error:
            raise CameraError(f"{path}: {error}") from None
        shots.append(_shot(options, path, camera, mask, since, frame.name))
    return shots, [*missing, *(path.name for path in damaged)]


def flat_shots(
    options: Options, surface: Surface, texture: OctreeTexture | None, progress: Reporter
) -> tuple[Patch, list[InputImage]]:
    """Unwrap the disc of --unwrap; return it and its images."""
    from octex.drawing import draw_paintable
    from octex.source.images.decode import image_size

    paths = images_of(options)
    patch = patch_of(options, surface, image_size(paths[0]), progress)
    since: Path | Array | None = options.since
    if since is None and texture is not None:
        channel = options.channel or DEFAULT_CHANNEL
        since = draw_paintable(only(texture, channel), patch.surface, patch.camera, channel)
    return patch, [
        _shot(options, path, patch.camera, mask, since, path.name)
        for path, mask in zip(paths, _masks(options, paths), strict=True)
    ]


def _shot(
    options: Options, path: Path, camera: Camera, mask: Path | None, since: Path | Array | None, name: str
) -> InputImage:
    """Return an image to paint; only pixels that differ from the unedited view ``since`` are painted."""
    key = next((each for each in options.mask if isinstance(each, tuple)), None)
    before = None if options.since == NOTHING else since
    image = octex.Projection(path, camera, mask, blend=options.blend, since=before, key=key)
    return InputImage(path, image, name)


def patch_of(options: Options, surface: Surface, size: tuple[int, int], progress: Reporter) -> Patch:
    """Unwrap the disc of --unwrap; note where it is not a disc."""
    if size[0] != size[1]:
        raise ArgumentError(f"images of a disc are square, not {size[0]} × {size[1]}")
    patch = octex.unwrap(surface, **options.unwrap, size=size[0])
    for fault in patch.faults:
        progress.note(f"--unwrap: {fault}; paint reaches what is seen")
    return patch


def images_of(options: Options) -> list[Path]:
    """Return the named images."""
    return [_image_and_frame(path)[0] for path in options.IMAGE]


def _masks(options: Options, images: Sequence[Path]) -> list[Path | None]:
    files = [each for each in options.mask if isinstance(each, Path)]
    pattern = next((each for each in options.mask if isinstance(each, str)), None)
    if pattern is None:
        if len(files) > 1:
            painted = set(images)
            named = zip(images_of(options), files, strict=True)
            return [mask for image, mask in named if image in painted]
        return [files[0] if files else None] * len(images)
    masks = [Path(pattern.replace("{name}", path.name).replace("{stem}", path.stem)) for path in images]
    missing = [mask.as_posix() for mask in masks if not mask.is_file()]
    if missing:
        raise ImageError(f"--mask: {len(missing)} of {len(masks)} masks are missing: {listing(missing)}")
    return list(masks)


def _size(path: Path, frame: Frame) -> tuple[int, int]:
    """Return an image's size, upright unless its stored orientation matches the frame."""
    from octex.source.images.decode import image_size, orientation_of

    width, height = image_size(path)
    if width == height or (frame.size is not None and frame.fits((width, height))):
        return width, height
    is_turned = orientation_of(path.read_bytes()) >= 5  # those of EXIF that swap rows and columns
    return (height, width) if is_turned else (width, height)


def _pairs(options: Options) -> tuple[list[tuple[Path, Frame]], list[str]]:
    """Return images with their frames, and the names of missing images, or of those without a frame."""
    from octex.cameras.files import find_frame, has_frame, read_cameras

    file, name = options.camera
    images = [_image_and_frame(path) for path in options.IMAGE]
    if name is not None and (len(images) > 1 or any(named is not None for _, named in images)):
        raise ArgumentError(
            f"--camera names one frame, {name!r}, for {len(images)} IMAGEs; leave the name out, and frames "
            "are found by the IMAGEs' file names"
        )
    frames = read_cameras(file)
    if name is not None:
        frames = [find_frame(frames, name, file)]
    if len(images) == 1 and len(frames) == 1 and images[0][1] is None:
        return [(images[0][0], frames[0])], []
    if len(images) == len(frames) and not any([*(f.is_named for f in frames), *(name for _, name in images)]):
        return [(image, frame) for (image, _), frame in zip(images, frames, strict=True)], []
    if images:
        unseen = [image for image, name in images if name is None and not has_frame(frames, image.as_posix())]
        named_images = [each for each in images if each[0] not in unseen] or images
        try:
            pairs = [
                (image, find_frame(frames, name or image.as_posix(), file)) for image, name in named_images
            ]
            return pairs, [image.name for image in unseen]
        except CameraError as error:
            raise CameraError(f"{error}; IMAGE=NAME says which camera an IMAGE has") from None
    named = [(frame.image, frame) for frame in frames if frame.image is not None]
    if not named:
        raise CameraError(f"{file}: does not name the images of its cameras; give IMAGEs")
    missing = [frame.name for image, frame in named if not image.is_file()]
    if len(missing) == len(named):
        raise CameraError(
            f"{file}: none of the {len(named)} images that it names exists: {listing(missing)}; give IMAGEs"
        )
    return [(image, frame) for image, frame in named if image.is_file()], missing


def _image_and_frame(path: Path) -> tuple[Path, str | None]:
    """Parse IMAGE=FRAME, or an image's name, which may contain an = too."""
    image, sign, frame = str(path).rpartition("=")
    return (Path(image), frame) if sign and image and frame and not path.exists() else (path, None)
