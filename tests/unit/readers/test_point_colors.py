"""Colours of points, in the ranges that programs write them in."""

import numpy as np
import pytest

from crossgrad_core.scene.point_cloud import _colors


@pytest.mark.parametrize(
    ("stored", "expected"),
    [
        (np.array([0.0, 0.5, 1.0]), (0, 128, 255)),
        (np.array([0.0, 128.0, 255.0]), (0, 128, 255)),
        (np.array([65535, 32768, 256], dtype=np.uint16), (255, 128, 1)),
        (np.array([7, 128, 256], dtype=np.int32), (7, 128, 255)),
        (np.array([1, 2, 3], dtype=np.uint8), (1, 2, 3)),
        (np.array([10.0, np.nan, 255.0]), (10, 0, 255)),
    ],
)
def test_the_colour_range_follows_the_largest_value(stored, expected):
    columns = dict(zip(("red", "green", "blue"), stored[:, None], strict=True))
    assert tuple(_colors(columns, 1)[0]) == expected


@pytest.mark.parametrize("odd", [np.inf, 600.0])
def test_one_outlier_value_does_not_change_other_colours(odd):
    stored = np.tile([10.0, 200.0, 30.0], (1000, 1))
    stored[7, 1] = odd
    found = _colors(dict(zip(("red", "green", "blue"), stored.T, strict=True)), 1000)
    assert tuple(found[0]) == (10, 200, 30) and tuple(found[7]) == (10, 255, 30)
