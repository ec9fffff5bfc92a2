"""Visibility and finest pixel of means, compared with loops over cameras and means in float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.gaussians import posed_camera

from crossgrad_backbones.visibility import columns_of, depths_in_view, finest_pixels
from crossgrad_core.testing.fixtures import sample_scene

NEAR = 1e-3
CAMERAS = [posed_camera(focal=focal) for focal in (15.0, 40.0)] + [
    view.camera for view in sample_scene().train_views[::3]
]


def means(number=400):
    return torch.from_numpy(np.random.default_rng(0).uniform(-2, 2, (number, 3)))


def looked_at(mean, camera):
    """Depth of one mean, and whether it is in front and inside the image enlarged by 15 %."""
    x, y, z = camera.world_to_camera[:3, :3].numpy() @ mean + camera.world_to_camera[:3, 3].numpy()
    if z <= NEAR:
        return z, False
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside_x = -0.15 * camera.width <= u <= 1.15 * camera.width
    inside_y = -0.15 * camera.height <= v <= 1.15 * camera.height
    return z, inside_x and inside_y


@pytest.mark.parametrize("camera", CAMERAS)
def test_depths_and_visibility_agree_with_a_loop(camera):
    depths, seen = depths_in_view(columns_of(means()), camera, NEAR)
    expected = [looked_at(mean, camera) for mean in means().numpy()]
    assert depths.numpy() == pytest.approx([depth for depth, _ in expected], abs=1e-12)
    assert seen.tolist() == [inside for _, inside in expected]
    assert 0 < seen.sum() < len(seen)


@pytest.mark.parametrize("near", [0.5, 2.0])
def test_points_in_front_of_the_near_plane_are_not_visible(near):
    camera = replace(CAMERAS[0], world_to_camera=torch.eye(4, dtype=torch.float64))
    points = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 0.51], [0.0, 0.0, 2.5]])
    _, seen = depths_in_view(columns_of(points), camera, near)
    assert seen.tolist() == [False, near < 0.51, True]


def test_the_finest_pixel_has_the_smallest_ratio_of_depth_to_focal_length():
    expected = []
    for mean in means().numpy():
        looks = [(camera, *looked_at(mean, camera)) for camera in CAMERAS]
        sizes = [depth / camera.fx for camera, depth, inside in looks if inside]
        expected.append(min(sizes, default=np.inf))
    found = finest_pixels(means(), CAMERAS, NEAR)
    assert found.numpy() == pytest.approx(expected, rel=1e-12)
    assert 0 < found.isfinite().sum() < len(found)


def test_the_finest_pixel_does_not_depend_on_the_order_of_rows():
    all_means = means(1003).float()
    order = torch.randperm(1003, generator=torch.Generator().manual_seed(1))
    found = finest_pixels(all_means, CAMERAS, NEAR)
    assert torch.equal(finest_pixels(all_means[order], CAMERAS, NEAR), found[order])
