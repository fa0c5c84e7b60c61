"""The types of arrays, by what their elements are."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Bools = npt.NDArray[np.bool_]
Int8s = npt.NDArray[np.int8]
Int32s = npt.NDArray[np.int32]
Int64s = npt.NDArray[np.int64]
Integers = npt.NDArray[np.integer[Any]]
Uint8s = npt.NDArray[np.uint8]
Uint16s = npt.NDArray[np.uint16]
Uint32s = npt.NDArray[np.uint32]
Uint64s = npt.NDArray[np.uint64]
Float32s = npt.NDArray[np.float32]
Float64s = npt.NDArray[np.float64]
Complex128s = npt.NDArray[np.complex128]
#: Of any precision.
Floats = npt.NDArray[np.floating[Any]]
#: Integers that stand for numbers from 0 to 1, or −1 to 1.
ChannelCodes = npt.NDArray[np.uint8 | np.uint16]
#: What channels store.
ChannelValues = npt.NDArray[np.uint8 | np.uint16 | np.float32]
