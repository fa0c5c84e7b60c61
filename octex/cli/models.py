"""Models and textures as the options name them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import octex
from octex.cli.addresses import TEXTURE_ENDINGS, Address
from octex.cli.arguments import STRETCH
from octex.cli.functions import FunctionName, function_name, load_function
from octex.cli.shape_options import check_shape, shaped_model
from octex.errors import ArgumentError

if TYPE_CHECKING:
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture

PTEX_ENDING = ".ptx"
DEFAULT_FILTER = "ewa"
DEFAULT_CHANNEL = "base_color"  # what is painted


def sources_of(options: argparse.Namespace) -> dict[str, object]:
    """Return what channels are to come from, by their names.

    Raises ArgumentError for a channel given twice or not among those that are wanted.
    """
    sources: dict[str, object] = {}
    wanted = _wanted(options)
    _check_projection(options)
    for name, given in options.source or []:
        if name in sources:
            raise ArgumentError(f"--source gives {name} twice")
        if wanted is not None and name not in wanted:
            raise ArgumentError(f"--source gives {name}, but --channels leaves it out")
        sources[name] = given
        if isinstance(given, Path) and given.suffix.lower() == PTEX_ENDING:
            sources[name] = octex.Ptex(given)
        elif options.project is not None and isinstance(given, Path):
            sources[name] = octex.MappedImage(
                given,
                options.project,
                axis=options.project_axis or "z",
                center=options.project_center,
                size=options.project_size,
            )
    return sources


def _check_projection(options: argparse.Namespace) -> None:
    """Refuse options of a projection without one, and one without an image."""
    if options.project is None:
        for name in ("axis", "center", "size"):
            if getattr(options, f"project_{name}") is not None:
                raise ArgumentError(f"--project-{name} has no meaning without --project")
    elif not any(isinstance(given, Path) for _, given in options.source or []):
        raise ArgumentError("--project needs an image to project: --source base_color=FILE")
    elif options.project == "spherical" and options.project_size is not None:
        raise ArgumentError("--project-size has no meaning with --project spherical: one copy goes around")


def _wanted(options: argparse.Namespace) -> list[str] | None:
    """Return the channels to read: those to convert or compare, and the one that says how deep to go."""
    steering = None if options.detail == STRETCH else options.detail
    if options.channels is None or steering is None or steering in options.channels:
        return options.channels  # type: ignore[no-any-return]
    return [*options.channels, steering]


def check_elsewhere(options: argparse.Namespace) -> None:
    """Refuse options of what values are taken from without it, and two of it; likewise of functions."""
    models = [options.INPUT, *(options.diff or []), *(options.also or [])]
    is_function = any(each is not None and function_name(str(each)) for each in models)
    for word, given in (("--bounds", options.bounds), ("--edge", options.edge)):
        if given is not None and not is_function:
            raise ArgumentError(f"{word} is for surfaces that are functions: FILE.py:NAME")
    check_shape(options, is_function)
    if options.also and options.rest is not None:
        raise ArgumentError("--rest is of one model; with --also there are more")
    if options.transfer is not None and options.cloud is not None:
        raise ArgumentError("--transfer and --cloud both say where colours come from; give one of them")
    if options.radius is not None and options.cloud is None:
        raise ArgumentError("--radius has no meaning without --cloud")
    if options.radius is not None and options.max_distance is not None:
        raise ArgumentError("--radius and --max-distance both say how far points count; give one of them")
    if options.transfer is None and options.cloud is None:
        for word, given in (("--max-distance", options.max_distance), ("--max-angle", options.max_angle)):
            if given is not None:
                raise ArgumentError(f"{word} has no meaning without --transfer or --cloud")


def _elsewhere(options: argparse.Namespace) -> dict[str, object]:
    """Return what channels are taken from another model, from points or from a .ptx file."""
    ptex = getattr(options, "ptex", None)
    if ptex is not None:
        return {**octex.Ptex(ptex).sources}
    if options.transfer is not None:
        limit = 180.0 if options.max_angle is None else options.max_angle
        return {**octex.Transfer(options.transfer, distance=options.max_distance, max_angle=limit).sources}
    if options.cloud is not None:
        limit = 90.0 if options.max_angle is None else options.max_angle
        cloud = octex.PointCloud.load(
            options.cloud, radius=options.radius, distance=options.max_distance, max_angle=limit
        )
        return {**cloud.sources}
    return {}


def kind_of(path: Path | Address) -> str:
    """Return what a file holds: "texture", "cloud" for points without a surface, "voxels" or "model"."""
    ending = path.suffix.lower()
    if isinstance(path, Address) or ending in TEXTURE_ENDINGS:
        return "texture"
    if ending in (".ply", ".xyz", ".npz", ".vxz"):  # else it is known without an import
        from octex.source.cloud import is_cloud
        from octex.source.voxels import is_voxels

        if is_voxels(path):
            return "voxels"
        return "cloud" if is_cloud(path) else "model"
    return "model"


def input_files(options: argparse.Namespace) -> list[Path]:
    """Return the files that are read beside a model."""
    given = [each for _, each in options.source or []]
    files = [each.path if isinstance(each, FunctionName) else each for each in given]
    ptex = getattr(options, "ptex", None)
    others = [options.rest, options.transfer, options.cloud, ptex, *(options.also or [])]
    return [each for each in [*files, *others] if isinstance(each, Path)]


def read_model(path: Path, options: argparse.Namespace, beside: Sequence[str] = ()) -> Surface:
    """Read a model at its rest positions, with the channels that are used, wherever they come from.

    It may be a function, FILE.py:NAME, and there may be others beside it: ``--also``. Channels ``beside``
    those that are used are read if the model has them.
    """
    sources = {**_elsewhere(options), **sources_of(options)}
    for channel, given in sources.items():
        if isinstance(given, FunctionName):
            sources[channel] = load_function(given)
    names = _wanted(options)
    wanted = None if beside else names
    every = [_read(each, options, sources, wanted) for each in [path, *(options.also or [])]]
    surface = octex.Surface.joined(every) if options.also else every[0]
    if names is None or not beside:
        return surface
    others = [form.name for form in surface.channels if form.name in beside and form.name not in names]
    return surface.with_channels([*names, *others])


def _read(
    path: Path, options: argparse.Namespace, sources: dict[str, object], wanted: Sequence[str] | None
) -> Surface:
    named = function_name(str(path))
    image_filter = options.filter or DEFAULT_FILTER
    if path.suffix == ".py":
        raise ArgumentError(f"{path}: name the function in it, like {path}:NAME")
    if named is None:
        return shaped_model(path, options, channels=wanted, sources=sources, filter=image_filter)
    if options.bounds is None or options.edge is None:
        raise ArgumentError(f"{path} is a function: give --bounds x0,y0,z0,x1,y1,z1 and --edge LENGTH too")
    bounds = [options.bounds[:3], options.bounds[3:]]
    surface = octex.Surface.from_function(load_function(named), bounds, options.edge, name=named.path.name)
    return surface.completed(sources, wanted, image_filter)


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """Return what the options say of a conversion, as ``octex.convert`` takes it."""
    names = ("depth", "cell", "channels", "dtype", "max_error", "detail")
    return {**{name: getattr(options, name) for name in names}, "fit": not options.no_fit}


def told_of(texture: OctreeTexture, path: Path, seconds: float) -> dict[str, Any]:
    """Return what a machine is told of a texture that was written."""
    tree = texture.tree
    return {
        "output": str(path),
        "leaves": tree.n_leaves,
        "nodes": tree.n_nodes,
        "depth": tree.max_depth,
        "bytes": path.stat().st_size,
        "seconds": round(seconds, 3),
    }


def posed_inputs(options: argparse.Namespace) -> list[Path | None]:
    """Return the files of a model that cameras see, and of the cameras; None for what is not given."""
    return [options.MODEL, options.rest, None if options.camera is None else options.camera[0]]


def new_texture(options: argparse.Namespace) -> str:
    """Say that there is no texture yet."""
    return "there is no texture yet" if options.TEXTURE is None else f"{options.TEXTURE} does not exist yet"


def read_posed(options: argparse.Namespace) -> Surface:
    """Read a model that cameras see: of its materials what a preview shows, else nothing."""
    if options.preview is not None:
        return shaped_model(options.MODEL, options, normals=True)
    surface = shaped_model(options.MODEL, options, channels=["alpha"], sources={"alpha": 1.0}, normals=True)
    del surface.provenance["source_alpha"]
    return surface


def open_sound(path: Path | Address) -> OctreeTexture:
    """Open a texture whose content is proved; raises TextureFileError that names what is broken."""
    texture = octex.open(str(path))
    texture.validate()
    return texture


def texture_of(options: argparse.Namespace) -> OctreeTexture | None:
    """Open the texture of a model, if it is there."""
    is_there = options.TEXTURE is not None and options.TEXTURE.exists()
    return open_sound(options.TEXTURE) if is_there else None


def only(texture: OctreeTexture, channel: str) -> OctreeTexture:
    """Return a texture with one channel, and alpha, by which it is looked up."""
    from octex.checks import as_choice
    from octex.texture import OctreeTexture

    as_choice(channel, texture.channels, "channel of the texture")
    kept = {name: each for name, each in texture.channels.items() if name in (channel, "alpha")}
    return OctreeTexture(texture.tree, kept, texture.placement, texture.bounds, texture.metadata)
