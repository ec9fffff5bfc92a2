"""Detection of views of another capture on which the run was trained."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from crossgrad_core.errors import UserError
from crossgrad_core.run.postprocess.cross_capture import (
    SAME_DIRECTION,
    SAME_PLACE,
    _are_trained,
    _check_place,
)
from crossgrad_core.testing.fixtures import posed_scene, posed_view


def moved(view, shift, angle, rng):
    """The view somewhere in `shift` from its place, turned by an angle about any axis."""
    away, axis = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
    x, y, z = angle * axis
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    pose = view.camera.world_to_camera.clone()
    pose[:3, :3] = turn @ pose[:3, :3]
    pose[:3, 3] = -pose[:3, :3] @ (view.camera.center + torch.from_numpy(shift * away))
    return replace(view, camera=replace(view.camera, world_to_camera=pose))


def test_a_view_counts_as_trained_if_position_and_direction_match():
    rng = np.random.default_rng(0)
    trained = [posed_view(rng.normal(size=3), forward=rng.normal(size=3)) for _ in range(20)]
    shares = [(s, a) for s in (0.0, 0.5, 0.999, 1.001, 2.0) for a in (0.0, 0.5, 0.999, 1.001, 9.0)]
    views = [
        moved(view, s * SAME_PLACE, a * SAME_DIRECTION, rng) for view in trained for s, a in shares
    ]
    expected = [s < 1 and a < 1 for _ in trained for s, a in shares]
    assert _are_trained(views, trained) == expected


def test_a_view_in_the_opposite_direction_does_not_count_as_trained():
    rng = np.random.default_rng(1)
    trained = [posed_view(rng.normal(size=3), forward=rng.normal(size=3)) for _ in range(100)]
    assert not any(_are_trained([moved(each, 0.0, np.pi, rng) for each in trained], trained))


def test_position_and_direction_must_match_the_same_view():
    here, there = posed_view((0, 0, 0)), posed_view((1, 0, 0), forward=(1, 0, 0))
    mixed = posed_view((1, 0, 0))
    assert _are_trained([here, mixed, there], [here, there]) == [True, False, True]


def test_an_outlier_camera_does_not_admit_a_capture_of_another_place():
    rng = np.random.default_rng(2)
    centers = [*rng.normal(size=(20, 3)), np.array([1e4, 1e4, 1e4])]
    points = rng.normal(size=(300, 3))
    scene = posed_scene([posed_view(c, f"{i:03}.png") for i, c in enumerate(centers)], points)
    _check_place(scene, points, points[:5], Path("same"))
    with pytest.raises(UserError, match="does not overlap"):
        _check_place(scene, points + 50.0, points[:5] + 50.0, Path("other"))
