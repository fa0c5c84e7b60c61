"""Sparse voxels: values in the cells of a grid, which convert into a texture without a surface."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Int64s, Uint8s
from octex.channels import ALPHA, BASE_COLOR, CHANNELS, ChannelFormat
from octex.checks import as_array, as_entries, as_path, as_positive, as_reals, as_text, locked
from octex.errors import ArgumentError, ModelError
from octex.files import open_file, read_bytes, reading
from octex.source.materials import MOST_IN_FLOAT16
from octex.source.models.reading import npz_arrays
from octex.source.models.vxz import unpack_vxz

#: The endings of files of voxels; a .npz may be one of points instead.
VOXEL_ENDINGS = (".npz", ".vxz")
_DEEPEST = 21
_COORDS = ("coords", "coord", "coordinates", "ijk", "voxels", "indices")
_DEPTHS = ("depths", "depth")
_COLORS = ("base_color", "colors", "color", "rgb", "rgba", "values")
# The arrays of octex's and O-Voxel's files that are no channels.
_OTHERS = {"points", "normals", "areas", "origin", "size", "voxel_size", "vertices", "faces"}
_OTHERS |= {"dual_vertices", "intersected", "split_weight"}
#: The columns of ``attrs``, as TRELLIS.2's pipeline has them, and where each channel begins.
_ATTRIBUTES, _FIRSTS = ("base_color", "metallic", "roughness", "alpha"), (3, 4, 5)
_N_ATTRIBUTES = 6
# Colours may exceed 1 by this much; they are clipped to 1.
_ROUNDING = 1e-5


class VoxelValues(NamedTuple):
    """A channel's values, one row for each voxel."""

    form: ChannelFormat  # the default storage
    rows: Array  # (n, components)   uint8 or uint16 codes of the form, or floats, linear light


class Voxels:
    """Values in the cells of a grid of 2ᵈ cells a side, or of several such grids of the same size.

    coords     (n, 3) integers, 0 … 2ᵈ − 1: a cell's indices along x, y and z; or (n, 4) with a constant first
               column
    channels   by name (n, components), 1 to 4, or (n,): uint8 or uint16, sRGB for colours; or floats, linear
               light. A fourth column of ``base_color`` is alpha. Unknown names become data channels
    depth      d, one or (n,) (default: the least that fits)
    origin     the grid's lowest corner, in rest units
    size       the width of the whole grid (default: the finest cells are 1 wide)

    Raises ArgumentError for arrays of another shape or type; ModelError for cells outside of the grid and
    values that are not finite.
    """

    def __init__(
        self,
        coords: npt.ArrayLike,
        channels: Mapping[str, npt.ArrayLike],
        *,
        depth: int | npt.ArrayLike | None = None,
        origin: npt.ArrayLike = (0.0, 0.0, 0.0),
        size: float | None = None,
        name: str = "voxels",
    ) -> None:
        self.name = as_text(name, "name")
        self.coords: Int64s = locked(self._coords(coords))
        self.depths: Uint8s = locked(self._depths(depth))
        outside = (self.coords < 0) | (self.coords >= np.int64(1) << self.depths[:, None].astype(np.int64))
        if outside.any():
            bad = int(np.argmax(outside.any(axis=1)))
            raise ModelError(
                f"{self.name}: voxel {bad} at {self.coords[bad].tolist()} is outside of a grid of depth "
                f"{self.depths[bad]}; coords go from 0 to 2ᵈ − 1"
            )
        x, y, z = as_reals(origin, f"{self.name}: origin", (3,), most=1e30).tolist()
        self.origin = x, y, z
        deepest = int(self.depths.max())
        self.size = float(1 << deepest) if size is None else as_positive(size, f"{self.name}: size")
        self.values: dict[str, VoxelValues] = {}
        for channel, rows in as_entries(channels, "channels").items():
            self._add(channel, rows)
        if not self.values:
            raise ArgumentError(f"{self.name} has no channel")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Voxels:
        """Read voxels from a file.

        ``.npz``: arrays ``coords``, perhaps ``depths`` (or ``depth``), ``origin`` and ``size`` (or
        ``voxel_size``, of the finest cells), and one a channel by its name, as the class takes them: the
        arrays that octex writes. ``coord``, ``ijk``, ``indices`` and ``voxels`` are coords as well;
        ``colors``, ``rgb`` and ``values`` of three or four columns are base_color. ``attrs`` (n, 6) are
        TRELLIS.2's: base colour (sRGB, also as floats), metallic, roughness and alpha.
        ``.vxz``: O-Voxel's, in the cube from −0.5 to 0.5. The file does not have the cube's width in voxels:
        octex takes the least of 2ᵏ and 3 · 2ᵏ that all coords are below.

        Raises ModelError, with the file's name, for a file that is missing, damaged or has other contents.
        """
        path = as_path(path)
        return voxels_of(voxel_arrays(path), path.name)

    def __len__(self) -> int:
        return len(self.coords)

    def __repr__(self) -> str:
        return f"<Voxels {self.name!r}: {len(self):,} of depth {self.depths.max()}, {', '.join(self.values)}>"

    def _coords(self, coords: npt.ArrayLike) -> Int64s:
        array = as_array(coords)
        if array.ndim == 2 and array.shape[1] == 4 and array.dtype.kind in "iu":  # a batch of one
            array = array[:, 1:] if (array[:1, 0] == array[:, 0]).all() else array
        if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "iu":
            what = f"{array.dtype} {array.shape}"
            raise ArgumentError(f"{self.name}: coords must be whole numbers of shape (n, 3), not {what}")
        if not len(array):
            raise ModelError(f"{self.name} has no voxels")
        low, high = int(array.min()), int(array.max())
        if low < 0 or high >= 1 << _DEEPEST:
            raise ModelError(
                f"{self.name}: coords from {low} to {high} do not fit a grid of 2²¹ cells a side from 0 on; "
                "subtract the lowest, and give it as origin"
            )
        return array.astype(np.int64)

    def _depths(self, depth: int | npt.ArrayLike | None) -> Uint8s:
        count = len(self.coords)
        least = int(self.coords.max()).bit_length()
        array = as_array(least if depth is None else depth)
        if array.dtype.kind not in "iu" or array.size not in (1, count):
            what = f"{array.dtype} {array.shape}"
            raise ArgumentError(f"{self.name}: depth must be a whole number, or one a voxel, not {what}")
        worst = array.min() if array.min() < 0 else array.max()
        if not 0 <= worst <= _DEEPEST:
            raise ArgumentError(f"{self.name}: depth must be from 0 to {_DEEPEST}, not {worst}")
        return np.broadcast_to(array.reshape(-1), count).astype(np.uint8)

    def _add(self, name: str, values: npt.ArrayLike) -> None:
        what, fixed = f"{self.name}: {name}", CHANNELS.get(name)
        rows = as_array(values)
        rows = rows[:, None] if rows.ndim == 1 else rows
        widths: Sequence[int] = range(1, 5) if fixed is None else [fixed.components]
        if fixed == BASE_COLOR:
            widths = (3, 4)
        if rows.ndim != 2 or len(rows) != len(self) or rows.shape[1] not in widths:
            columns = " or ".join(map(str, widths))
            raise ArgumentError(f"{what} must have shape ({len(self)}, {columns}), not {rows.shape}")
        if rows.dtype not in (np.uint8, np.uint16) and rows.dtype.kind != "f":
            raise ArgumentError(f"{what} must be uint8 or uint16 codes, or floats, not {rows.dtype}")
        if fixed == BASE_COLOR and rows.shape[1] == 4:
            self._add(ALPHA.name, rows[:, 3:])
            rows = rows[:, :3]
        form = ChannelFormat(name, rows.shape[1], "data") if fixed is None else fixed
        if rows.dtype.kind == "u":
            form = form._replace(dtype=rows.dtype.name)
        else:
            if not np.isfinite(rows).all():
                raise ModelError(
                    f"{what}: voxel {int(np.argmin(np.isfinite(rows).all(axis=1)))} is not finite"
                )
            low = -1.0 if form.space == "direction" else 0.0
            if rows.min() < low or rows.max() > 1.0 + _ROUNDING:  # codes cannot hold it
                space = "linear" if form.space == "srgb" else form.space
                is_half = fixed is not None and np.abs(rows).max() <= MOST_IN_FLOAT16
                form = form._replace(space=space, dtype="float16" if is_half else "float32")
        self.values[name] = VoxelValues(form, locked(np.ascontiguousarray(rows)))


def voxels_of(arrays: Mapping[str, Array], name: str) -> Voxels:
    """Return the voxels of a file's arrays, from ``voxel_arrays``."""
    coords = arrays["coords"]
    size = arrays.get("size")
    channels = {
        key: rows
        for key, rows in arrays.items()
        if key not in {"coords", *_DEPTHS, *_OTHERS}
        and rows.ndim in (1, 2)
        and rows.shape[:1] == coords.shape[:1]
    }
    color = next((key for key in _COLORS if key in channels and channels[key].ndim == 2), None)
    if color is not None and channels[color].shape[1] in (3, 4):
        channels["base_color"] = channels.pop(color)
    try:
        voxels = Voxels(
            coords,
            channels,
            depth=next((arrays[key] for key in _DEPTHS if key in arrays), None),
            origin=arrays.get("origin", np.zeros(3)),
            size=None if size is None else size.item() if size.size == 1 else size,  # type: ignore[arg-type]
            name=name,
        )
        if size is None and "voxel_size" in arrays:
            edge = as_reals(arrays["voxel_size"].reshape(-1)[:1], f"{name}: voxel_size", (1,))[0]
            voxels.size = as_positive(float(edge), f"{name}: voxel_size") * voxels.size
    except ArgumentError as error:
        raise ModelError(str(error)) from None
    return voxels


def is_voxels(path: Path) -> bool:
    """Say whether a file has voxels: ``.vxz``, or ``.npz`` with an array of coords."""
    if path.suffix.lower() != ".npz":
        return path.suffix.lower() == ".vxz"
    try:
        with open_file(path) as file, zipfile.ZipFile(file) as archive:
            return not {f"{key}.npy" for key in _COORDS}.isdisjoint(archive.namelist())
    except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError):
        return False


def voxel_arrays(path: Path) -> dict[str, Array]:
    """Return the arrays of a file of voxels by name, ``coords`` among them, and attributes as channels.

    Raises ModelError for a file without coords, or that cannot be read.
    """
    with reading(path):
        if path.suffix.lower() == ".vxz":
            coords, arrays = unpack_vxz(read_bytes(path), path.name)
            arrays["coords"] = coords
        else:
            arrays = npz_arrays(path)
    key = next((key for key in _COORDS if key in arrays), None)
    if key is None:
        raise ModelError(f"{path.name} has no array 'coords'; save it with np.savez(…, coords=…)")
    coords = arrays["coords"] = arrays.pop(key)
    if "attrs" in arrays:
        arrays |= _channels_of(arrays.pop("attrs"), len(coords), path.name)
    is_cube = path.suffix.lower() == ".vxz" or "intersected" in arrays
    if is_cube and not {"origin", "size", "voxel_size"} & arrays.keys() and coords.dtype.kind in "iu":
        highest = max(int(coords.max(initial=0)), 0)
        depth = highest.bit_length()
        # TRELLIS.2 makes grids of 512, 1024 and 1536 voxels a side.
        side = 3 << (depth - 2) if depth > 1 and highest < 3 << (depth - 2) else 1 << depth
        arrays["origin"], arrays["size"] = np.full(3, -0.5), np.array((1 << depth) / side)
    return arrays


def _channels_of(attributes: Array, count: int, name: str) -> dict[str, Array]:
    """Return the columns of TRELLIS.2's attributes as channels: floats are codes, sRGB for colours."""
    if attributes.shape != (count, _N_ATTRIBUTES) or attributes.dtype.kind not in "fu":
        columns = ", ".join(_ATTRIBUTES)
        raise ModelError(
            f"{name}: attrs must have shape ({count}, {_N_ATTRIBUTES}): {columns}, not {attributes.dtype} "
            f"{attributes.shape}; save other attributes one an array, by their names"
        )
    if attributes.dtype.kind == "f":
        if not np.isfinite(attributes).all():
            raise ModelError(f"{name}: attrs are not all finite")
        attributes = np.rint(np.clip(attributes, 0.0, 1.0) * 65535.0).astype(np.uint16)
    return dict(zip(_ATTRIBUTES, np.split(attributes, _FIRSTS, axis=1), strict=True))
