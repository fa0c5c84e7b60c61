"""Codes of areas: one encoding, for conversion and for edits."""

import numpy as np
import pytest

from octex.channels import ROUGHNESS
from octex.tree.areas import AREAS, area_codes
from octex.tree.layout import AREA_ONE, AREA_STEPS
from octex.voxelize.sums import SumColumns, Sums, level_means

RANGE = 2.0 ** np.random.default_rng(0).uniform(-50, 8, 2000)


def test_conversion_codes_areas_as_edits_do():
    codes, flags = np.arange(RANGE.size), np.ones(RANGE.size, np.uint8)
    sums = np.stack([0.5 * RANGE, RANGE], axis=1)
    means = level_means(Sums(codes, flags, sums), SumColumns.of([ROUGHNESS]))
    np.testing.assert_array_equal(means.areas, area_codes(RANGE))


def test_codes_are_logarithms_of_areas():
    steps = AREA_STEPS * np.log2(RANGE) + AREA_ONE
    inside = (steps > 1) & (steps < 255)
    assert np.abs(area_codes(RANGE) - steps)[inside].max() <= 0.56
    np.testing.assert_array_equal(area_codes(AREAS), np.arange(256))


@pytest.mark.parametrize("code", range(4))
def test_a_node_has_an_area_if_a_child_has_one_and_none_if_its_children_are_contacts(code):
    [parent] = area_codes(np.array([(8 if code == 0 else 1) * AREAS[code] / 4]))
    assert (parent == 0) == (code == 0)
