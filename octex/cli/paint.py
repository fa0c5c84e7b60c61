"""octree-paint: pictures and cameras in, an octree texture with their paint out; and pictures to paint on."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import octex
from octex.cli.arguments import (
    BLENDS,
    angle,
    blend,
    camera,
    color,
    count,
    opacity,
    picture_size,
    pixels,
    whole_number,
)
from octex.cli.common import Parser, Reporter, bytes_text, check_outputs, fail, run, say
from octex.errors import ArgumentError, CameraError, ExitCode, ImageError, InputError
from octex.parallel import threads

if TYPE_CHECKING:
    from concurrent.futures import Executor

    import numpy as np
    import numpy.typing as npt

    from octex.painting.pictures import Projection
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture
    from octex.view.camera import Camera
    from octex.view.camera_files import Frame

COMMAND = "octree-paint"
TEXTURE_ENDING = ".octex"
DEFAULT_CHANNEL = "base_color"
DEFAULT_SIZE = (1024, 1024)
_DIRECTION = (0.4, 0.3, 1.0)  # to the camera, where none is given
_LISTED = 5

# Which options go with which work.
_SHARED = {"MODEL", "TEXTURE", "--rest", "--force", "--quiet", "--json"}
_MERGE = _SHARED | {"--out", "--blend", "--opacity", "--preview", "--threads"}
_OPTIONS = {
    "painting": _MERGE
    | {"IMAGE", "--camera", "--mask", "--channel", "--max-depth", "--max-angle", "--edge-feather"}
    | {"--balance", "--back-faces", "--no-fit", "--background", "--layer-out"},
    "--layer": _MERGE,
    "--view": _SHARED | {"--camera-out", "--camera", "--size", "--channel"},
}
_NEEDED = {
    "painting": ("MODEL", "TEXTURE", "--camera", "--out"),
    "--layer": ("MODEL", "TEXTURE", "--out"),
    "--view": ("MODEL", "TEXTURE"),
}


def parser() -> argparse.ArgumentParser:
    """Return the parser of octree-paint's arguments."""
    indent = f"{'':20}"
    parser = Parser(
        prog=COMMAND,
        description="Paint pictures through their cameras onto a model's octree texture.",
        usage=f"{COMMAND} MODEL TEXTURE [IMAGE ...] --camera FILE[#NAME] --out NEW\n"
        f"{indent}[--mask PNG ...] [--blend MODE] [--opacity X] [--channel NAME]\n"
        f"{indent}[--max-depth N] [--max-angle DEGREES] [--edge-feather PIXELS]\n"
        f"{indent}[--balance] [--back-faces] [--no-fit] [--background COLOUR]\n"
        f"{indent}[--rest MESH] [--preview PNG] [--layer-out LAYER] [--force]\n"
        f"{indent}[--threads N] [--quiet] [--json]\n"
        f"       {COMMAND} MODEL TEXTURE --layer LAYER [--layer LAYER ...] --out NEW\n"
        f"{indent}[--blend MODE] [--opacity X] [--rest MESH] [--preview PNG]\n"
        f"{indent}[--force] [--threads N] [--quiet] [--json]\n"
        f"       {COMMAND} MODEL TEXTURE --view PNG [--camera-out CAMERA] [--camera FILE[#NAME]]\n"
        f"{indent}[--size W,H] [--channel NAME] [--rest MESH] [--force] [--quiet] [--json]\n"
        f"       {COMMAND} --version | --help",
    )
    add = parser.add_argument
    add("MODEL", nargs="?", type=Path, help="the model, posed as the cameras see it")
    add("TEXTURE", nargs="?", type=Path, help="its texture, .octex; if it is not there, a new one is begun")
    add(
        "IMAGE",
        nargs="*",
        type=Path,
        help="pictures; the frame of each is found by its file name (default: those that FILE names)",
    )
    add(
        "--camera",
        metavar="FILE[#NAME]",
        type=camera,
        help="where the cameras are: transforms.json, a COLMAP folder, glTF, or what --camera-out wrote",
    )
    add("--out", metavar="NEW", type=Path, help="the painted texture, .octex; with --force also TEXTURE")
    add(
        "--mask",
        metavar="PNG",
        action="append",
        type=Path,
        help="white where paint goes: one for all, or one for each IMAGE in order; any number of times",
    )
    add("--blend", metavar="MODE", type=blend, help=f"how paint is put: {', '.join(BLENDS)} (default over)")
    add("--opacity", metavar="X", type=opacity, help="0 to 1: multiplies the pictures' alpha (default 1)")
    add("--channel", metavar="NAME", help=f"what is painted (default {DEFAULT_CHANNEL})")
    add(
        "--max-depth",
        metavar="N",
        type=whole_number,
        help="the deepest level that paint goes to (default: cells of half a pixel, at most level 14)",
    )
    add(
        "--max-angle",
        metavar="DEGREES",
        type=angle,
        help="between the surface's normal and the way to the camera, from which on nothing is painted "
        "(default 75)",
    )
    add(
        "--edge-feather",
        metavar="PIXELS",
        type=pixels,
        help="fade paint towards the picture's rim and edges in depth (default 0)",
    )
    add("--balance", action="store_true", help="multiply pictures so that overlapping ones agree")
    add("--back-faces", action="store_true", help="paint also what faces away")
    add("--no-fit", action="store_true", help="store plain averages; lookups are then softer")
    add(
        "--background",
        metavar="COLOUR",
        type=color,
        help="begin a new texture in this colour all over: R,G,B from 0 to 255, or '#rrggbb'",
    )
    add("--rest", metavar="MESH", type=Path, help="the undeformed model, of the same topology as MODEL")
    add("--preview", metavar="PNG", type=Path, help="draw the model beside the model from its octree")
    add("--layer-out", metavar="LAYER", type=Path, help="keep the paint itself, .octex, for --layer")
    add(
        "--layer",
        metavar="LAYER",
        action="append",
        type=Path,
        help="merge paint kept before; any number of times, in this order",
    )
    add(
        "--view",
        metavar="PNG",
        type=Path,
        help="draw what the camera sees, unlit, to be painted on and sent back",
    )
    add("--camera-out", metavar="CAMERA", type=Path, help="the camera of that picture, .json, for --camera")
    add(
        "--size",
        metavar="W,H",
        type=picture_size,
        help=f"pixels of that picture (default: the camera's, or {DEFAULT_SIZE[0]},{DEFAULT_SIZE[1]})",
    )
    add("--force", action="store_true", help="overwrite what exists")
    add("--threads", metavar="N", type=count, help="threads to work on (default: all processors)")
    add("--quiet", action="store_true", help="print nothing but errors (and what --json asks for)")
    add("--json", action="store_true", help="print the result as one JSON object")
    add("--version", action="version", version=f"{COMMAND} {octex.__version__}")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run octree-paint and return its exit code (octex.errors.ExitCode)."""
    return run(COMMAND, lambda: _main(parser().parse_intermixed_args(arguments)))


def _main(options: argparse.Namespace) -> int:
    work = _work(options)
    if options.max_depth is not None:
        from octex.checks import as_depth

        as_depth(options.max_depth, "--max-depth")
    return _view(options) if work == "--view" else _paint(options)


def _work(options: argparse.Namespace) -> str:
    """Return what is to be done, a key of _OPTIONS, or refuse options that make no sense together."""
    given = [
        word if word.isupper() else "--" + word.replace("_", "-")
        for word, value in vars(options).items()
        if value is not None and value is not False and value != []
    ]
    work = next((word for word in ("--view", "--layer") if word in given), "painting")
    for word in given:
        if word != work and word not in _OPTIONS[work]:
            raise ArgumentError(f"{word} has no meaning with {work}; see {COMMAND} --help")
    for word in _NEEDED[work]:
        if word not in given:
            raise ArgumentError(f"{word} is missing; see {COMMAND} --help")
    is_there = options.TEXTURE.exists()
    if work == "--view" and options.camera is None and options.camera_out is None:
        raise ArgumentError(
            "--view without --camera needs --camera-out: without its camera a picture cannot be painted back"
        )
    if options.background is not None and is_there:
        raise ArgumentError(f"{options.TEXTURE}: exists already; --background is for a new texture")
    if options.blend == "erase" and not is_there:
        raise ArgumentError(f"{options.TEXTURE}: does not exist; there is nothing to erase")
    if not is_there and options.TEXTURE.suffix.lower() != TEXTURE_ENDING:
        raise InputError(f"{options.TEXTURE}: does not exist; a new texture is named NAME{TEXTURE_ENDING}")
    if options.mask is not None and len(options.mask) not in (1, len(options.IMAGE)):
        raise ArgumentError(
            f"--mask gives {len(options.mask)} for {len(options.IMAGE)} IMAGEs; give one for all, or one for "
            "each IMAGE"
        )
    return work


# Painting


def _paint(options: argparse.Namespace) -> int:
    began = time.perf_counter()
    _check_files(options)
    with Reporter(COMMAND, options.quiet) as progress:
        pictures, skipped = ([], []) if options.layer else _pictures(options, progress)
        texture = _texture(options)
        if texture is None:
            progress.note(f"{options.TEXTURE} does not exist yet: painting begins a new texture")
        with progress.stage("read"):
            surface = _read_model(options)
        with _executor(options) as executor:
            if options.layer:
                layers = [octex.open(path) for path in options.layer]
            else:
                texture, layers = _projected(options, texture, surface, pictures, executor, progress)
            base = _empty_like(layers[0]) if texture is None else texture
            made = _merged(options, base, layers, surface, executor, progress)
        if made is not base:
            entries = _entries(options, [picture.path for picture in pictures] or options.layer, layers[0])
            made = _with_entries(made, surface, entries)
            if options.preview is not None:  # first: without room for it, nothing is left unannounced
                with progress.stage("draw"):
                    _write_preview(options.preview, surface, made, _channel_of(layers[0]))
            with progress.stage("write"):
                if options.layer_out is not None:
                    _with_entries(layers[0], surface, entries).save(options.layer_out)
                made.save(options.out)
    if made is base:
        return fail(
            COMMAND,
            f"nothing was painted, and {options.out} is not written: no camera sees the model (do they look "
            "away from it, or stand behind or inside it?), or the pictures' alpha, the mask or --opacity are "
            "zero all over",
            ExitCode.NOTHING_PAINTED,
        )
    if not options.quiet or options.json:
        names = [str(entry["image"]) for entry in entries]
        _say_what_was_painted(options, made, names, skipped, time.perf_counter() - began)
    return ExitCode.DONE


def _check_files(options: argparse.Namespace) -> None:
    outputs: list[tuple[Path, tuple[str, ...], str]] = [(options.out, (TEXTURE_ENDING,), "--out")]
    if options.layer_out is not None:
        outputs.append((options.layer_out, (TEXTURE_ENDING,), "--layer-out"))
    if options.preview is not None:
        outputs.append((options.preview, (".png",), "--preview"))
    others = [*options.IMAGE, *(options.mask or []), *(options.layer or [])]
    # --out may take the place of TEXTURE, which is not written to: the old file is there until all is done.
    if options.out.resolve() != options.TEXTURE.resolve():
        others.append(options.TEXTURE)
    check_outputs(outputs, _inputs(options) + others, force=options.force)


def _inputs(options: argparse.Namespace) -> list[Path]:
    given = [options.MODEL, options.rest, None if options.camera is None else options.camera[0]]
    return [path for path in given if path is not None]


def _executor(options: argparse.Namespace) -> AbstractContextManager[Executor | None]:
    return nullcontext() if options.threads is None else threads(options.threads)


def _texture(options: argparse.Namespace) -> OctreeTexture | None:
    return octex.open(options.TEXTURE) if options.TEXTURE.exists() else None


def _read_model(options: argparse.Namespace) -> Surface:
    """Read the model: of its materials what a preview shows, else nothing."""
    if options.preview is not None:
        return octex.load_surface(options.MODEL, options.rest)
    surface = octex.load_surface(options.MODEL, options.rest, channels=["alpha"], sources={"alpha": 1.0})
    del surface.provenance["source_alpha"]
    return surface


class _Picture(NamedTuple):
    path: Path
    camera: Camera
    mask: Path | None


def _pictures(options: argparse.Namespace, progress: Reporter) -> tuple[list[_Picture], list[str]]:
    """Return pictures with their cameras, and the names of those that are missing."""
    pairs, missing = _pairs(options)
    if missing:
        progress.note(f"skipped {len(missing)} of {len(pairs) + len(missing)} pictures: {_listing(missing)}")
    masks = options.mask or [None]
    if len(masks) == 1:
        masks = masks * len(pairs)
    pictures = []
    for (path, frame), mask in zip(pairs, masks, strict=True):
        try:
            size = _size_of(path)
        except ImageError as error:
            raise ImageError(f"{error} (for frame {frame.name!r} of {frame.file})") from None
        try:
            pictures.append(_Picture(path, frame.camera(size), mask))
        except CameraError as error:
            raise CameraError(f"{path}: {error}") from None
    return pictures, missing


def _pairs(options: argparse.Namespace) -> tuple[list[tuple[Path, Frame]], list[str]]:
    """Return pictures with their frames, and the names of pictures that are missing."""
    from octex.view.camera_files import read_cameras

    file, name = options.camera
    images: list[Path] = options.IMAGE
    if name is not None and len(images) > 1:
        raise ArgumentError(
            f"--camera names one frame, {name!r}, for {len(images)} IMAGEs; leave the name out, and frames "
            "are found by the IMAGEs' file names"
        )
    frames = read_cameras(file)
    if name is not None:
        frames = [_frame(frames, name, file)]
    if len(images) == 1 and len(frames) == 1:
        return [(images[0], frames[0])], []
    if images:
        return [(image, _frame(frames, image.as_posix(), file)) for image in images], []
    own = [(frame.image, frame) for frame in frames if frame.image is not None]
    if not own:
        raise CameraError(f"{file}: does not say where the pictures of its cameras are; give IMAGEs")
    missing = [frame.name for image, frame in own if not image.is_file()]
    if len(missing) == len(own):
        raise CameraError(
            f"{file}: none of the {len(own)} pictures that it names is there: {_listing(missing)}; give "
            "IMAGEs"
        )
    return [(image, frame) for image, frame in own if image.is_file()], missing


def _frame(frames: Sequence[Frame], name: str, file: Path) -> Frame:
    from octex.view.camera_files import find_frame

    try:
        return find_frame(frames, name)
    except CameraError as error:
        raise CameraError(f"{file}: {error}") from None


def _listing(names: Sequence[str]) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(map(repr, names[:_LISTED])) + more


def _size_of(path: Path) -> tuple[int, int]:
    """Return the width and height of an image file; raises ImageError."""
    import PIL.Image

    from octex.source.images.decode import decode_image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PIL.Image.open(path) as image:
                return image.size
    except Exception:  # Pillow's plugins raise nearly anything, and do not know all that octex reads
        try:
            data = path.read_bytes()
        except OSError as error:
            raise ImageError(f"{path} cannot be read: {error.strerror or error}") from None
        height, width = decode_image(data, path.name).shape[:2]
        return width, height


def _projected(
    options: argparse.Namespace,
    texture: OctreeTexture | None,
    surface: Surface,
    pictures: Sequence[_Picture],
    executor: Executor | None,
    progress: Reporter,
) -> tuple[OctreeTexture | None, list[OctreeTexture]]:
    """Project pictures; return what to merge them into, None for nothing yet, and the layer that they are."""
    settings: dict[str, Any] = {
        "fit": not options.no_fit,
        "balance": options.balance,
        "back_faces": options.back_faces,
        "executor": executor,
        "progress": progress,
    }
    for name in ("channel", "max_depth", "max_angle", "edge_feather"):
        if getattr(options, name) is not None:
            settings[name] = getattr(options, name)
    given = [_projection(options, picture) for picture in pictures]
    background = None if options.background is None else _background_value(options)
    layer = octex.project(surface, given, like=texture, **settings)
    if background is None or not layer.tree.n_leaves:
        return texture, [layer]
    depth = layer.tree.max_depth if options.max_depth is None else options.max_depth
    channel = _channel_of(layer)
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


def _projection(options: argparse.Namespace, picture: _Picture) -> Projection:
    return octex.Projection(picture.path, picture.camera, picture.mask, blend=options.blend or "over")


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


def _channel_of(layer: OctreeTexture) -> str:
    """Return what a layer paints."""
    return next((name for name in layer.channels if name != "alpha"), "alpha")


def _empty_like(layer: OctreeTexture) -> OctreeTexture:
    """Return a texture without any cell, for a layer to be merged into."""
    from octex.painting.rasterize import empty_texture

    forms = [channel.format for name, channel in layer.channels.items() if name == _channel_of(layer)]
    return empty_texture(forms, layer.placement, layer.bounds)


def _merged(
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
    return texture


def _entries(
    options: argparse.Namespace, files: Sequence[Path], layer: OctreeTexture
) -> list[dict[str, str | float]]:
    """Return what provenance says of the paint in files."""
    found: list[dict[str, str | float]] = []
    for path in files:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        found.append(
            {
                "image": path.name,
                "sha256": digest,
                "blend": options.blend or "over",
                "opacity": 1.0 if options.opacity is None else options.opacity,
                "channel": _channel_of(layer),
            }
        )
    return found


def _with_entries(
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


def _write_preview(path: Path, surface: Surface, texture: OctreeTexture, channel: str) -> None:
    """Draw what was painted: beside the model's own, if it has such a channel."""
    from octex.preview import write_preview

    if channel == DEFAULT_CHANNEL:
        write_preview(path, surface, texture)
    elif channel in [form.name for form in surface.channels]:
        write_preview(path, surface.with_channels([channel]), texture)
    else:
        write_preview(path, None, _only(texture, channel))


def _only(texture: OctreeTexture, channel: str) -> OctreeTexture:
    """Return a texture with one channel, and alpha, by which it is looked up."""
    from octex.checks import as_choice
    from octex.texture import OctreeTexture

    as_choice(channel, texture.channels, "channel of the texture")
    kept = {name: each for name, each in texture.channels.items() if name in (channel, "alpha")}
    return OctreeTexture(texture.tree, kept, texture.placement, texture.bounds, texture.metadata)


def _say_what_was_painted(
    options: argparse.Namespace,
    texture: OctreeTexture,
    painted: Sequence[str],
    skipped: Sequence[str],
    seconds: float,
) -> None:
    tree = texture.tree
    made: dict[str, Any] = {
        "output": str(options.out),
        "leaves": tree.n_leaves,
        "nodes": tree.n_nodes,
        "depth": tree.max_depth,
        "painted": list(painted),
        "skipped": list(skipped),
        "bytes": options.out.stat().st_size,
        "seconds": round(seconds, 3),
    }
    if options.layer_out is not None:
        made["layer"] = str(options.layer_out)
    if options.preview is not None:
        made["preview"] = str(options.preview)
    if options.json:
        say(json.dumps(made))
        return
    what = "layer" if options.layer else "picture"
    number = f"{len(painted):,} {what}{'s' if len(painted) > 1 else ''} painted"
    cells = f"{tree.n_leaves:,} leaves, depth {tree.max_depth}"
    say(f"{options.out}: {number}, {cells}, {bytes_text(made['bytes'])}, {seconds:.1f} s")
    if options.layer_out is not None:
        say(f"{options.layer_out}: the paint alone")
    if options.preview is not None:
        say(f"{options.preview}: a picture of it")


# Pictures to paint on


def _view(options: argparse.Namespace) -> int:
    began = time.perf_counter()
    outputs: list[tuple[Path, tuple[str, ...], str]] = [(options.view, (".png",), "--view")]
    if options.camera_out is not None:
        outputs.append((options.camera_out, (".json",), "--camera-out"))
    check_outputs(outputs, [*_inputs(options), options.TEXTURE], force=options.force)
    with Reporter(COMMAND, options.quiet) as progress:
        texture = _texture(options)
        if texture is not None:
            texture = _only(texture, options.channel or DEFAULT_CHANNEL)
        else:
            progress.note(f"{options.TEXTURE} does not exist yet: the model is drawn grey, in some light")
        with progress.stage("read"):
            surface = _read_model(options)
        camera = _view_camera(options, surface)
        if any(camera.distortion):
            progress.note(
                "the camera's lens distorts; the picture is drawn without that, and fits the camera that "
                "--camera-out writes"
            )
            camera = camera.undistorted
        with progress.stage("draw"):
            codes = _draw(texture, surface, camera, options.channel or DEFAULT_CHANNEL)
        with progress.stage("write"):
            if options.camera_out is not None:
                octex.write_cameras(options.camera_out, {options.view.name: camera})
            _write_png(options.view, codes)
    if not options.quiet or options.json:
        _say_what_was_drawn(options, camera, time.perf_counter() - began)
    return ExitCode.DONE


def _view_camera(options: argparse.Namespace, surface: Surface) -> Camera:
    """Return the camera that is given, or one from the front that sees the whole model."""
    from octex.view.camera_files import read_cameras

    if options.camera is None:
        return octex.Camera.fitted(surface.vertices, _DIRECTION, size=options.size or DEFAULT_SIZE)
    file, name = options.camera
    frames = read_cameras(file)
    frame = frames[0]
    if name is not None or len(frames) > 1:
        frame = _frame(frames, options.view.name if name is None else name, file)
    if frame.size is not None and options.size not in (None, frame.size):
        width, height = frame.size
        raise ArgumentError(
            f"--size is not that of frame {frame.name!r} of {file}, {width},{height}; leave --size out"
        )
    return frame.camera(options.size)


def _draw(
    texture: OctreeTexture | None, surface: Surface, camera: Camera, channel: str
) -> npt.NDArray[np.uint8]:
    """Draw a channel at the pixels' centres: codes (height, width, 4), alpha 0 beside the model."""
    import numpy as np

    from octex.channels import encode
    from octex.preview.looks import texture_look
    from octex.preview.pictures import rest_normals, seen_hits
    from octex.view.shading import corner_normals, face_normals, light

    if texture is not None:
        look = texture_look(texture, channel)
    else:
        faces, _ = face_normals(surface.vertices, surface.triangles)
        smooth = corner_normals(surface.vertices, surface.triangles)
    codes = np.zeros((camera.height * camera.width, 4), np.uint8)
    for seen, hits in seen_hits(surface, camera, rest_normals(surface)):
        if texture is not None:
            colors = look(hits).unlit()
        else:
            corners = surface.vertices[surface.triangles[hits.triangles]]
            points = np.einsum("nk,nkc->nc", hits.barycentric, corners)
            normals = np.einsum("nk,nkc->nc", hits.barycentric, smooth[hits.triangles])
            lit = light(camera, points, faces[hits.triangles], normals)
            colors = np.repeat(0.5 * lit[:, None], 3, axis=1)
        codes[seen, :3] = encode(colors, "uint8", "srgb")
        codes[seen, 3] = 255
    return codes.reshape(camera.height, camera.width, 4)


def _write_png(path: Path, codes: npt.NDArray[np.uint8]) -> None:
    from PIL import Image

    from octex.container import replacing

    picture = Image.fromarray(codes)
    with replacing(path) as file:
        picture.save(file, "PNG")


def _say_what_was_drawn(options: argparse.Namespace, camera: Camera, seconds: float) -> None:
    made: dict[str, Any] = {
        "output": str(options.view),
        "size": [camera.width, camera.height],
        "bytes": options.view.stat().st_size,
        "seconds": round(seconds, 3),
    }
    if options.camera_out is not None:
        made["camera"] = str(options.camera_out)
    if options.json:
        say(json.dumps(made))
        return
    pixels = f"{camera.width}×{camera.height} pixels"
    say(f"{options.view}: {pixels}, {bytes_text(made['bytes'])}, {seconds:.1f} s")
    if options.camera_out is not None:
        say(f"{options.camera_out}: its camera")


if __name__ == "__main__":
    sys.exit(main())
