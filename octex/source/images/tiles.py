"""UDIM: images of tiles that lie side by side in texture coordinates, read as one image.

Tile 1001 + u + 10 v, with u from 0 to 9, is the square from (u, v) to (u + 1, v + 1), v up. A file name with
<UDIM> stands for the files with the tiles' numbers.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from octex.errors import ImageError
from octex.source.images.openimage import check_size
from octex.source.images.pyramid import Texels

_TOKEN = "<UDIM>"
_FIRST, _ACROSS = 1001, 10


def is_udim(name: str) -> bool:
    """Say whether a file name stands for tiles."""
    return _TOKEN in name


def tile_files(path: Path) -> dict[int, Path]:
    """Return the files of the tiles of a path with <UDIM> in its name, by number; empty without any."""
    pattern = re.compile(re.escape(path.name).replace(re.escape(_TOKEN), r"([1-9]\d{3})", 1))
    files = {}
    with suppress(OSError):
        for file in sorted(path.parent.iterdir()):
            match = pattern.fullmatch(file.name)
            if match is not None and int(match[1]) >= _FIRST:
                files[int(match[1])] = file
    return files


def tile_grid(numbers: Iterable[int]) -> tuple[int, int]:
    """Return the columns and rows, from tile 1001 on, that hold tiles of these numbers."""
    rows, columns = zip(*(divmod(number - _FIRST, _ACROSS) for number in numbers), strict=True)
    return max(columns) + 1, max(rows) + 1


def join_tiles(tiles: Mapping[int, Texels], name: str) -> Texels:
    """Return one image of the tiles' grid: texels of smaller tiles are repeated, missing tiles are black.

    Raises ImageError for tiles of integers and of floats, and for an image that is too large.
    """
    columns, rows = tile_grid(tiles)
    height, width = (max(tile.shape[axis] for tile in tiles.values()) for axis in (0, 1))
    dtypes = {tile.dtype for tile in tiles.values()}
    if len(dtypes) > 1:
        raise ImageError(f"{name}: some tiles have integers, others floats; save all in one format")
    [dtype] = dtypes
    check_size(columns * width, rows * height, None, f"{name}: the image of all {len(tiles)} tiles")
    joined = np.zeros((rows, height, columns, width, 4), dtype)
    joined[..., 3] = 65535 if dtype == np.uint16 else 1
    for number, texels in tiles.items():
        row, column = divmod(number - _FIRST, _ACROSS)
        y = np.arange(height) * len(texels) // height
        x = np.arange(width) * texels.shape[1] // width
        joined[rows - 1 - row, :, column] = texels[y[:, None], x]
    return joined.reshape(rows * height, columns * width, 4)
