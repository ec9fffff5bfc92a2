"""nerfstudio's `transforms.json`: lenses of frames and of all, masks, splits, defaults."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_plugins.readers._inside import Inside
from crossgrad_plugins.readers._json import Fields
from crossgrad_plugins.readers._transforms import read_lens
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


def test_cameras_look_along_minus_z_and_y_points_up(tmp_path):
    scene = read(write(tmp_path, **LENS))
    # The ground below the camera, one unit to its east, and one to its north.
    ground = np.array([[1.0, 0, 0], [2, 0, 0], [1, 1, 0]])
    pixels, depth = scene.views[1].camera.project(scene.similarity.to_local(ground))
    np.testing.assert_allclose(depth / scene.similarity.scale, 5.0)
    np.testing.assert_allclose(pixels, [[11, 9], [11 + 6, 9], [11, 9 - 6.2]], atol=1e-6)


def test_lens_values_of_a_frame_override_the_values_of_the_file(tmp_path):
    camera = read(write(tmp_path, {"fl_x": 40.0}, **LENS)).views[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40.0, 31.0, 11.0, 9.0)


@pytest.mark.parametrize(
    ("own", "shared", "focal"),
    [
        # The other way of the file is of another lens; 24 pixels at a right angle are 12 pixels.
        ({"camera_angle_x": math.pi / 2}, {"fl_x": 30.0, "fl_y": 31.0}, (12.0, 12.0)),
        ({"fl_x": 40.0}, {"camera_angle_x": 1.0, "camera_angle_y": 1.0}, (40.0, 40.0)),
        (
            {"camera_angle_x": math.pi / 2},
            {"camera_angle_x": 1.0, "camera_angle_y": math.pi / 2, "fl_x": 30.0},
            (12.0, 8.0),
        ),
        ({"fl_x": 40.0, "camera_angle_x": 1.0}, {"fl_y": 31.0}, (40.0, 40.0)),
        # Without one of its own, a frame has that of the file, lengths first.
        ({}, {"fl_x": 30.0, "camera_angle_x": 1.0}, (30.0, 30.0)),
        # The same way completes it.
        ({"fl_y": 41.0}, {"fl_x": 30.0, "fl_y": 31.0}, (30.0, 41.0)),
    ],
)
def test_a_focal_length_of_a_frame_is_not_mixed_with_the_focal_length_of_the_file(
    own, shared, focal, tmp_path
):
    camera = read(write(tmp_path, own, **{"w": 24, "h": 16, **shared})).views[0].camera
    assert (camera.fx, camera.fy) == pytest.approx(focal)


def test_an_incomplete_focal_length_of_a_frame_is_an_error(tmp_path):
    with pytest.raises(UserError, match="a field of the scene") as caught:
        read(write(tmp_path, {"fl_y": 40.0}, camera_angle_x=1.0))
    assert caught.value.where.endswith("transforms.json: frames[0].fl_x")


@pytest.mark.parametrize(
    ("own", "shared", "model", "terms"),
    [
        ({"k1": 0.1}, {"distortion_params": [0.5] * 6}, "OPENCV", (0.1, 0, 0, 0)),
        ({"distortion_params": [0.1] + [0] * 5}, {"k1": 0.5}, "OPENCV", (0.1, 0, 0, 0)),
        ({"k1": 0.1}, {"k1": 0.5, "k2": 0.2}, "OPENCV", (0.1, 0.2, 0, 0)),
        ({"k1": 0.0}, {"distortion_params": [0.5] * 6}, "PINHOLE", ()),
        ({}, {"k2": 0.1}, "OPENCV", (0, 0.1, 0, 0)),
        # The kind of lens, and the terms that belong to it.
        ({"camera_model": "OPENCV"}, {"is_fisheye": True, "k1": 0.5}, "PINHOLE", ()),
        ({"is_fisheye": False, "k1": 0.1}, {"camera_model": "FISHEYE"}, "OPENCV", (0.1, 0, 0, 0)),
        ({"is_fisheye": True}, {"camera_model": "OPENCV", "k1": 0.5}, "OPENCV_FISHEYE", (0,) * 4),
        ({"camera_model": "PINHOLE"}, {"k1": 0.1}, "OPENCV", (0.1, 0, 0, 0)),
        ({"is_fisheye": True}, {"is_fisheye": True, "k1": 0.1}, "OPENCV_FISHEYE", (0.1, 0, 0, 0)),
    ],
)
def test_distortion_of_a_frame_is_not_mixed_with_distortion_of_the_file(
    own, shared, model, terms, tmp_path
):
    frame, whole = (Fields(each, tmp_path / "transforms.json") for each in (own, LENS | shared))
    lens = read_lens(Inside(tmp_path), frame, whole, "a.png")
    assert (lens.model, lens.params[4:]) == (model, terms)


def test_a_360_degree_camera_is_refused_even_if_a_frame_denies_a_fisheye(tmp_path):
    path = write(tmp_path, {"is_fisheye": False}, camera_model="EQUIRECTANGULAR", **LENS)
    with pytest.raises(UserError, match="cannot be undistorted"):
        read(path)


def test_missing_camera_values_are_taken_from_the_photo(tmp_path):
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
def test_lenses_become_camera_models_of_colmap(fields, model, tmp_path):
    notes = "\n".join(read(write(tmp_path, **LENS, **fields)).notes)
    assert f"undistorted to PINHOLE with pycolmap (3 {model})" in notes


@pytest.mark.parametrize("fields", [{}, {"camera_model": "PINHOLE", "k1": 0.0, "k4": 0}])
def test_a_lens_without_distortion_is_not_undistorted(fields, tmp_path):
    assert "undistorted" not in "\n".join(read(write(tmp_path, **LENS, **fields)).notes)


def test_masks_named_by_frames_are_used(tmp_path):
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
def test_split_lists_in_the_transforms_file_define_the_split(lists, held_out, tmp_path):
    names = {
        f"{part}_filenames": [f"./images/{NAMES[i]}" for i in rows] for part, rows in lists.items()
    }
    scene = read(write(tmp_path, **LENS, **names), split="auto")
    assert [view.name for view in scene.test_views] == held_out
    assert len(scene.train) == len(lists["train"])


def test_split_lists_may_omit_suffixes(tmp_path):
    names = {"train_filenames": ["images/a", "images/b.png"], "test_filenames": ["images/c"]}
    scene = read(write(tmp_path, **LENS, **names), split="auto")
    assert [view.name for view in scene.train_views] == ["a.png", "b.png"]
    assert [view.name for view in scene.test_views] == ["c.png"]


@pytest.mark.parametrize(
    ("lists", "what", "where"),
    [
        (
            {"train": ["images/z.png"]},
            "no name in a split list",
            "transforms.json: train_filenames",
        ),
        ({"train": []}, "no name in a split list", "transforms.json: train_filenames"),
        (
            {"train": ["images/a.png"], "val": ["images/d"]},
            "no name in a split list",
            "transforms.json: val_filenames",
        ),
        (
            {"train": ["images/a.png"], "test": ["images/a"]},
            "for both training and testing",
            "transforms.json: train_filenames and test_filenames",
        ),
    ],
)
def test_invalid_split_lists_are_reported_with_file_and_field(lists, what, where, tmp_path):
    path = write(tmp_path, **LENS, **{f"{part}_filenames": names for part, names in lists.items()})
    with pytest.raises(UserError, match=what) as caught:
        read(path, split="auto")
    assert caught.value.where.endswith(where)
    assert "--split every" in caught.value.todo
    assert len(read(path, split="every").views) == 3
    (path / "train_list.txt").write_text("a.png\nb.png\n")
    assert len(read(path, split="auto").train) == 2


def test_missing_photos_of_all_training_views_are_not_blamed_on_the_user_list(tmp_path):
    names = {"train_filenames": ["images/a.png"], "test_filenames": ["images/b.png"]}
    path = write(tmp_path, **LENS, **names)
    (path / "images" / "a.png").unlink()
    with pytest.raises(UserError, match="no listed view can be used for training") as caught:
        read(path, split="auto")
    assert caught.value.where == str(path)
    assert "add the missing photos" in caught.value.todo


def test_an_applied_transform_is_inverted(tmp_path):
    turned = [[0, 1, 0, 1.0], [-1, 0, 0, 2.0], [0, 0, 1, 3.0]]
    path = write(tmp_path, applied_transform=turned, applied_scale=2.0, **LENS)
    scene = read(path)
    placed = scene.similarity.to_input(scene.centers)
    # saved = 2 (R original + t): the camera at (1, 0, 5).
    original = np.array(turned)[:, :3].T @ (np.array([1.0, 0, 5]) / 2 - [1, 2, 3])
    np.testing.assert_allclose(placed[1], original, atol=1e-8)


def test_an_ignored_crop_is_reported(tmp_path):
    path = write(tmp_path, camera_model="OPENCV_FISHEYE", fisheye_crop_radius=10, **LENS)
    assert "fisheye_crop_radius is not supported" in "\n".join(read(path).notes)


@pytest.mark.parametrize(("named", "stored"), [("a", "a.png"), ("a.b", "a.b.png"), ("a", "a")])
def test_photo_names_without_a_suffix_refer_to_png_files(named, stored, tmp_path):
    path = write(tmp_path, **LENS)
    (path / "images" / "a.png").rename(path / "images" / stored)
    whole = json.loads((path / "transforms.json").read_text())
    whole["frames"][0]["file_path"] = f"images/{named}"
    (path / "transforms.json").write_text(json.dumps(whole))
    assert read(path).views[0].name == stored
