"""NeRF synthetic scenes: a real frame's numbers, splits, and transparency."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_plugins.readers.blender import BlenderReader

#: Frame `train/r_0` of lego, NeRF synthetic (as in the tests of nerfstudio).
LEGO_ANGLE = 0.6911112070083618
LEGO = [
    [-0.9999021887779236, 0.004192245192825794, -0.013345719315111637, -0.05379832163453102],
    [-0.013988681137561798, -0.2996590733528137, 0.95394366979599, 3.845470428466797],
    [-4.656612873077393e-10, 0.9540371894836426, 0.29968830943107605, 1.2080823183059692],
    [0.0, 0.0, 0.0, 1.0],
]
SIDE = 20


def write(folder, splits=("train", "test"), views=2):
    """Photos of which the left half is transparent, the lower right corner half so."""
    pixels = np.full((SIDE, SIDE, 4), (200, 100, 0, 255), np.uint8)
    pixels[:, :10, 3] = 0
    pixels[10:, 10:, 3] = 100
    for split in splits:
        (folder / split).mkdir()
        frames = []
        for i in range(views):
            Image.fromarray(pixels).save(folder / split / f"r_{i}.png")
            matrix = np.array(LEGO)
            matrix[0, 3] += i
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": matrix.tolist()})
        whole = {"camera_angle_x": LEGO_ANGLE, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(whole))
    return folder


def read(path, options=None, **reading):
    reader = BlenderReader.model_validate(options or {})
    return reader.read(path, SceneOptions(**{"init": "random"} | reading))


def test_a_camera_of_scene_lego_looks_at_the_origin_from_four_units(tmp_path):
    scene = read(write(tmp_path))
    view = next(v for v in scene.views if v.name == "train/r_0.png")
    pixels, depth = view.camera.project(scene.similarity.to_local(np.zeros((1, 3))))
    np.testing.assert_allclose(pixels, [[SIDE / 2, SIDE / 2]], atol=1e-4)
    np.testing.assert_allclose(depth / scene.similarity.scale, 4.0311, atol=1e-3)
    # 800 pixels wide its focal length is the published 1111.11.
    assert view.camera.fx * 800 / SIDE == pytest.approx(1111.111, abs=1e-3)


def test_test_views_are_held_out_and_validation_views_left_out(tmp_path):
    scene = read(write(tmp_path, ("train", "val", "test"), views=3))
    assert {view.name.partition("/")[0] for view in scene.train_views} == {"train"}
    assert {view.name.partition("/")[0] for view in scene.test_views} == {"test"}
    assert {view.regime for view in scene.views} == {"all"}


def test_validation_views_are_held_out_if_there_are_no_test_views(tmp_path):
    scene = read(write(tmp_path, ("train", "val")))
    assert {view.name for view in scene.test_views} == {"val/r_0.png", "val/r_1.png"}


def test_a_scene_with_training_views_only_uses_the_default_split(tmp_path):
    scene = read(write(tmp_path, ("train",), views=4))
    assert [view.name for view in scene.test_views] == ["r_0.png"]


@pytest.mark.parametrize(
    ("background", "left", "corner"),
    [("white", 255, (233, 194, 155)), ("black", 0, (78, 39, 0))],
)
def test_alpha_blends_a_photo_over_the_background(background, left, corner, tmp_path):
    scene = read(write(tmp_path), {"background": background})
    image, mask = scene.views[0].photo.image(), scene.views[0].photo.mask()
    assert mask is None
    assert image[0, 0].tolist() == [left] * 3
    assert image[0, 15].tolist() == [200, 100, 0]
    assert image[15, 15].tolist() == list(corner)
    assert "--background" in scene.notes[0]


def test_alpha_can_be_used_as_a_mask(tmp_path):
    mask = read(write(tmp_path), {"background": "none"}).views[0].photo.mask()
    expected = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    expected[:10, 10:] = True
    assert torch.equal(mask, expected)


def test_the_transforms_files_may_be_in_a_folder(tmp_path):
    # As MatrixCity's pose/block_all, whose photos stand elsewhere in the scene.
    path = write(tmp_path)
    (path / "pose").mkdir()
    for split in ("train", "test"):
        file = path / f"transforms_{split}.json"
        whole = json.loads(file.read_text())
        for frame in whole["frames"]:
            frame["file_path"] = f"../{frame['file_path']}.png"
        (path / "pose" / file.name).write_text(json.dumps(whole))
        file.unlink()
    assert not BlenderReader().accepts(path)
    assert len(read(path, {"folder": "pose"}).views) == 4
