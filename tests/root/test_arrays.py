"""Counts of bits against Python's own, whichever numpy there is."""

import numpy as np
import pytest

from octex import arrays


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "uint32", "uint64"])
@pytest.mark.parametrize("count", [arrays.bit_counts, arrays._bit_counts])
def test_the_bits_of_words_are_counted(count, dtype):
    words = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (40, 6), dtype, endpoint=True)
    words[0] = [0, 1, 2, 3, np.iinfo(dtype).max, np.iinfo(dtype).max - 1]
    for some in (words, words[:, ::2], words[5], words[:0], words[:, 0]):
        expected = [int(word).bit_count() for word in some.ravel()]
        found = count(some)
        assert found.dtype == np.uint8
        np.testing.assert_array_equal(found, np.array(expected, np.uint8).reshape(some.shape))
