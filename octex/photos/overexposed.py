"""Pictures that are too light in places: what is cut off there says no more than how light it is at least.

Once pictures are made to agree in light, what one has cut off is darker than what another shows of the same
place as it is. There it is masked.
"""

from __future__ import annotations

from concurrent.futures import Executor
from functools import partial

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s
from octex.painting.picture import Mips
from octex.painting.project import Projected
from octex.painting.sight import Shot
from octex.photos.agreement import as_codes
from octex.photos.consensus import medians
from octex.photos.patches import PATCH, batches, beside, masked, patches_of, seen_at, widths_of

#: From this light on a picture may be cut off: 250 of 255 codes.
_CUT = 0.955
#: By how many codes others must be lighter.
_LIGHTER = 2.0
#: Patches are pixels of this level.
_LEVEL = PATCH.bit_length() - 1


def without_overexposed(given: Projected, evened: Projected, executor: Executor) -> Projected:
    """Return paint that is ``evened`` out, its pictures masked where they are cut off and others are lighter.

    ``given`` is the same as it was before.
    """
    return evened.with_mips(partial(_masked, given, evened), executor)


def _masked(given: Projected, evened: Projected, number: int) -> Mips:
    """Return a picture that is evened out, masked where it is cut off and next to that, if others see it."""
    shot, mips = given.shots[number], evened.shots[number].mips
    if not _is_limited(shot.mips):
        return mips
    rows, columns = patches_of(shot)
    patches, triangles, barycentric = seen_at(given, shot, beside(_cut_off(shot)))
    widths = widths_of(given.with_shots([shot]), triangles, barycentric)
    is_wrong = np.zeros(rows * columns, np.bool_)
    others_see = np.ones(rows * columns, np.bool_)  # where no middle sees the surface, too
    for some in batches(len(patches), len(given.shots)):
        where = triangles[some], barycentric[some], widths[some]
        is_wrong[patches[some]], others_see[patches[some]] = _compared(given, evened, number, *where)
    mask = ~beside(is_wrong.reshape(rows, columns)) | ~others_see.reshape(rows, columns)
    return mips if mask.all() else masked(mips, mask.astype(np.float32))


def _cut_off(shot: Shot) -> Bools:
    """Say which patches (rows, columns) of a picture are cut off, as a level of it shows them."""
    first, width, height = shot.mips.sizes[min(_LEVEL, len(shot.mips.sizes) - 1)].tolist()
    pixels = shot.mips.pixels[first : first + width * height].reshape(height, width, 4)
    light = pixels[..., :3].max(axis=2) > _CUT * pixels[..., 3]
    rows, columns = patches_of(shot)
    found: Bools = np.pad(light, ((0, max(rows - height, 0)), (0, max(columns - width, 0))), mode="edge")
    return found[:rows, :columns]


def _compared(
    given: Projected,
    evened: Projected,
    number: int,
    triangles: Int32s,
    barycentric: Float64s,
    widths: Float32s,
) -> tuple[Bools, Bools]:
    """Say at which points (n,) a picture is cut off and others are lighter; and at which others are not."""
    where = triangles, barycentric, widths
    before, (after, weights) = given.each(*where)[0], evened.each(*where)
    limited = np.array([_is_limited(shot.mips) for shot in given.shots])
    is_cut = limited[:, None, None] & (before > _CUT)
    tells = (weights > 0)[..., None] & ~is_cut
    tells[number] = False
    codes = as_codes(after).astype(np.float64)
    rows = len(codes), codes[0].size
    others = medians(codes.reshape(rows), tells.reshape(rows).astype(np.float64)).reshape(codes[0].shape)
    tell = tells.any(axis=0)
    is_lighter = tell & (others > codes[number] + _LIGHTER)
    wrong: Bools = (is_lighter & is_cut[number]).any(axis=1)
    return wrong, np.all(tell, axis=1)


def _is_limited(mips: Mips) -> bool:
    """Say whether a picture may be cut off: one that holds light beyond 1 is not."""
    return bool((mips.range[1] <= 1.0).all() and (mips.range[1] > _CUT).any())
