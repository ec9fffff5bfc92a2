"""The up axis and the threshold between heights."""

import numpy as np
import pytest

from crossgrad_core.errors import UserError
from crossgrad_core.testing.fixtures import posed_scene, posed_view
from crossgrad_plugins.groupings.altitude import Altitude
from crossgrad_plugins.groupings.heights import altitudes, upward
from crossgrad_plugins.groupings.split import gap_threshold, otsu_threshold

GRID = [(x, y) for x in (-4.0, -1.0, 1.0, 4.0) for y in (-3.0, 3.0)]


def nadir(flip=1.0, points=True):
    """Cameras that look straight down in all headings, at heights 5 and 6 above the ground."""
    views = []
    for i, (x, y) in enumerate(GRID):
        height = 5.0 + (i + i // 2) % 2
        heading = 2 * np.pi * i / len(GRID)
        views.append(
            posed_view(
                (x, y, flip * height),
                f"{i}.png",
                forward=(0.0, 0.0, -flip),
                up=(np.cos(heading), np.sin(heading), 0.0),
            )
        )
    cloud = [(x, y, 0.0) for x, y in GRID] if points else []
    return posed_scene(views, cloud)


def upright(axis):
    """Cameras held upright along `axis`, one above the other."""
    axis = np.asarray(axis, dtype=float)
    side = np.cross(axis, (0.3, 0.9, 0.1))
    return posed_scene(
        [posed_view(axis * h, f"{h}.png", forward=side, up=axis) for h in (0.0, 1.0, 2.0, 9.0)]
    )


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 0, -1), (0, -1, 0), (1, 0, 0), (0.6, 0, 0.8)])
def test_the_up_axis_is_determined_from_upright_cameras(axis):
    scene = upright(axis)
    found, source = upward(scene)
    assert np.allclose(found, axis)
    assert "cameras" in source
    assert np.allclose(altitudes(scene, scene.views, found), np.array([0, 1, 2, 9]) - 3.0)


@pytest.mark.parametrize("flip", [1.0, -1.0])
@pytest.mark.parametrize("points", [True, False])
def test_cameras_with_all_headings_use_the_flattest_axis(flip, points):
    found, source = upward(nadir(flip, points=points))
    assert np.allclose(found, (0.0, 0.0, flip))
    assert "least variance" in source


def test_camera_up_axes_that_cancel_are_refused_if_the_user_selected_cameras():
    with pytest.raises(UserError, match="cancel"):
        upward(nadir(), "cameras")


def test_a_given_up_axis_is_normalised():
    found, source = upward(nadir(), (0.0, 0.0, 25.0))
    assert np.allclose(found, (0, 0, 1))
    assert source == "given"


@pytest.mark.parametrize("axis", [(0.0, 0.0, 0.0), (float("nan"), 0.0, 1.0)])
def test_an_up_axis_of_length_zero_is_refused(axis):
    with pytest.raises(UserError, match="direction"):
        upward(nadir(), axis)


def test_low_cameras_get_the_label_near():
    scene = nadir()
    labels = Altitude().fit(scene, np.random.default_rng(0)).labels(scene.views)
    assert labels == ("near", "far", "far", "near") * 2


@pytest.mark.parametrize(("cut", "near"), [("median", 4), ("otsu", 6), ("gap", 7)])
def test_heights_are_split_at_the_requested_cut(cut, near):
    heights = (0.0, 0.1, 0.2, 0.3, 1.0, 1.1, 3.5, 6.5)
    scene = posed_scene([posed_view((i, 0, h), f"{i}.png") for i, h in enumerate(heights)])
    grouping = Altitude(up=(0.0, 0.0, 1.0), cut=cut)
    labels = grouping.fit(scene, np.random.default_rng(0)).labels(scene.views)
    assert labels.count("near") == near


def within(values, threshold):
    low, high = values[values <= threshold], values[values > threshold]
    return sum(float(((side - side.mean()) ** 2).sum()) for side in (low, high) if len(side))


@pytest.mark.parametrize("seed", range(6))
def test_otsus_threshold_has_the_least_variance_within_groups(seed):
    rng = np.random.default_rng(seed)
    values = np.concatenate([rng.normal(size=13), rng.normal(4.0, 2.0, size=7)])
    best = within(values, otsu_threshold(values))
    assert best <= min(within(values, cut) for cut in values) + 1e-12


@pytest.mark.parametrize("values", [[2.0], [2.0, 2.0, 2.0]])
@pytest.mark.parametrize("threshold", [otsu_threshold, gap_threshold])
def test_values_equal_to_the_threshold_belong_to_the_lower_group(values, threshold):
    assert threshold(np.array(values)) == 2.0
