"""The render file of a texture (paper 3.6): what is on disk.

See container for the bytes around it. With n cells, s of them split, with r rows, and k of them kept:

    tree/groups           U64 (⌈nodes / 8⌉, 3)       these five as tree/layout draws them
    tree/level_cells      I64 (max_depth + 2,)
    tree/level_nodes      I64 (max_depth + 2,)
    tree/flags            U8 (n,)
    tree/areas            U8 (n,)
    split/cells           U32 (s,)                   the split table; absent without split cells
    split/facings         U8 (s,)
    split/areas           U8 (r,)
    kept/cells            U32 (k,)                   the kept nodes; absent if there are none
    channels/NAME         U8, U16, F16 or F32 (n, components)
    split/channels/NAME   the same type (r, components); likewise
    kept/channels/NAME    the same type (k, components); likewise

    metadata              "format": "octex", "format_version": "1", and as JSON
    placement             {"origin": [x, y, z], "size": edge} of the root cell, in rest positions
    bounds                [[x, y, z], [x, y, z]] of the surface, in rest positions
    channels              {NAME: colour space, …}, in the order of the texture's channels
    provenance            {name: text, …}

Other tensors and metadata are kept when an opened texture is saved again.
"""

from __future__ import annotations

import json
import mmap
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np

from octex import container
from octex.arrays import Array, Float64s
from octex.channels import ChannelFormat
from octex.errors import TextureFileError
from octex.texture.channel import Channel
from octex.tree.layout import KeptTable, SplitTable, TreeArrays
from octex.tree.octree import Octree, no_kept, no_split
from octex.tree.placement import Placement

Result = TypeVar("Result")

FORMAT = "octex"
FORMAT_VERSION = 1
ENDING = ".octex"
ARCHIVE_ENDING = ".octz"


class Parts(NamedTuple):
    """What a texture is made of."""

    tree: Octree
    channels: Mapping[str, Channel]
    placement: Placement
    bounds: Float64s  # (2, 3)
    metadata: Mapping[str, str]


class File(NamedTuple):
    """The file that a texture was opened from."""

    path: str
    mapping: mmap.mmap | None  # None: it was pickled or copied, and lies in memory
    tensors: dict[str, Array]  # those that octex does not know
    metadata: dict[str, str]
    sizes: dict[str, int] | None = None  # of an archive: bytes of its streams


def written(parts: Parts, file: File | None) -> tuple[dict[str, Array], dict[str, str]]:
    """Return a texture's tensors and metadata, with what octex does not know of its ``file``."""
    tree = parts.tree
    tensors: dict[str, Array] = {f"tree/{name}": array for name, array in tree.arrays._asdict().items()}
    if tree.split.cells.size:
        tensors |= {f"split/{name}": array for name, array in tree.split._asdict().items()}
    if tree.kept.cells.size:
        tensors["kept/cells"] = tree.kept.cells
    for name, channel in parts.channels.items():
        tensors[f"channels/{name}"] = channel.values
        if tree.split.cells.size:
            tensors[f"split/channels/{name}"] = channel.split_values
        if tree.kept.cells.size:
            tensors[f"kept/channels/{name}"] = channel.kept_values
    metadata = {
        "format": FORMAT,
        "format_version": str(FORMAT_VERSION),
        "placement": json.dumps({"origin": parts.placement.origin, "size": parts.placement.size}),
        "bounds": json.dumps(parts.bounds.tolist()),
        "channels": json.dumps({name: channel.format.space for name, channel in parts.channels.items()}),
        "provenance": json.dumps(dict(parts.metadata)),
    }
    if file:
        tensors |= file.tensors
        metadata |= file.metadata
    return tensors, metadata


def described(parts: Parts, file: File | None) -> dict[str, Any]:
    """Describe a texture: what `OctreeTexture.info` returns."""
    tree = parts.tree
    tensors, metadata = written(parts, file)
    sizes = {
        "header": len(container.header(tensors, metadata)),
        "structure": sum(array.nbytes for array in tree.arrays[:3]),
        "flags": tree.arrays.flags.nbytes,
        "areas": tree.arrays.areas.nbytes,
        "split": sum(array.nbytes for array in tree.split),
        "kept": tree.kept.cells.nbytes,
        **{f"channel {name}": channel.nbytes for name, channel in parts.channels.items()},
        "other": sum(array.nbytes for array in file.tensors.values()) if file else 0,
    }
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "placement": {"origin": list(parts.placement.origin), "size": parts.placement.size},
        "bounds": parts.bounds.tolist(),
        "depth": tree.max_depth,
        "finest_cell": parts.placement.size / (1 << tree.max_depth),
        "cells": tree.n_cells,
        "leaves": tree.n_leaves,
        "nodes": tree.n_nodes,
        "split_cells": tree.split.cells.size,
        "kept_nodes": tree.kept.cells.size,
        "levels": [
            {"level": level, "leaves": leaves, "nodes": nodes}
            for level, (leaves, nodes) in enumerate(tree.cells_by_depth())
        ],
        "bytes": {**sizes, "total": sum(sizes.values())},
        **({"archive": file.sizes} if file and file.sizes else {}),
        "channels": [channel.format._asdict() for channel in parts.channels.values()],
        "provenance": dict(parts.metadata),
    }


def taken(tensors: dict[str, Array], metadata: dict[str, str]) -> Parts:
    """Take a texture out of tensors and metadata; what octex does not know stays there.

    Raises TextureFileError for what is missing or damaged, ArgumentError for a tree that does not fit.
    """
    if metadata.pop("format", None) != FORMAT:
        raise TextureFileError("is not an octree texture; make one with octree-convert")
    version = metadata.pop("format_version", "")
    if version != str(FORMAT_VERSION):
        raise TextureFileError(f"has format version {version!r}, {wrong_version(version)}")
    placement = _json(metadata, "placement", _placement)
    bounds = _json(metadata, "bounds", _floats)
    spaces = _json(metadata, "channels", _texts)
    provenance = _json(metadata, "provenance", _texts)
    arrays = TreeArrays(*(_tensor(tensors, f"tree/{name}") for name in TreeArrays._fields))
    split, kept = no_split(), no_kept()
    if "split/cells" in tensors:
        split = SplitTable(*(_tensor(tensors, f"split/{name}") for name in SplitTable._fields))
    if "kept/cells" in tensors:
        kept = KeptTable(_tensor(tensors, "kept/cells"))
    tree = Octree(arrays, split, kept)
    channels = {}
    for name, space in spaces.items():
        values = _tensor(tensors, f"channels/{name}")
        if values.ndim != 2:
            raise TextureFileError(f"channel {name!r} has shape {values.shape}, not a row a cell")
        split_values = _tensor(tensors, f"split/channels/{name}") if split.cells.size else values[:0]
        kept_values = _tensor(tensors, f"kept/channels/{name}") if kept.cells.size else values[:0]
        form = ChannelFormat(name, values.shape[1], space, values.dtype.name)  # type: ignore[arg-type]
        channels[name] = Channel(form, values, split_values, kept_values)
    return Parts(tree, channels, placement, bounds, provenance)


def wrong_version(version: str) -> str:
    """Say what is wrong with a version that is not the one that is read."""
    if re.fullmatch("[1-9][0-9]*", version):  # there is none before the first
        return "newer than this octex reads; update octex"
    return "which is none: damaged, or made by something else; make it again"


def _tensor(tensors: dict[str, Array], name: str) -> Array:
    if name not in tensors:
        raise TextureFileError(f"lacks the tensor {name!r}: damaged, or not an octree texture")
    return tensors.pop(name)


def _json(metadata: dict[str, str], name: str, meaning: Callable[[Any], Result]) -> Result:
    try:
        return meaning(json.loads(metadata.pop(name)))
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError):
        raise TextureFileError(f"its metadata {name!r} are missing or damaged") from None


def _placement(value: Any) -> Placement:
    x, y, z = _floats(value["origin"]).tolist()
    return Placement((x, y, z), float(value["size"]))


def _floats(value: Any) -> Float64s:
    return np.array(value, np.float64)


def _texts(value: Any) -> dict[str, str]:
    if not isinstance(value, dict) or not all(isinstance(text, str) for text in value.values()):
        raise TypeError
    return value
