"""The render file of a texture (paper 3.6).

See container for the bytes around it. With n cells, s of them split, with r rows, and k kept nodes:

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

An opened texture saves unknown tensors and metadata again.
"""

from __future__ import annotations

import json
import mmap
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import compress
from typing import TYPE_CHECKING, Any, ClassVar, TypeGuard, TypeVar

import numpy as np

from octex import container
from octex.archive.layout import (
    KEPT_NAME,
    RENDER_FORMAT,
    RENDER_VERSION,
    SPLIT_NAMES,
    TREE_NAMES,
    channel_names,
    render_metadata,
)
from octex.arrays import Array, Float64s
from octex.channels import ChannelFormat
from octex.errors import TextureFileError
from octex.texture.channel import Channel
from octex.tree.layout import NO_KEPT, NO_SPLIT, KeptTable, SplitTable, TreeArrays
from octex.tree.octree import Octree
from octex.tree.placement import Placement

if TYPE_CHECKING:
    from octex.texture.lookup import Request
    from octex.texture.texture import OctreeTexture

Result = TypeVar("Result")

ENDING = ".octex"
ARCHIVE_ENDING = ".octz"


@dataclass(eq=False)
class Storage:
    """The origin of a texture's arrays: memory, or the file that it was opened from."""

    path: str = ""  # "" for textures in memory
    mapping: mmap.mmap | None = None  # of a render file; None: the arrays lie in memory
    tensors: dict[str, Array] = field(default_factory=dict)  # unknown ones
    metadata: dict[str, str] = field(default_factory=dict)
    sizes: dict[str, int] | None = None  # of an archive: bytes of its streams
    #: Whether lookups need no fetching.
    is_local: ClassVar = True

    def loaded(self, texture: OctreeTexture) -> OctreeTexture:
        """Return a texture of the loaded part: all of it."""
        return texture

    def load_all(self, texture: OctreeTexture) -> OctreeTexture:
        """Prepare to read all of a texture, and return it."""
        if self.mapping:
            container.read_ahead(self.mapping)
        return texture

    def load_levels(self, texture: OctreeTexture, _level: int) -> OctreeTexture:
        """Return a texture with levels 0 … ``level`` loaded."""
        return texture

    def prepare(
        self, texture: OctreeTexture, count: int, _request: Callable[[], Request], /
    ) -> OctreeTexture:
        """Prepare lookups of ``count`` points, and return the texture that answers them."""
        # About a page a point: most of the file will be read.
        if self.mapping and count * mmap.PAGESIZE > len(self.mapping):
            container.read_ahead(self.mapping)
        return texture


def contents_of(texture: OctreeTexture) -> tuple[dict[str, Array], dict[str, str]]:
    """Return a texture's tensors and metadata, including unknown ones of its file."""
    tree, placement = texture.tree, texture.placement
    tensors: dict[str, Array] = dict(zip(TREE_NAMES, tree.arrays, strict=True))
    has_rows = True, tree.split.cells.size > 0, tree.kept.cells.size > 0
    if has_rows[1]:
        tensors |= zip(SPLIT_NAMES, tree.split, strict=True)
    if has_rows[2]:
        tensors[KEPT_NAME] = tree.kept.cells
    for name, channel in texture.channels.items():
        named = zip(channel_names(name), channel[1:], strict=True)
        tensors |= compress(named, has_rows)
    spaces = {name: channel.format.space for name, channel in texture.channels.items()}
    metadata = render_metadata(placement._asdict(), texture.bounds.tolist(), spaces, dict(texture.metadata))
    return tensors | texture.storage.tensors, metadata | texture.storage.metadata


def info_of(texture: OctreeTexture) -> dict[str, Any]:
    """Describe a texture for `OctreeTexture.info`."""
    tree, placement, storage = texture.tree, texture.placement, texture.storage
    tensors, metadata = contents_of(texture)
    sizes = {
        "header": len(container.header(tensors, metadata)),
        "structure": sum(array.nbytes for array in tree.arrays[:3]),
        "flags": tree.arrays.flags.nbytes,
        "areas": tree.arrays.areas.nbytes,
        "split": sum(array.nbytes for array in tree.split),
        "kept": tree.kept.cells.nbytes,
        **{f"channel {name}": channel.nbytes for name, channel in texture.channels.items()},
        "other": sum(array.nbytes for array in storage.tensors.values()),
    }
    return {
        "format": RENDER_FORMAT,
        "format_version": RENDER_VERSION,
        "placement": {"origin": list(placement.origin), "size": placement.size},
        "bounds": texture.bounds.tolist(),
        "depth": tree.max_depth,
        "finest_cell": placement.size / (1 << tree.max_depth),
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
        **({"archive": storage.sizes} if storage.sizes else {}),
        "channels": [channel.format._asdict() for channel in texture.channels.values()],
        "provenance": dict(texture.metadata),
    }


def take_parts(
    tensors: dict[str, Array], metadata: dict[str, str]
) -> tuple[Octree, dict[str, Channel], Placement, Float64s, dict[str, str]]:
    """Take a texture's parts out of tensors and metadata; unknown entries stay there.

    Raises TextureFileError for missing or damaged parts, ArgumentError for a tree that does not fit.
    """
    if metadata.pop("format", None) != RENDER_FORMAT:
        raise TextureFileError("is not an octree texture; make one with octex convert")
    version = metadata.pop("format_version", "")
    if version != str(RENDER_VERSION):
        raise TextureFileError(f"has format version {version!r}, {wrong_version(version)}")
    placement = _json(metadata, "placement", _placement)
    bounds = _json(metadata, "bounds", _floats)
    spaces = _json(metadata, "channels", _texts)
    provenance = _json(metadata, "provenance", _texts)
    arrays = TreeArrays(*(_tensor(tensors, name) for name in TREE_NAMES))
    split, kept = NO_SPLIT, NO_KEPT
    if SPLIT_NAMES[0] in tensors:
        split = SplitTable(*(_tensor(tensors, name) for name in SPLIT_NAMES))
    if KEPT_NAME in tensors:
        kept = KeptTable(_tensor(tensors, KEPT_NAME))
    tree, channels = Octree(arrays, split, kept), {}
    for name, space in spaces.items():
        of_cells, of_split, of_kept = channel_names(name)
        values = _tensor(tensors, of_cells)
        if values.ndim != 2:
            raise TextureFileError(f"channel {name!r} has shape {values.shape}, not a row a cell")
        split_values = _tensor(tensors, of_split) if split.cells.size else values[:0]
        kept_values = _tensor(tensors, of_kept) if kept.cells.size else values[:0]
        form = ChannelFormat(name, values.shape[1], space, values.dtype.name)  # type: ignore[arg-type]
        channels[name] = Channel(form, values, split_values, kept_values)
    return tree, channels, placement, bounds, provenance


def wrong_version(version: str) -> str:
    """Explain a format version that octex does not read."""
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


def are_texts(value: Any) -> TypeGuard[Mapping[str, str]]:
    """Return whether a value maps text to text."""
    return isinstance(value, Mapping) and all(
        isinstance(text, str) for pair in value.items() for text in pair
    )


def _texts(value: Any) -> dict[str, str]:
    if not are_texts(value):
        raise TypeError
    return dict(value)
