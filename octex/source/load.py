"""Read a model file as a surface."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

import numpy as np
import numpy.typing as npt

from octex.checks import as_choice, as_entries, as_flag, as_names, as_path, as_text, is_path
from octex.errors import ArgumentError, MissingExtraError, ModelError, ModelWarning, OctexError, damaged
from octex.files import read_bytes, reading
from octex.source.images.filters import FILTERS
from octex.source.models.gltf import load_gltf, load_gltf_motion
from octex.source.models.meshfiles import load_off, load_stl
from octex.source.models.obj import load_obj
from octex.source.models.ovoxel import load_voxel_surface
from octex.source.models.ply import Ply
from octex.source.models.reading import Options
from octex.source.models.threemf import load_3mf
from octex.source.motion import Motion
from octex.source.surface import Surface
from octex.source.voxels import VOXEL_ENDINGS


def _load_usd(path: Path, options: Options) -> Surface:
    try:
        import_module("pxr")
    except ImportError:
        raise MissingExtraError.needed(f"{path.name}: to read USD", "usd-core", "usd") from None
    from octex.source.models.usd import load_usd

    return load_usd(path, options)


_GLTF = ".glb", ".gltf"
_READERS: dict[str, Callable[[Path, Options], Surface]] = {
    **dict.fromkeys(_GLTF, load_gltf),
    ".obj": load_obj,
    ".ply": lambda path, options: Ply(path).surface(options),
    ".off": load_off,
    ".stl": load_stl,
    ".3mf": load_3mf,
    **dict.fromkeys(VOXEL_ENDINGS, load_voxel_surface),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), _load_usd),
}

#: The endings of model files that octex reads.
MODEL_ENDINGS = tuple(_READERS)


def load_surface(
    path: str | os.PathLike[str],
    rest: str | os.PathLike[str] | npt.ArrayLike | None = None,
    *,
    channels: Sequence[str] | None = None,
    sources: Mapping[str, object] | None = None,
    filter: str = "ewa",
    normals: bool = False,
    pose: str | None = None,
    finite: bool = False,
) -> Surface:
    """Read a model: its triangles as placed in the scene, and its materials.

    path       the model's file
    rest       rest positions: another file with the same triangles, or an array (vertices, 3). Positions are
               in the model's units
    channels   names of the channels to read (default: all that the materials define)
    sources    replacements for channels, as for ``Surface.with_sources``
    filter     of images over footprints: "nearest", "bilinear", "bicubic", "trilinear" or "ewa"
    normals    keep the model's shading normals as ``Surface.frames``
    pose       "NAME@SECONDS": the pose of an animated glTF model, by its nodes, skins and morph targets. Rest
               positions do not change. See ``octex help surfaces``
    finite     leave out triangles with vertices that are not finite, instead of refusing the model;
               ``provenance["not_finite"]`` is their number

    Raises ModelError or ImageError, with one line that names the file, the cause and the remedy;
    MissingExtraError if a format needs an extra; ArgumentError for names and values that do not fit, or a
    pose that the file lacks. Warns with ModelWarning about content that is left out or normalized.
    """
    as_choice(filter, FILTERS, "filter")
    replaced = {} if sources is None else as_entries(sources, "sources")
    names = None if channels is None else as_names(channels, "channels")
    read_names = None if names is None else tuple(name for name in names if name not in replaced)
    file = as_path(path)
    pose = None if pose is None else as_text(pose, "pose")
    if pose is not None and file.suffix.lower() not in _GLTF:
        raise ArgumentError(f"{file.name} cannot be posed as {pose!r}: only glTF models can")
    with_normals = as_flag(normals, "normals") or "normal" in replaced
    finite = as_flag(finite, "finite")
    surface = _read(file, Options(True, read_names, filter, tuple(replaced), with_normals, pose, finite))
    surface.provenance["filter"] = filter
    if pose is not None:
        surface.provenance["pose"] = pose
    if rest is not None:
        surface = at_rest(surface, rest)
    return surface.completed(replaced, names, filter)


def load_motion(path: str | os.PathLike[str], rate: float = 30.0) -> Motion | None:
    """Return the animations of a model, of ``rate`` frames a second; None if it has none.

    Vertices are those of ``load_surface``, in its order. Raises ModelError for broken skins and morph
    targets; the motion's ``faults`` list broken animations.
    """
    file = as_path(path)
    if file.suffix.lower() not in _GLTF:
        return None
    with _parsing(file):
        return load_gltf_motion(file, rate)


def at_rest(surface: Surface, rest: str | os.PathLike[str] | npt.ArrayLike) -> Surface:
    """Return the surface with the rest positions of another model file or of an array.

    Raises ModelError as ``load_surface`` does.
    """
    if not is_path(rest):
        return surface.with_rest(rest)  # type: ignore[arg-type]
    other = _read(as_path(rest, "rest"), Options(materials=False))
    if len(other.vertices) != len(surface.vertices) or not np.array_equal(other.triangles, surface.triangles):
        raise ModelError(
            f"{other.name} cannot be the rest mesh of {surface.name}: the topology differs "
            f"({len(other.vertices)} vertices and {len(other.triangles)} triangles, "
            f"{len(surface.vertices)} and {len(surface.triangles)}); both must list the same triangles"
        )
    surface = surface.with_rest(other.vertices)
    surface.provenance["rest"] = other.provenance["source"]
    surface.provenance["rest_sha256"] = other.provenance["sha256"]
    return surface


def _read(path: Path, options: Options) -> Surface:
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        endings = ", ".join(MODEL_ENDINGS)
        raise ModelError(f"{path.name or path} is not a model that octex reads; it reads {endings}")
    with _parsing(path):
        data = read_bytes(path)
        if not data:
            raise ModelError(f"{path.name} is empty; export the model again")
        digest = hashlib.sha256(data).hexdigest()
        del data
        with np.errstate(all="ignore" if options.finite else None):
            surface = reader(path, options)
    surface.provenance = {"source": path.name, "sha256": digest, **surface.provenance}
    return surface


@contextmanager
def _parsing(path: Path) -> Iterator[None]:
    """Turn any exception of a parser into one line."""
    try:
        with reading(path):
            yield
    except (OctexError, ModelWarning):  # warnings may be errors
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, KeyError):
            reason = f"{error} is missing or unknown"
        elif isinstance(error, (AttributeError, TypeError)):
            reason = "a value has the wrong type"
        raise damaged(f"{path.name} is malformed ({reason})") from error
