"""Reads the models, textures and cameras on the command line."""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import octex
from octex.cli.parser import Options
from octex.cli.values import (
    PTEX_ENDING,
    TEXTURE_ENDINGS,
    WEB_ENDING,
    Address,
    FunctionName,
    function_name,
)
from octex.errors import ArgumentError, InputError

if TYPE_CHECKING:
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture


def refuse(options: Options, words: Iterable[str], why: str, path: Path | Address | None = None) -> None:
    """Raise ArgumentError for the first of ``words`` that is on the command line, about a file."""
    for word in options.words:
        if word in words:
            raise ArgumentError(f"{'' if path is None else f'{path}: '}{word} {why}")


def is_texture(path: Path | Address) -> bool:
    """Return whether a file is a texture, by its ending."""
    return path.suffix.lower() in TEXTURE_ENDINGS


def kind_of(path: Path | Address) -> str:
    """Return the kind of a file: "texture", "cloud" for points without a surface, "voxels" or "model"."""
    if isinstance(path, Address) or is_texture(path):
        return "texture"
    if path.suffix.lower() in (".ply", ".xyz", ".npz", ".vxz"):  # other endings are known without an import
        from octex.source.cloud import is_cloud
        from octex.source.voxels import is_voxels

        if is_voxels(path):
            return "voxels"
        return "cloud" if is_cloud(path) else "model"
    return "model"


def check_texture(path: Path | Address) -> None:
    """Refuse a folder, and a file whose ending is not that of a texture."""
    if path.is_dir():
        raise ArgumentError(
            f"{path}: is a folder; give a texture's file (view, info and validate read folders of --parts)"
        )
    if not is_texture(path) and path.suffix.lower() not in (WEB_ENDING, ".glb", ".gltf"):
        raise ArgumentError(
            f"{path}: is not a {TEXTURE_ENDINGS[0]} file; octex convert makes one from a model"
        )


def open_texture(path: Path | Address) -> OctreeTexture:
    """Open and validate a texture, also in a web file or a glTF model.

    Errors name the file and the broken part.
    """
    check_texture(path)
    texture = octex.open(str(path))
    texture.validate()
    return texture


def note_layers(texture: OctreeTexture, path: Path | Address, note: Callable[[str], None]) -> None:
    """Note that the layers in a texture do not change when the texture is edited."""
    if "layers" in texture.metadata:
        note(f"{path} has layers: the edit changes the visible texture, not its layers")


def only(texture: OctreeTexture, channel: str) -> OctreeTexture:
    """Return a texture reduced to one channel and alpha, which lookups need."""
    from octex.checks import as_choice

    as_choice(channel, texture.channels, "channel of the texture")
    channels = {name: each for name, each in texture.channels.items() if name in (channel, "alpha")}
    return texture.with_cells(texture.tree, channels)


def shaped_model(path: Path, options: Options, cell: float | None = None, **settings: Any) -> Surface:
    """Read a model with ``octex.load_surface``, with --rest, --pose, --repair and --subdiv.

    --repair closes cracks narrower than ``cell`` (default: than the cells that the options ask for).
    """
    surface = octex.load_surface(path, options.rest, pose=options.pose, finite=options.repair, **settings)
    if options.repair:
        cell = options.cell if cell is None else cell
        if cell is None and options.depth is not None:
            cell = float((surface.bounds[1] - surface.bounds[0]).max()) / 2.0**options.depth
        surface, _ = octex.repair(surface, cell=cell)
    if options.subdiv is None:
        return surface
    levels, rest = options.subdiv
    return octex.subdivide(surface, levels, rest=rest)


def repair_facts(surface: Surface | None) -> tuple[dict[str, Any], list[str]]:
    """Return the changes of --repair, for JSON and as a line; empty without it."""
    from octex.cleaning.repair import REPAIR, Repairs

    if surface is None or REPAIR not in surface.provenance:
        return {}, []
    counts = Repairs(**json.loads(surface.provenance[REPAIR]))
    return {REPAIR: counts._asdict()}, [f"repair: {counts}"]


def bare_model(path: Path, options: Options) -> Surface:
    """Read only the shape of a model, with its normals."""
    surface = shaped_model(path, options, channels=["alpha"], sources={"alpha": 1.0}, normals=True)
    del surface.provenance["source_alpha"]
    return surface


def check_model(options: Options, path: Path | Address) -> None:
    """Refuse options about a model and its colours that contradict each other."""
    models = [path, *options.also]
    has_function = any(function_name(str(each)) for each in models)
    if has_function:
        refuse(options, ("--pose", "--subdiv", "--repair"), "applies to meshes, not to functions")
    elif options.grid is not None:
        raise ArgumentError("--grid applies to implicit surfaces only: FILE.py:NAME")
    if options.also:
        refuse(options, ("--rest", "--pose", "--repair"), "applies to one model; leave out --also")
    if options.transfer is None:
        refuse(options, ["--within"], "needs --transfer")
    _sources(options)


def read_model(path: Path, options: Options, extra: Sequence[str] = ()) -> Surface:
    """Read a model or FILE.py:NAME at rest with its channels; ``extra`` ones only if the model has them."""
    sources = {**_transferred(options), **_sources(options)}
    for channel, source in sources.items():
        if isinstance(source, FunctionName):
            sources[channel] = load_function(source)
    names = _read_channels(options)
    surfaces = [_read(each, options, sources, None if extra else names) for each in [path, *options.also]]
    surface = octex.Surface.joined(surfaces) if options.also else surfaces[0]
    if names is None or not extra:
        return surface
    extra_names = [form.name for form in surface.channels if form.name in extra and form.name not in names]
    return surface.with_channels([*names, *extra_names])


def _read(path: Path, options: Options, sources: dict[str, Any], names: Sequence[str] | None) -> Surface:
    named = function_name(str(path))
    if path.suffix == ".py":
        raise ArgumentError(f"{path}: name the function in it, like {path}:NAME")
    if named is None:
        return shaped_model(path, options, channels=names, sources=sources, filter=options.filter)
    if options.grid is None:
        raise ArgumentError(f"{path} is a function: give --grid x0,y0,z0,x1,y1,z1,EDGE too")
    bounds = [options.grid[:3], options.grid[3:6]]
    surface = octex.Surface.from_function(load_function(named), bounds, options.grid[6], name=named.path.name)
    return surface.completed(sources, names, options.filter)


def _read_channels(options: Options) -> list[str] | None:
    """Return the channels to read, None for all: --channels, and the one of --detail."""
    from octex.conversion.convert import with_detail

    return with_detail(options.channels, options.detail)


def _sources(options: Options) -> dict[str, Any]:
    """Return the sources of channels by name; refuse a channel that is repeated or not read."""
    sources: dict[str, Any] = {}
    for name, source in options.source:
        if name in sources:
            raise ArgumentError(f"--source gives {name} twice")
        names = _read_channels(options)
        if names is not None and name not in names:
            raise ArgumentError(f"--source gives {name}, but --channels leaves it out")
        sources[name] = source
        if isinstance(source, Path) and source.suffix.lower() == PTEX_ENDING:
            sources[name] = octex.Ptex(source)
        elif options.project is not None and isinstance(source, Path):
            sources[name] = octex.MappedImage(source, **options.project)
    if options.project is not None and not any(isinstance(source, Path) for _, source in options.source):
        raise ArgumentError("--project needs an image to project: --source base_color=FILE")
    return sources


def _transferred(options: Options) -> dict[str, Any]:
    path = options.transfer
    if path is None:
        return {}
    if path.suffix.lower() == PTEX_ENDING:
        refuse(options, ["--within"], f"cannot be used for {path}, which belongs to the model")
        return {**octex.Ptex(path).sources}
    if "radius" in options.within or kind_of(path) == "cloud":
        return {**octex.PointCloud.load(path, **options.within).sources}
    return {**octex.Transfer(path, **options.within).sources}


def load_function(named: FunctionName) -> Callable[..., Any]:
    """Run a Python file and return its function.

    The file can import modules in its folder, as with ``python FILE.py``. Raises InputError for a file that
    is unreadable or raises, and for a name that is not a function in it.
    """
    path = named.path.resolve()
    spec = importlib.util.spec_from_file_location(f"octex_functions:{path}", path)
    assert spec is not None and spec.loader is not None  # guaranteed by its ending
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look up annotations there
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))  # permanent: functions may import when called
    try:
        spec.loader.exec_module(module)
    except OSError as error:
        raise InputError(f"{named.path} cannot be read: {error.strerror or error}") from None
    except Exception as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{named.path} raised {type(error).__name__}: {reason}; fix the function") from error
    function = getattr(module, named.name, None)
    if not callable(function):
        known = [name for name, each in vars(module).items() if callable(each) and not name.startswith("_")]
        raise InputError(f"{named.path} has no function {named.name}; it has {', '.join(known) or 'none'}")
    return function  # type: ignore[no-any-return]
