"""OpenSfM's reconstructions: what a real one says, and what is left out."""

import json

import numpy as np
import pytest
from PIL import Image

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap
from crossgrad_plugins.readers import opensfm
from crossgrad_plugins.readers.opensfm import OpenSfmReader

#: Numbers of `data/berlin` of OpenSfM (github.com/mapillary/OpenSfM), made by OpenSfM itself.
CAMERA = {
    "projection_type": "perspective", "width": 3264, "height": 2448,
    "focal": 0.8696658484855359, "k1": 0.08851464962037196, "k2": -0.2324428377906099,
}  # fmt: skip
SHOT = {
    "rotation": [1.1323397182808774, -0.3410235387889708, 0.5435850271169043],
    "translation": [-0.6318451938985004, 30.665443901104613, -7.233603145207031],
    "camera": "iphone",
}
#: Points, and where their features were found in the photo, in normalised coordinates.
POINTS = [
    ((1.60436, 15.285271, 31.893556), (-0.372613, 0.322811)),
    ((0.853444, 15.16211, 31.875237), (-0.409782, 0.320993)),
    ((12.800932, 13.294786, 33.679738), (0.107142, 0.2668)),
    ((3.304386, 17.133522, 38.084723), (-0.278621, 0.07271)),
    ((13.047407, 18.977953, 40.949485), (-0.004297, 0.061014)),
]


def write(folder, camera=CAMERA, file="reconstruction.json", size=(48, 36), shots=("01.jpg",)):
    (folder / "images").mkdir()
    for name in shots:
        Image.new("RGB", size).save(folder / "images" / name)
    points = {
        str(i): {"coordinates": list(xyz), "color": [1.0, 2.0, 3.0]}
        for i, (xyz, _) in enumerate(POINTS)
    }
    model = {
        "cameras": {"iphone": camera}, "shots": dict.fromkeys(shots, SHOT), "points": points,
    }  # fmt: skip
    (folder / file).parent.mkdir(exist_ok=True)
    (folder / file).write_text(json.dumps([model]))
    return folder


@pytest.fixture
def raw(monkeypatch):
    """Keeps the scene as it was read, before photos are undistorted."""
    kept = []
    build = opensfm.build_scene

    def keep(raw, options):
        kept.append(raw)
        return build(raw, options)

    monkeypatch.setattr(opensfm, "build_scene", keep)
    return kept


def test_points_of_a_real_reconstruction_project_onto_their_features(raw, tmp_path):
    guard_pycolmap()
    import pycolmap

    OpenSfmReader().read(write(tmp_path), SceneOptions())
    (view,) = raw[0].views
    lens, pose = view.calibration, view.world_to_camera
    camera = pycolmap.Camera(
        model=lens.model, width=lens.width, height=lens.height, params=list(lens.params)
    )
    found = camera.img_from_cam(raw[0].points @ pose[:3, :3].T + pose[:3, 3])
    # Pixels of OpenSfM, whose first one has its middle at 0, and half a pixel to COLMAP's.
    features = np.array([xy for _, xy in POINTS]) * 3264 + [3263 / 2, 2447 / 2] + 0.5
    assert np.abs(found - features).max() < 4.0  # pixels, of 3264; features at the corners


@pytest.mark.parametrize(
    ("kind", "model"),
    [
        ({"projection_type": "brown", "k3": 0.1, "p1": 0.01}, "FULL_OPENCV"),
        ({"projection_type": "simple_radial"}, "OPENCV"),
        ({"projection_type": "radial"}, "OPENCV"),
        ({"projection_type": "fisheye", "focal": 0.8}, "OPENCV_FISHEYE"),
        ({"projection_type": "fisheye_opencv", "k4": 0.01}, "OPENCV_FISHEYE"),
    ],
)
def test_lenses_become_camera_models_of_colmap(kind, model, raw, tmp_path):
    camera = {"width": 3264, "height": 2448, "focal_x": 0.8, "focal_y": 0.9, "c_x": 0.01} | kind
    camera |= {"k1": 0.01, "k2": 0.02}
    OpenSfmReader().read(write(tmp_path, camera), SceneOptions())
    lens = raw[0].views[0].calibration
    down = 0.8 if "focal" in kind else 0.9
    assert lens.model == model
    np.testing.assert_allclose(
        lens.params[:4], [0.8 * 3264, down * 3264, 1632 + 32.64, 1224.0], rtol=1e-12
    )
    assert lens.params[4:6] == (0.01, 0.02)


@pytest.mark.parametrize(
    "kind", ["spherical", "equirectangular", "dual", "fisheye62", "fisheye624"]
)
def test_unsupported_cameras_are_refused_with_a_remedy(kind, tmp_path):
    write(tmp_path, CAMERA | {"projection_type": kind})
    with pytest.raises(UserError, match=f"projection type {kind}") as caught:
        OpenSfmReader().read(tmp_path, SceneOptions())
    assert "export them with pinhole cameras" in caught.value.todo


def test_a_project_of_opendronemap_is_read(tmp_path):
    path = write(tmp_path, file="opensfm/reconstruction.json")
    assert OpenSfmReader().accepts(path)
    assert len(OpenSfmReader().read(path, SceneOptions()).points) == 5


def test_the_reconstruction_with_most_photos_is_used(tmp_path):
    path = write(tmp_path, shots=("01.jpg", "02.jpg"))
    models = json.loads((path / "reconstruction.json").read_text())
    few = {**models[0], "shots": {"01.jpg": SHOT}}
    (path / "reconstruction.json").write_text(json.dumps([few, models[0]]))
    scene = OpenSfmReader().read(path, SceneOptions())
    assert len(scene.views) == 2
    assert "reconstructions left out have 1" in "\n".join(scene.notes)


@pytest.mark.parametrize("vector", [[0, 0, 0], [1e-13, 0, 0], [0, np.pi, 0], [0.3, -2.0, 7.0]])
def test_rotation_vectors_agree_with_scipy(vector):
    from scipy.spatial.transform import Rotation

    found = opensfm.rotation_by(np.array(vector, dtype=float))
    np.testing.assert_allclose(found, Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)


def test_photos_in_subfolders_are_found_by_names_without_a_folder(tmp_path):
    path = write(tmp_path)
    (path / "images" / "day0").mkdir()
    (path / "images" / "01.jpg").rename(path / "images" / "day0" / "01.jpg")
    scene = OpenSfmReader().read(path, SceneOptions())
    assert [view.name for view in scene.views] == ["day0/01.jpg"]
