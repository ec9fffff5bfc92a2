"""The upward direction of a scene: by its georeference, else by its cameras."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from crossgrad_core.testing.fixtures import sample_scene


def with_cameras(headings, pitches, turn):
    """A scene whose cameras are held level; the world is rotated by `turn` [3, 3]."""
    scene, views = sample_scene(), []
    for heading, pitch in zip(headings, pitches, strict=True):
        across = np.array([np.sin(heading), -np.cos(heading), 0.0])
        flat = np.array([np.cos(heading), np.sin(heading), 0.0])
        ahead = np.cos(pitch) * flat - np.sin(pitch) * np.array([0.0, 0.0, 1.0])
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.from_numpy(np.stack([across, np.cross(ahead, across), ahead]) @ turn.T)
        camera = replace(scene.views[0].camera, world_to_camera=pose)
        views.append(replace(scene.views[0], camera=camera))
    return replace(scene, views=tuple(views), train=tuple(range(len(views))), test=())


def degrees_between(first, second):
    return np.degrees(np.arccos(np.clip(first @ second, -1.0, 1.0)))


@pytest.mark.parametrize("kind", ["level", "straight down", "both"])
@pytest.mark.parametrize("seed", range(5))
def test_level_cameras_of_several_headings_give_up_to_half_a_degree(kind, seed):
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=seed).as_matrix()
    pitches = {
        "level": rng.uniform(-0.1, 0.3, 12),
        "straight down": np.full(12, np.pi / 2),
        "both": rng.uniform(0.0, np.pi / 2, 12),
    }[kind]
    scene = with_cameras(rng.uniform(0.0, 2 * np.pi, 12), pitches, turn)
    assert np.linalg.norm(scene.up) == pytest.approx(1.0)
    assert degrees_between(scene.up, turn[:, 2]) < 0.5


def test_cameras_of_one_heading_give_the_mean_of_their_up_axes():
    scene = with_cameras([0.3, 0.3], [0.0, 0.0], np.eye(3))
    # Half of the viewing direction is subtracted.
    assert degrees_between(scene.up, np.array([0.0, 0.0, 1.0])) < 30.0


def test_a_georeference_decides():
    up = np.array([0.6, 0.0, 0.8])
    scene = replace(sample_scene(), georeference=SimpleNamespace(up=up))
    assert scene.up is up
