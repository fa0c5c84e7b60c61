"""The options of painting, checked once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, cast, get_args

import numpy as np
import numpy.typing as npt

from octex.arrays import Bools, Float32s
from octex.channels import ALPHA, BASE_COLOR, CHANNELS, ChannelFormat, color_in_light
from octex.checks import as_array, as_choice, as_depth, as_flag, as_number, as_reals, as_whole
from octex.errors import ArgumentError
from octex.painting.image import Projection
from octex.texture import OctreeTexture, as_texture

#: Ways to combine images that see the same point.
Fusion = Literal["average", "best", "robust"]
FUSIONS: tuple[Fusion, ...] = get_args(Fusion)
#: Ways to match exposures: by one gain per image; or per component, with vignetting removed.
Balance = Literal["gain", "full"]
BALANCES: tuple[Balance, ...] = get_args(Balance)

#: Contents of a new texture where no image sees the surface: cells or none, or a value of the channel.
Fill = Literal["leave", "smooth"]
FILLS: tuple[Fill, ...] = get_args(Fill)
Holes: TypeAlias = Fill | npt.ArrayLike

#: Largest angles in degrees: photographs blur surface at grazing angles, drawings do not.
TAKEN_ANGLE, DRAWN_ANGLE = 75.0, 85.0


@dataclass(frozen=True)
class PaintOptions:
    """The options of ``octex.paint`` and ``octex.project``; raises ArgumentError for values out of range."""

    channel: str = BASE_COLOR.name
    max_depth: int | None = None
    max_angle: float | None = None
    edge_feather: float = 0.0
    fusion: Fusion | None = None
    balance: Balance | None = None
    reference: int | None = None
    back_faces: bool = False
    fit: bool = True
    hidden: bool = False
    region: npt.ArrayLike | None = None

    def __post_init__(self) -> None:
        """Check the options; `of` checks the reference and sets the angle."""
        angle, depth = self.max_angle, self.max_depth
        checked = {
            "max_depth": None if depth is None else as_depth(depth, "max_depth"),
            "max_angle": None if angle is None else as_number(angle, "max_angle", 0.0, 180.0),
            "edge_feather": as_number(self.edge_feather, "edge_feather", 0.0, 1e6),
            "fusion": None if self.fusion is None else as_choice(self.fusion, FUSIONS, "fusion"),
            "balance": None if self.balance is None else as_choice(self.balance, BALANCES, "balance"),
            "back_faces": as_flag(self.back_faces, "back_faces"),
            "fit": as_flag(self.fit, "fit"),
            "hidden": as_flag(self.hidden, "hidden"),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if self.hidden and (self.balance is not None or self.fusion in ("robust", "best")):
            raise ArgumentError(
                "hidden cannot be used with balance, or with images that are robust or best: these compare "
                "what cameras see"
            )

    def of(self, images: Sequence[Projection]) -> PaintOptions:
        """Return the options for these images; raise ArgumentError for a reference that is none of them."""
        usual = DRAWN_ANGLE if all(each.since is not None for each in images) else TAKEN_ANGLE
        if self.reference is not None:
            as_whole(self.reference, "reference", 0, len(images) - 1)
        angle = usual if self.max_angle is None else self.max_angle
        return replace(self, max_angle=angle, fusion="average" if self.hidden else self.fusion)


def triangles_of(region: npt.ArrayLike, count: int) -> Bools | None:
    """Return a region, of numbers or bools, as bools (count,); None for any other kind of region."""
    part = as_array(region)
    if part.dtype == np.bool_ and part.shape == (count,):
        return part
    is_whole = part.ndim == 1 and part.dtype.kind in "iu"
    if not is_whole or (part.size and not 0 <= part.min() <= part.max() < count):
        return None
    chosen = np.zeros(count, np.bool_)
    chosen[part] = True
    return chosen


def format_of(texture: OctreeTexture | None, channel: str) -> ChannelFormat:
    """Return the format of a channel, in a texture or in a new one."""
    if texture is not None:
        as_choice(channel, as_texture(texture).channels, "channel of the texture")
        form = texture.channels[channel].format
    else:
        form = CHANNELS[as_choice(channel, CHANNELS, "channel")]
    if channel == ALPHA.name:
        raise ArgumentError('alpha is painted with blend="erase", or as the alpha of images')
    if form.components > 3:
        raise ArgumentError(f"channel {channel!r} has {form.components} components; images have three")
    return form


def value_of(color: npt.ArrayLike | str, form: ChannelFormat) -> Float32s:
    """Return a colour as a channel's values (components,), or raise ArgumentError."""
    if isinstance(color, str):
        return color_in_light(color, form)
    shapes = [(form.components,), *([()] if form.components == 1 else [])]
    most = float(np.finfo(np.float32).max)
    value = np.atleast_1d(as_reals(color, f"color of {form.name!r}", *shapes, most=most))
    least = -1.0 if form.space == "direction" else 0.0
    if form.dtype.startswith("u") and not ((value >= least) & (value <= 1.0)).all():
        example = ', or write "#rrggbb"' if form.space == "srgb" else ""
        raise ArgumentError(
            f"color of {form.name!r} must be from {least:g} to 1, not {color!r}; divide numbers up to 255 by "
            f"255{example}"
        )
    return value.astype(np.float32)


def fill_of(holes: Holes, form: ChannelFormat) -> Fill | Float32s:
    """Return how to fill unseen surface, checked; a colour as a channel's values (components,)."""
    if isinstance(holes, str) and not holes.startswith("#"):
        return cast(Fill, as_choice(holes, FILLS, "holes"))
    return value_of(holes, form)
