"""Cameras without photos, and videos of what they see."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.errors import UserError
from crossgrad_core.run.camera_path import camera_path, zoom_path
from crossgrad_core.run.results import video
from crossgrad_core.testing.fixtures import posed_scene, posed_view

FRAMES = 9
IDENTITY = np.eye(4).ravel().tolist()
#: Column by column, as other programs write matrices.
TURNED = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]
FAR_AWAY = [*IDENTITY[:3], 1e20, *IDENTITY[4:]]


def views_above(heights, seen=range(10)):
    """Cameras one above the other that look down, and points on the ground."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1, 1, (10, 2)), np.zeros(10)])
    ways = {"forward": (0.0, 0.0, -1.0), "up": (0.0, 1.0, 0.0), "seen": seen}
    return [posed_view((0.1, 0.2, h), f"{h}.png", **ways) for h in heights], points


def test_a_zoom_path_approaches_by_equal_factors():
    views, points = views_above([2.0, 40.0, 5.0, 0.5])
    cameras = zoom_path(views, points, FRAMES)
    heights = np.array([float(camera.center[2]) for camera in cameras])
    assert heights[0] == pytest.approx(40.0) and heights[-1] == pytest.approx(0.5)
    np.testing.assert_allclose(heights[1:] / heights[:-1], (0.5 / 40.0) ** (1 / (FRAMES - 1)))
    for camera in cameras:
        rotation = camera.world_to_camera[:3, :3]
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64))


def test_a_zoom_path_starts_and_ends_at_photos_of_the_same_points():
    views, points = views_above([40.0, 41.0, 0.5, 0.6, *[5.0] * 6])
    apart = {"forward": (0.0, 0.3, -1.0), "seen": range(8)}
    views[0] = posed_view((9, 9, 40.0), "far.png", **apart)
    views[2] = posed_view((9, 9, 0.5), "near.png", **apart)
    ends = zoom_path(views, points, 2)
    torch.testing.assert_close(ends[0].center, views[1].camera.center)
    torch.testing.assert_close(ends[1].center, views[3].camera.center)
    torch.testing.assert_close(ends[0].world_to_camera, views[1].camera.world_to_camera)


def test_the_ends_of_a_zoom_path_agree_with_a_search_of_all_pairs():
    rng = np.random.default_rng(4)
    for _ in range(30):
        views, points = views_above(rng.choice(np.arange(1.0, 90.0), 12, replace=False))
        points = np.concatenate([points] * 6)
        views = [replace(v, seen=rng.integers(0, 60, rng.integers(8, 50))) for v in views]
        views.sort(key=lambda view: float(view.camera.center[2]))
        pairs = [
            (len(set(far.seen.tolist()) & set(near.seen.tolist())), far, near)
            for far in views[-2:]
            for near in views[:2]
        ]
        most = max(shared for shared, _, _ in pairs)
        best = {
            (float(far.camera.center[2]), float(near.camera.center[2]))
            for shared, far, near in pairs
            if shared == most
        }
        ends = zoom_path(views, points, 2)
        found = tuple(float(camera.center[2]) for camera in ends)
        assert any(found == pytest.approx(pair) for pair in best)


def test_views_at_one_distance_also_give_a_zoom_path():
    views, points = views_above([3.0, 3.0])
    assert {round(float(camera.center[2]), 9) for camera in zoom_path(views, points, 5)} == {3.0}


def test_photos_without_observations_give_no_zoom_path():
    views, points = views_above([1.0, 2.0], seen=range(3))
    with pytest.raises(UserError, match="no zoom path can be computed"):
        zoom_path(views, points, FRAMES)


def scene_with(similarity):
    return replace(posed_scene([posed_view((0, 0, 1))]), similarity=similarity)


def path_of(tmp_path, **changes):
    content = {
        "camera_path": [{"camera_to_world": IDENTITY, "fov": 90, "aspect": 1.5}],
        "render_width": 30, "render_height": 20, "fps": 5, "crop": None, **changes,
    }  # fmt: skip
    (tmp_path / "tour.json").write_text(json.dumps(content))
    return str(tmp_path / "tour.json")


def test_a_camera_path_is_read_in_input_coordinates(tmp_path):
    matrix = np.eye(4)
    matrix[:3, 3] = 5.0, 6.0, 7.0
    frame = {"camera_to_world": (2.0 * matrix / 2.0).ravel().tolist(), "fov": 90}
    scene = scene_with(Similarity(np.array([1.0, 2.0, 3.0]), 0.5))
    found = camera_path(scene, path_of(tmp_path, camera_path=[frame, frame]), FRAMES)
    assert (found.name, len(found.cameras), found.fps) == ("tour", 2, 5.0)
    camera = found.cameras[0]
    assert (camera.width, camera.height, camera.cx, camera.cy) == (30, 20, 15.0, 10.0)
    assert camera.fx == camera.fy == pytest.approx(10.0)
    np.testing.assert_allclose(camera.center.numpy(), [2.0, 2.0, 2.0])
    # An OpenGL camera looks along -z and has y up.
    np.testing.assert_allclose(camera.local(np.array([[2.0, 2.5, 1.0]]))[0], [0.0, -0.5, 1.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_path": []}, "camera_path"),
        ({"render_width": 0}, "render_width"),
        ({"fps": "fast"}, "fps"),
        ({"fps": 1e-9}, "fps"),
        ({"fps": True}, "fps"),
        ({"render_width": True}, "render_width"),
        ({"render_height": 20.5}, "render_height"),
        ({"camera_path": [{"camera_to_world": IDENTITY, "fov": True}]}, "fov"),
        ({"camera_path": [{"camera_to_world": [True] * 16, "fov": 50}]}, "camera_to_world"),
        ({"camera_type": "equirectangular"}, "camera_type"),
        ({"camera_path": [{"camera_to_world": TURNED, "fov": 50}]}, "row by row"),
        ({"camera_path": [{"camera_to_world": [1.0] * 15, "fov": 50}]}, "camera_to_world"),
        ({"camera_path": [{"camera_to_world": [0.0] * 15 + [1], "fov": 50}]}, "no valid rotation"),
        ({"camera_path": [{"camera_to_world": [float("nan")] * 16, "fov": 50}]}, "camera_to_world"),
        ({"camera_path": [{"camera_to_world": IDENTITY, "fov": 180}]}, "fov"),
        ({"camera_path": [{"camera_to_world": IDENTITY, "fov": 1e-9}]}, "fov"),
        ({"camera_path": [{"camera_to_world": [1e308] * 16, "fov": 50}]}, "camera_to_world"),
        ({"camera_path": [{"camera_to_world": FAR_AWAY, "fov": 50}]}, "too far from the scene"),
    ],
)
def test_an_invalid_camera_path_names_its_field(tmp_path, changes, message):
    with pytest.raises(UserError, match=message):
        camera_path(scene_with(Similarity(np.zeros(3), 1.0)), path_of(tmp_path, **changes), FRAMES)


@pytest.mark.parametrize("content", [None, b"", b"[[[", b"\xff", b"[" * 10_000])
def test_a_file_that_is_not_a_camera_path_is_refused(tmp_path, content):
    path = tmp_path / "tour.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=r"tour\.json"):
        camera_path(scene_with(Similarity(np.zeros(3), 1.0)), str(path), FRAMES)


@pytest.mark.parametrize("width", [30, 30.0])
def test_a_whole_number_of_pixels_may_be_written_with_a_decimal_point(tmp_path, width):
    path = path_of(tmp_path, render_width=width)
    camera = camera_path(scene_with(Similarity(np.zeros(3), 1.0)), path, FRAMES).cameras[0]
    assert (camera.width, type(camera.width)) == (30, int)


def test_a_file_with_the_name_of_the_frames_folder_is_refused(tmp_path):
    (tmp_path / "renders").touch()
    with pytest.raises(UserError, match="already has this name"):
        video.write_frames([torch.zeros(6, 8, 3)], tmp_path / "renders" / "000006")


def test_frames_become_an_animated_image_without_an_encoder(tmp_path, monkeypatch):
    monkeypatch.setattr(video.shutil, "which", lambda _: None)
    images = [torch.full((6, 8, 3), level) for level in (0.0, 0.5, 1.5)]
    frames = video.write_frames(images, tmp_path / "frames")
    assert [frame.name for frame in frames] == ["00000.png", "00001.png", "00002.png"]
    assert [Image.open(frame).getpixel((0, 0))[0] for frame in frames] == [0, 128, 255]
    path = video.write_video(frames, 10.0)
    assert path == tmp_path / "frames" / "video.webp"
    with Image.open(path) as found:
        assert (found.n_frames, found.size) == (3, (8, 6))
    monkeypatch.setattr(video, "_LARGEST", 100)
    assert video.write_video(frames, 10.0) is None
    wide = video.write_frames([torch.zeros(1, 16_384, 3)], tmp_path / "wide")
    monkeypatch.undo()
    monkeypatch.setattr(video.shutil, "which", lambda _: None)
    assert video.write_video(wide, 10.0) is None


def test_an_encoder_receives_the_frames_and_its_failure_gives_one_error(tmp_path, monkeypatch):
    encoder = tmp_path / "ffmpeg"
    encoder.write_text('#!/bin/sh\nfor last; do :; done\necho "$@" > "$last"\n')
    encoder.chmod(0o755)
    monkeypatch.setattr(video.shutil, "which", lambda _: str(encoder))
    frames = video.write_frames([torch.zeros(6, 8, 3)], tmp_path / "frames")
    (tmp_path / "frames" / "00001.png").write_bytes(b"of a longer video")
    path = video.write_video(frames, 10.0)
    assert path == tmp_path / "frames" / "video.mp4"
    told = path.read_text()
    assert "-framerate 10 -i" in told and "-frames:v 1 " in told
    encoder.write_text("#!/bin/sh\nfor last; do :; done\necho half > $last\necho bad >&2\nexit 1\n")
    with pytest.raises(UserError, match="bad"):
        video.write_video(frames, 10.0)
    # Nothing of the video that failed is left, and the one before is.
    assert sorted(each.name for each in path.parent.iterdir())[2:] == ["video.mp4"]
    assert path.read_text() == told
