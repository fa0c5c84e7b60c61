"""The scale on which facings are told apart: 8-bit codes."""

from __future__ import annotations

import numpy as np

from octex.arrays import Array, Bools, Floats
from octex.channels import ONE, ChannelFormat, linear_to_srgb

#: Difference, in 8-bit codes, from which on a facing's value is stored for itself.
MOST = 1.0
#: Of the sRGB curve at 1, in codes: above that light is measured by ratio.
SLOPE = 255.0 * 1.055 / 2.4


def in_codes(stored: Array, form: ChannelFormat) -> Floats:
    """Return stored values on the scale of 8-bit codes: light on sRGB's curve, a logarithm from 1 on."""
    if form.space == "linear" and form.dtype.startswith("float"):
        light = stored.astype(np.float64)
        return 255.0 * linear_to_srgb(np.minimum(light, 1.0)) + SLOPE * np.log(np.maximum(light, 1.0))
    scale = 255.0 / ONE[form.dtype]
    if form.space == "direction" and form.dtype.startswith("float"):
        scale /= 2  # −1 … 1
    return stored.astype(np.float32) * np.float32(scale)


def differ(form: ChannelFormat, rows: Array, cells: Array) -> Bools:
    """Say which facings' values (n, components), as stored, are to be told from those of their cells (n,)."""
    apart = np.abs(in_codes(rows, form) - in_codes(cells, form)) > MOST
    return np.asarray(apart.any(axis=1))
