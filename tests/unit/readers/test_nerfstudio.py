"""nerfstudio's `transforms.json`: lenses of frames and of all, masks, splits, defaults."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_plugins.readers.nerfstudio import NerfstudioReader

LENS = {"fl_x": 30.0, "fl_y": 31.0, "cx": 11.0, "cy": 9.0, "w": 24, "h": 16}
#: A camera at (0, 0, 5) that looks down on the ground, its top to the north.
DOWN = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]]
NAMES = ("a.png", "b.png", "c.png")


def write(folder, frames=None, **fields):
    """Three photos that look down, one unit apart, and their file."""
    (folder / "images").mkdir()
    made = []
    for i, name in enumerate(NAMES):
        Image.new("RGB", (24, 16), (20 * i, 0, 0)).save(folder / "images" / name)
        matrix = [[*row[:3], row[3] + (i if k == 0 else 0)] for k, row in enumerate(DOWN)]
        made.append({"file_path": f"images/{name}", "transform_matrix": matrix, **(frames or {})})
    (folder / "transforms.json").write_text(json.dumps({"frames": made, **fields}))
    return folder


def read(path, options=None, **reading):
    reader = NerfstudioReader.model_validate(options or {})
    return reader.read(path, SceneOptions(**{"init": "random", "split": "none"} | reading))


def test_cameras_look_along_minus_z_with_y_up(tmp_path):
    scene = read(write(tmp_path, **LENS))
    # The ground below the camera, one unit to its east, and one to its north.
    ground = np.array([[1.0, 0, 0], [2, 0, 0], [1, 1, 0]])
    pixels, depth = scene.views[1].camera.project(scene.similarity.to_local(ground))
    np.testing.assert_allclose(depth / scene.similarity.scale, 5.0)
    np.testing.assert_allclose(pixels, [[11, 9], [11 + 6, 9], [11, 9 - 6.2]], atol=1e-6)


def test_a_lens_is_that_of_the_frame_then_that_of_all(tmp_path):
    camera = read(write(tmp_path, {"fl_x": 40.0}, **LENS)).views[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40.0, 31.0, 11.0, 9.0)


def test_what_a_file_leaves_out_comes_from_the_photo(tmp_path):
    camera = read(write(tmp_path, camera_angle_x=math.pi / 2)).views[0].camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (24, 16, 12.0, 8.0)
    assert camera.fx == camera.fy == pytest.approx(12.0)


@pytest.mark.parametrize(
    ("fields", "model"),
    [
        ({"camera_model": "OPENCV", "k1": 0.1, "p2": 0.01}, "OPENCV"),
        ({"k3": 0.1}, "FULL_OPENCV"),
        ({"distortion_params": [0.1, 0, 0, 0, 0, 0.01]}, "OPENCV"),
        ({"camera_model": "OPENCV_FISHEYE", "k4": 0.1}, "OPENCV_FISHEYE"),
        ({"is_fisheye": True}, "OPENCV_FISHEYE"),
    ],
)
def test_lenses_are_those_of_colmap(fields, model, tmp_path):
    notes = "\n".join(read(write(tmp_path, **LENS, **fields)).notes)
    assert f"undistorted to PINHOLE with pycolmap (3 {model})" in notes


@pytest.mark.parametrize("fields", [{}, {"camera_model": "PINHOLE", "k1": 0.0, "k4": 0}])
def test_a_lens_without_distortion_is_left_alone(fields, tmp_path):
    assert "undistorted" not in "\n".join(read(write(tmp_path, **LENS, **fields)).notes)


def test_masks_are_those_that_frames_name(tmp_path):
    path = write(tmp_path, {"mask_path": "keep/all.png"}, **LENS)
    (path / "keep").mkdir()
    (path / "masks").mkdir()
    keep = np.zeros((16, 24), np.uint8)
    keep[:, 12:] = 255  # black does not count
    Image.fromarray(keep).save(path / "keep" / "all.png")
    mask = read(path).views[0].photo.mask()
    assert torch.equal(mask, torch.from_numpy(keep == 255))
    # The user's folder comes first.
    Image.new("L", (24, 16), 255).save(path / "masks" / "a.png")
    assert read(path, masks=Path("masks")).views[0].photo.mask() is None


@pytest.mark.parametrize(
    ("lists", "held_out"),
    [
        ({"train": (0, 1), "test": (2,)}, ["c.png"]),
        ({"train": (1, 2), "val": (0,)}, ["a.png"]),
        ({"train": (1,), "val": (0,), "test": (2,)}, ["c.png"]),
    ],
)
def test_lists_of_the_file_are_the_split(lists, held_out, tmp_path):
    names = {
        f"{part}_filenames": [f"./images/{NAMES[i]}" for i in rows] for part, rows in lists.items()
    }
    scene = read(write(tmp_path, **LENS, **names), split="auto")
    assert [view.name for view in scene.test_views] == held_out
    assert len(scene.train) == len(lists["train"])


def test_an_applied_transform_is_undone(tmp_path):
    turned = [[0, 1, 0, 1.0], [-1, 0, 0, 2.0], [0, 0, 1, 3.0]]
    path = write(tmp_path, applied_transform=turned, applied_scale=2.0, **LENS)
    scene = read(path)
    placed = scene.similarity.to_input(scene.centers)
    # saved = 2 (R original + t): the camera at (1, 0, 5).
    original = np.array(turned)[:, :3].T @ (np.array([1.0, 0, 5]) / 2 - [1, 2, 3])
    np.testing.assert_allclose(placed[1], original, atol=1e-8)


def test_a_crop_that_is_left_out_is_told(tmp_path):
    path = write(tmp_path, camera_model="OPENCV_FISHEYE", fisheye_crop_radius=10, **LENS)
    assert "fisheye_crop_radius is left out" in "\n".join(read(path).notes)


@pytest.mark.parametrize(("named", "stored"), [("a", "a.png"), ("a.b", "a.b.png"), ("a", "a")])
def test_names_without_a_suffix_are_those_of_png_files(named, stored, tmp_path):
    path = write(tmp_path, **LENS)
    (path / "images" / "a.png").rename(path / "images" / stored)
    whole = json.loads((path / "transforms.json").read_text())
    whole["frames"][0]["file_path"] = f"images/{named}"
    (path / "transforms.json").write_text(json.dumps(whole))
    assert read(path).views[0].name == stored
