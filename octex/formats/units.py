"""Units of length that files can state."""

from __future__ import annotations

from typing import Literal

Unit = Literal["meter", "centimeter", "millimeter", "inch", "foot"]
#: How long each is, in metres.
METERS: dict[Unit, float] = {
    "meter": 1.0, "centimeter": 0.01, "millimeter": 0.001, "inch": 0.0254, "foot": 0.3048,
}  # fmt: skip
