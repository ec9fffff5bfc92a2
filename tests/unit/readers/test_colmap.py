import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.run.app import bundled_scene
from crossgrad_plugins.readers.colmap import ColmapReader


@pytest.fixture(scope="module")
def masters(tmp_path_factory):
    """Scenes written once; tests work on copies."""
    root = tmp_path_factory.mktemp("masters")
    write_tiny_scene(root / "plain")
    write_tiny_scene(root / "jpeg", suffix=".jpg", text=True)
    write_tiny_scene(root / "two", folders=("street", "aerial"), mixed=True, points=100)
    return root


@pytest.fixture
def make(masters, tmp_path):
    """A copy of a scene that a test may damage."""

    def copy(name="plain"):
        return Path(shutil.copytree(masters / name, tmp_path / name))

    return copy


def read(path, reader=None, **options):
    return (reader or ColmapReader()).read(path, SceneOptions(**options))


def notes(scene):
    return "\n".join(scene.notes)


def refuses(path, *words, **options):
    """Reading raises a `UserError` that says all of `words`."""
    with pytest.raises(UserError) as caught:
        read(path, **options)
    message = str(caught.value)
    assert not [word for word in words if str(word) not in message], message
    return message


def model(scene):
    return scene / "sparse" / "0"


def patch(path, offset, data):
    content = bytearray(path.read_bytes())
    content[offset : offset + len(data)] = data
    path.write_bytes(content)


def rewrite_camera(scene, width, height, params):
    """One PINHOLE camera with other numbers."""
    record = struct.pack("<QIiQQ4d", 1, 1, 1, width, height, *params)
    (model(scene) / "cameras.bin").write_bytes(record)


def project(view, points):
    pose, camera = view.camera.world_to_camera.numpy(), view.camera
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


def color_error(view, scene):
    """Median difference between SfM point colours and the pixels that they project to."""
    u, v = project(view, scene.points[view.seen])
    image = view.photo.image().numpy().astype(float)
    inside = (u > 1) & (v > 1) & (u < view.camera.width - 1) & (v < view.camera.height - 1)
    colors = scene.point_colors[view.seen][inside]
    assert len(colors) > 10
    return np.median(np.abs(image[v[inside].astype(int), u[inside].astype(int)] - colors))


class TestReading:
    def test_poses_and_observations_agree_with_pycolmap(self, masters):
        import pycolmap

        path = masters / "two"
        scene, model = read(path), pycolmap.Reconstruction(path / "sparse" / "0")
        assert len(scene.views) == 16
        ids = sorted(model.points3D)
        local = scene.similarity.to_local(np.array([model.points3D[i].xyz for i in ids]))
        np.testing.assert_allclose(scene.points, local, rtol=0, atol=1e-9)
        images = {image.name: image for image in model.images.values()}
        for view in scene.views:
            image = images[view.name]
            pose = view.camera.world_to_camera.numpy()
            assert view.camera.matrix.tolist() == image.camera.calibration_matrix().tolist()
            np.testing.assert_allclose(
                pose[:3, :3], image.cam_from_world().rotation.matrix(), atol=1e-15
            )
            center = scene.similarity.to_input(view.camera.center.numpy()[None])[0]
            np.testing.assert_allclose(center, image.projection_center(), atol=1e-8)
            seen = {p.point3D_id for p in image.points2D if p.has_point3D()}
            assert {ids[row] for row in view.seen} == seen

    def test_binary_and_text_models_agree(self, make):
        binary = make()
        text = read(write_tiny_scene(binary.parent / "text", text=True))
        scene = read(binary)
        np.testing.assert_allclose(scene.points, text.points, rtol=0, atol=2.0**-30)
        np.testing.assert_array_equal(scene.point_colors, text.point_colors)
        for ours, theirs in zip(scene.views, text.views, strict=True):
            torch.testing.assert_close(ours.camera.world_to_camera, theirs.camera.world_to_camera)
            assert ours.camera.matrix.tolist() == theirs.camera.matrix.tolist()
            np.testing.assert_array_equal(ours.seen, theirs.seen)

    @pytest.mark.parametrize("name", ["rigs", "frames"])
    def test_models_of_older_colmap_versions_without_rigs_are_read(self, make, name):
        path = make()
        (model(path) / f"{name}.bin").unlink()
        assert len(read(path).views) == 8

    def test_equal_file_names_in_two_folders_are_two_images(self, masters):
        scene = read(masters / "two")
        names = [view.name for view in scene.views]
        assert names == sorted(names)
        assert {"aerial/0001.png", "street/0001.png"} <= set(names)
        far, near = (scene.views[names.index(f"{f}/0001.png")] for f in ("aerial", "street"))
        assert (far.regime, near.regime) == ("aerial", "street")
        assert not torch.equal(far.photo.image(), near.photo.image())
        assert "regimes by image folder: aerial 8 views (7 train, 1 test)" in notes(scene)

    @pytest.mark.parametrize("options", [{}, {"max_size": 40}])
    def test_photos_of_all_sizes_agree_with_their_cameras(self, masters, options):
        scene = read(masters / "two", **options)
        sizes = set()
        for view in scene.views:
            image = view.photo.image()
            assert tuple(image.shape) == (view.camera.height, view.camera.width, 3)
            sizes.add(tuple(image.shape))
        assert len(sizes) == 2
        street = [view for view in scene.views if view.regime == "street"]
        assert max(color_error(view, scene) for view in street) < 8

    @pytest.mark.parametrize(
        "name", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE", "FOV", "SIMPLE_FISHEYE", "EUCM"]
    )
    def test_distorted_photos_are_undistorted(self, tmp_path, name):
        path = write_tiny_scene(tmp_path, model=name, width=96, height=64, views=4)
        before = sorted(p for p in path.rglob("*") if p.is_file())
        scene = read(path, max_size=80)
        assert f"4 photos undistorted to PINHOLE with pycolmap (4 {name})" in notes(scene)
        assert max(color_error(view, scene) for view in scene.views) < 4
        assert sorted(p for p in path.rglob("*") if p.is_file()) == before

    def test_a_radial_camera_without_distortion_is_not_undistorted(self, tmp_path):
        path = write_tiny_scene(tmp_path, views=2)
        record = struct.pack("<QIiQQ4d", 1, 1, 2, 48, 32, 57.6, 25.5, 15.0, 0.0)
        (model(path) / "cameras.bin").write_bytes(record)
        scene = read(path)
        assert "undistorted" not in notes(scene)
        assert scene.views[0].camera.width == 48

    def test_the_split_and_its_notes_are_reported(self, masters):
        scene = read(masters / "plain")
        assert (scene.train, scene.test) == ((1, 2, 3, 4, 5, 6, 7), (0,))
        assert [view.name for view in scene.test_views] == ["0000.png"]
        assert scene.name == "plain"
        assert scene.notes == (
            "COLMAP: 8 posed images, 1 camera, 200 SfM points from sparse/0 (binary)",
            "photos: 48 x 32 px (8) from images/, not resized",
            "split: 7 train, 1 test (1 in 8 by name)",
            "local frame: 1 unit = 2.64818 input units, the extent of the training cameras "
            "(1.1 x largest distance from their mean)",
            "regimes by footprint: far 4 views (3 train, 1 test), near 4 views (4 train, 0 test)",
            "split: no photo of near is held out, so no metric shows its quality; --split "
            "stratified holds out photos of every regime",
        )

    @pytest.mark.parametrize("scale", [1.0, 1000.0])
    def test_the_stratified_split_uses_the_regimes_of_all_views(self, tmp_path, scale):
        path = write_tiny_scene(tmp_path, views=20, width=24, height=16, scale=scale)
        scene = read(path, split="stratified")
        assert (
            "regimes by footprint: far 10 views (8 train, 2 test), near 10 views (8 train, 2 test)"
            in scene.notes
        )
        seen = {v.name: np.sort(v.camera.local(scene.points[v.seen])[:, 2]) for v in scene.views}
        depths = {name: np.median(depth[depth > 0]) for name, depth in seen.items()}
        middle = np.median(list(depths.values()))
        for view in scene.views:
            assert view.regime == ("near" if depths[view.name] <= middle else "far")
        for regime in ("near", "far"):
            names = [view.name for view in scene.views if view.regime == regime]
            held_out = [view.name for view in scene.test_views if view.regime == regime]
            assert held_out == names[::8]

    def test_the_bundled_photos_keep_their_split(self):
        scene = read(bundled_scene(), max_size=100)
        assert len(scene.test_views) == 4
        assert "split: 24 train, 4 test (1 in 8 by name)" in scene.notes

    @pytest.mark.parametrize(
        ("scale", "offset"),
        [(1000.0, (0, 0, 0)), (0.001, (0, 0, 0)), (1.0, (5e5, 4e6, 100)), (300.0, (5e5, 4e6, 100))],
    )
    def test_units_and_origin_of_the_input_do_not_change_the_scene(
        self, masters, tmp_path, scale, offset
    ):
        reference = read(masters / "plain")
        path = write_tiny_scene(tmp_path, scale=scale, offset=offset)
        scene = read(path)
        atol = 3e-9
        np.testing.assert_allclose(scene.points, reference.points, rtol=0, atol=atol)
        same = scene.points.astype(np.float32) == reference.points.astype(np.float32)
        assert same.mean() > 0.95
        for ours, theirs in zip(scene.views, reference.views, strict=True):
            assert ours.regime == theirs.regime
            np.testing.assert_allclose(
                ours.camera.world_to_camera, theirs.camera.world_to_camera, rtol=0, atol=atol
            )
        back = scene.similarity.to_input(scene.points)
        expected = reference.similarity.to_input(reference.points) * scale + offset
        np.testing.assert_allclose(back, expected, rtol=0, atol=1e-8 * scale)


class TestPhotos:
    def test_a_missing_photo_is_left_out(self, make):
        path = make()
        (path / "images" / "0003.png").unlink()
        scene = read(path)
        assert len(scene.views) == 7
        assert "1 posed image left out, because the photo is missing: 0003.png" in notes(scene)

    def test_a_photo_without_pose_is_left_out(self, make):
        path = make()
        for name in ("aaa.png", "extra/0001.png"):
            (path / "images" / name).parent.mkdir(exist_ok=True)
            shutil.copy(path / "images" / "0001.png", path / "images" / name)
        (path / "images" / "Thumbs.db").write_bytes(b"x")
        scene = read(path)
        assert "2 photos left out (no pose): aaa.png, extra/0001.png" in notes(scene)
        assert color_error(scene.views[1], scene) < 8

    def test_photos_with_other_names_than_the_poses_are_refused(self, make):
        path = make()
        (path / "images").rename(path / "moved")
        (path / "images").mkdir()
        shutil.copytree(path / "moved", path / "images" / "cam1")
        (path / "moved").rename(path / "images" / "cam0")
        refuses(path, "no photo was found for any image of the model", "0000.png", "cam0/0000.png")

    def test_a_scene_without_a_photo_folder_is_refused(self, make):
        path = make()
        (path / "images").rename(path / "pictures")
        refuses(path, "no folder of photos", "pictures, sparse")
        assert len(read(path, ColmapReader(images="pictures")).views) == 8

    def test_photo_names_may_differ_in_suffix_and_case(self, make):
        path = make()
        (path / "images" / "0001.png").rename(path / "images" / "0001.PNG")
        scene = read(path)
        assert len(scene.views) == 8
        assert "1 photo matched with a photo whose suffix or case differs: 0001.png" in notes(scene)

    @pytest.mark.parametrize("share", [0.5, 0.95])
    def test_a_truncated_photo_is_refused_before_training(self, make, share):
        path = make("jpeg")
        photo = path / "images" / "0005.jpg"
        photo.write_bytes(photo.read_bytes()[: int(photo.stat().st_size * share)])
        refuses(path, "incomplete", photo)

    def test_a_photo_damaged_inside_is_named_when_it_is_decoded(self, make):
        path = make()
        photo = path / "images" / "0005.png"
        patch(photo, photo.stat().st_size // 2, b"\xff" * 40)
        scene = read(path)
        with pytest.raises(UserError, match=r"cannot be decoded(?s:.*)0005\.png"):
            scene.views[5].photo.image()

    def test_reduced_photos_are_preferred_over_resizing(self, make):
        path = make("two")
        for photo in sorted((path / "images").rglob("*.png")):
            small = path / "images_4" / photo.relative_to(path / "images").with_suffix(".jpg")
            small.parent.mkdir(parents=True, exist_ok=True)
            with Image.open(photo) as image:
                image.resize((image.width // 4, image.height // 4)).save(small)
        # One stray file must not shift any pair.
        shutil.copy(small, path / "images_4" / "aerial" / "0000b.jpg")
        scene = read(path, max_size=17)
        assert "12 x 8 px (8), 9 x 10 px (8) from images_4/, not resized" in notes(scene)
        view = scene.views[0]
        assert (view.camera.fx, view.camera.cx) == pytest.approx((57.6 / 4, 25.5 / 4))
        with Image.open(path / "images_4" / "aerial" / "0000.jpg") as image:
            assert view.photo.image().tolist() == np.asarray(image).tolist()
        assert "from images/, not resized" in notes(read(path))
        # So small that resizing the full photos keeps far more.
        assert "from images/, 16 resized" in notes(read(path, max_size=30))

    def test_incomplete_reduced_photos_are_not_used(self, make):
        path = make()
        (path / "images_2").mkdir()
        for k in range(7):
            Image.new("RGB", (24, 16)).save(path / "images_2" / f"{k:04d}.png")
        scene = read(path, max_size=24)
        assert "images_2/ is not used, because it lacks 1 photo: 0007.png" in notes(scene)
        assert "24 x 16 px (8) from images/, 8 resized (scikit-image" in notes(scene)

    def test_reduced_photos_without_the_originals_are_sufficient(self, make):
        path = make()
        (path / "images").rename(path / "images_4")
        rewrite_camera(path, 192, 128, (230.4, 230.4, 102.0, 60.0))
        scene = read(path)
        assert "8 with another size than their camera, which was scaled" in notes(scene)
        assert scene.views[0].camera.fx == pytest.approx(57.6)
        assert color_error(scene.views[1], scene) < 8

    def test_a_photo_of_another_shape_is_refused(self, make):
        path = make()
        Image.new("RGB", (40, 32)).save(path / "images" / "0002.png")
        refuses(path, "aspect ratio of its camera", "0002.png", "48 x 32", "40 x 32")

    def test_exif_rotation_is_applied_only_if_the_camera_size_requires_it(self, make):
        path = make("jpeg")
        exif = Image.Exif()
        exif[0x0112] = 6
        for photo in sorted((path / "images").iterdir()):
            with Image.open(photo) as image:
                image.load()
            image.save(photo, exif=exif, quality=95, subsampling=0)
        stored = read(path)
        assert "EXIF" not in notes(stored)
        assert color_error(stored.views[1], stored) < 8
        # The same photos stored lying on their side: only the rotated photo has the camera's shape.
        for photo in sorted((path / "images").iterdir()):
            with Image.open(photo) as image:
                lying = image.rotate(90, expand=True)
            lying.save(photo, exif=exif, quality=95, subsampling=0)
        turned = read(path)
        assert "8 of 8 rotated as their EXIF orientation says" in notes(turned)
        assert tuple(turned.views[1].photo.image().shape) == (32, 48, 3)
        assert color_error(turned.views[1], turned) < 8

    def test_grey_and_transparent_photos_are_read(self, make):
        path = make()
        for name, mode in (("0001", "L"), ("0002", "RGBA")):
            with Image.open(path / "images" / f"{name}.png") as image:
                converted = image.convert(mode)
            if mode == "RGBA":
                alpha = Image.new("L", converted.size, 100)
                alpha.paste(255, (24, 0, 48, 32))
                converted.putalpha(alpha)
            converted.save(path / "images" / f"{name}.png")
        scene = read(path)
        assert "1 of 8 with transparency: pixels with alpha < 0.5 are ignored" in notes(scene)
        assert "1 of 8 grey: copied into three equal channels" in notes(scene)
        assert scene.views[1].photo.image().shape == (32, 48, 3)
        keep = scene.views[2].photo.mask()
        assert not keep[:, :24].any() and keep[:, 24:].all()
        assert scene.views[3].photo.mask() is None

    @pytest.mark.parametrize("name", ["0002.png.png", "0002.png"])
    def test_masks_are_read_in_both_naming_conventions(self, make, name):
        path = make()
        (path / "masks").mkdir()
        mask = Image.new("L", (48, 32), 255)
        mask.paste(0, (0, 0, 24, 32))
        mask.save(path / "masks" / name)
        scene = read(path)
        keep = scene.views[2].photo.mask()
        assert keep.shape == (32, 48)
        assert not keep[:, :24].any()
        assert keep[:, 24:].all()
        assert scene.views[1].photo.mask() is None
        assert "masks: 1 of 8 have one: white pixels are used" in notes(scene)
        (path / "masks").rename(path / "mine")
        assert read(path).views[2].photo.mask() is None
        assert read(path, masks=Path("mine")).views[2].photo.mask() is not None

    def test_masks_without_a_matching_photo_are_refused(self, make):
        path = make()
        refuses(path, "mask folder does not exist", "mine", masks=Path("mine"))
        (path / "mine").mkdir()
        refuses(path, "no mask for any photo", "0000.png.png", masks=path / "mine")
        Image.new("L", (48, 48)).save(path / "mine" / "0002.png")
        refuses(path, "the aspect ratio of a mask", "48 x 48", masks=path / "mine")

    def test_photos_larger_than_the_photo_cache_give_a_note(self, tmp_path):
        path = write_tiny_scene(tmp_path, views=2)
        rewrite_camera(path, 3000, 2000, (3600.0, 3600.0, 1594.0, 938.0))
        for name in ("0000", "0001"):
            Image.new("RGB", (3000, 2000)).save(path / "images" / f"{name}.png")
        assert "34 MiB when decoded, of which 16 MiB are kept" in notes(read(path, cache_mib=16))


class TestModels:
    def test_the_largest_of_several_models_is_used(self, make):
        path = make()
        small = write_tiny_scene(path.parent / "small", views=3)
        (path / "sparse" / "0").rename(path / "sparse" / "10")
        shutil.copytree(model(small), path / "sparse" / "2")
        scene = read(path)
        assert len(scene.views) == 8
        assert (
            "sparse/10 is used, because it has the most images (8); left out: sparse/2 3"
            in notes(scene)
        )
        assert len(read(path, ColmapReader(model="sparse/2")).views) == 3
        with pytest.raises(UserError, match=r"sparse/2, sparse/10"):
            read(path, ColmapReader(model="sparse/7"))

    @pytest.mark.parametrize("place", ["sparse", "colmap/sparse/0", "."])
    def test_models_in_other_folders_are_found(self, make, place):
        path = make()
        files = list(model(path).iterdir())
        (path / place).mkdir(parents=True, exist_ok=True)
        for file in files:
            file.rename(path / place / file.name)
        assert len(read(path).views) == 8
        assert ColmapReader().accepts(path)

    def test_folders_without_a_model_are_refused(self, make):
        path = make()
        assert not ColmapReader().accepts(path / "images")
        assert not ColmapReader().accepts(path / "nowhere")
        refuses(path / "sparse" / ".." / "images", "no COLMAP model", "sparse/0/")
        (model(path) / "images.bin").unlink()
        assert not ColmapReader().accepts(path)
        refuses(path, "no COLMAP model", "images, sparse")

    def test_a_path_into_a_scene_is_refused(self, make):
        path = make()
        refuses(model(path), "a folder inside a scene", f"use {path}")
        refuses(path / "sparse", "a folder inside a scene", f"use {path}")

    def test_paths_without_a_scene_are_refused_with_a_suggestion(self, make):
        path = make()
        refuses(path.parent / "plane", "does not exist", f"did you mean {path}?")
        refuses(path.parent / "zzz" / "q", "does not exist", "check the path")
        refuses(path / "images" / "0000.png", "the scene must be a folder, not a file")

    def test_a_folder_without_list_permission_is_refused(self, make, monkeypatch):
        path = make()

        def deny(self):
            raise PermissionError(13, "Permission denied", str(self))

        monkeypatch.setattr(Path, "iterdir", deny)
        refuses(path, "cannot be read", "Permission denied")

    def test_a_model_file_without_read_permission_is_refused(self, make, monkeypatch):
        path = make()
        opened = Path.open

        def deny(self, *args, **kwargs):
            if self.name == "points3D.bin":
                raise PermissionError(13, "Permission denied", str(self))
            return opened(self, *args, **kwargs)

        monkeypatch.setattr(Path, "open", deny)
        refuses(path, "cannot be read", "points3D.bin", "Permission denied")

    @pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
    @pytest.mark.parametrize("size", [0, 5, 8, 40, -1, -20])
    def test_truncated_files_are_refused(self, make, file, size):
        path = make()
        content = (model(path) / file).read_bytes()
        (model(path) / file).write_bytes(content[:size])
        refuses(path, "incomplete", file)

    @pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
    def test_files_of_random_bytes_are_refused(self, make, file):
        path = make()
        (model(path) / file).write_bytes(np.random.default_rng(0).bytes(3000))
        refuses(path, "incomplete", file)

    @pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
    def test_files_with_data_after_the_last_record_are_refused(self, make, file):
        path = make()
        with (model(path) / file).open("ab") as end:
            end.write(b"\0" * 9)
        refuses(path, "continues after its last record", file)

    @pytest.mark.parametrize("file", ["cameras.txt", "images.txt", "points3D.txt"])
    @pytest.mark.parametrize("text", ["hello world\nfoo bar\n", "1 PINHOLE 48"])
    def test_invalid_text_models_are_refused(self, make, file, text):
        path = make("jpeg")
        (model(path) / file).write_text(text)
        refuses(path, "text model cannot be read", model(path))

    def test_an_unknown_camera_model_is_refused(self, make):
        path = make()
        patch(model(path) / "cameras.bin", 12, struct.pack("<i", 99))
        refuses(path, "the camera model number 99 is unknown", "1 PINHOLE")

    def test_an_image_without_camera_is_refused(self, make):
        path = make()
        patch(model(path) / "cameras.bin", 8, struct.pack("<I", 7))
        refuses(path, "is missing in the model", "[7]", "camera id 1")

    def test_a_spherical_camera_is_refused(self, make):
        path = make()
        record = struct.pack("<QIiQQ2d", 1, 1, 17, 48, 32, 48.0, 32.0)
        (model(path) / "cameras.bin").write_bytes(record)
        refuses(
            path, "camera model EQUIRECTANGULAR cannot be converted to a pinhole camera", "0000.png"
        )

    @pytest.mark.parametrize(
        ("params", "words"),
        [
            ((np.nan, 57.0, 24.0, 16.0), "not a finite number"),
            ((-3.0, 57.0, 24.0, 16.0), "focal length of a camera is not positive"),
            ((57.0, 0.0, 24.0, 16.0), "focal length of a camera is not positive"),
        ],
    )
    def test_impossible_cameras_are_refused(self, make, params, words):
        path = make()
        rewrite_camera(path, 48, 32, params)
        refuses(path, words, "image 0000.png")

    @pytest.mark.parametrize("pose", [(np.nan, 0, 0, 0), (0, 0, 0, 0), (1, 0, 0, 0, np.inf, 0, 0)])
    def test_non_finite_poses_are_refused(self, make, pose):
        path = make()
        patch(model(path) / "images.bin", 12, struct.pack(f"<{len(pose)}d", *pose))
        refuses(path, "a pose contains numbers that are not finite", "0000.png")

    def test_two_poses_with_the_same_name_are_refused(self, make):
        path = make()
        content = (model(path) / "images.bin").read_bytes()
        (model(path) / "images.bin").write_bytes(content.replace(b"0001.png", b"0002.png"))
        refuses(path, "several images of the model have the same name", "0002.png")

    @pytest.mark.parametrize("name", [b"../a.png", b"/etc/a.p"])
    def test_names_outside_the_image_folder_are_refused(self, make, name):
        path = make()
        content = (model(path) / "images.bin").read_bytes()
        (model(path) / "images.bin").write_bytes(content.replace(b"0001.png", name))
        refuses(path, "leads out of the image folder", name.decode())

    def test_backslashes_in_names_are_read_as_slashes(self, make):
        path = make("two")
        content = (model(path) / "images.bin").read_bytes()
        (model(path) / "images.bin").write_bytes(content.replace(b"aerial/", b"aerial\\"))
        assert len(read(path).views) == 16

    def test_a_model_without_images_is_refused(self, make):
        path = make()
        (model(path) / "images.bin").write_bytes(struct.pack("<Q", 0))
        refuses(path, "no image with a pose", "registered")

    @pytest.mark.parametrize("missing", [False, True])
    def test_a_scene_may_have_no_points(self, make, missing):
        path = make()
        (model(path) / "points3D.bin").write_bytes(struct.pack("<Q", 0))
        if missing:
            (model(path) / "points3D.bin").unlink()
        scene = read(path)
        assert scene.points.shape == (0, 3)
        assert all(len(view.seen) == 0 for view in scene.views)
        assert "regimes by footprint: all 8 views (7 train, 1 test)" in notes(scene)

    def test_non_finite_points_are_left_out(self, make):
        path = make()
        patch(model(path) / "points3D.bin", 16, struct.pack("<d", np.nan))
        scene = read(path)
        assert len(scene.points) == 199
        assert "1 point left out (not finite)" in notes(scene)
        assert all(view.seen.max() < 199 for view in scene.views)
        assert color_error(scene.views[1], scene) < 8

    def test_observations_of_removed_points_are_left_out(self, make):
        path = make()
        content = (model(path) / "points3D.bin").read_bytes()
        first = 51 + 8 * struct.unpack_from("<Q", content, 8 + 43)[0]
        rest = struct.pack("<Q", 199) + content[8 + first :]
        (model(path) / "points3D.bin").write_bytes(rest)
        before, after = read(make("two").parent / "plain"), read(path)
        assert len(after.points) == len(before.points) == 199
        assert color_error(after.views[1], after) < 8

    def test_a_single_view_becomes_a_training_view(self, tmp_path):
        scene = read(write_tiny_scene(tmp_path, views=1))
        assert (scene.train, scene.test) == ((0,), ())
        assert "none held out: too few views" in notes(scene)
        assert "all training cameras have the same position" in notes(scene)
        assert np.median(np.linalg.norm(scene.points, axis=1)) == pytest.approx(1, rel=1e-6)


def test_a_model_may_be_given_by_its_absolute_path(tmp_path, monkeypatch):
    write_tiny_scene(tmp_path / "scene")
    monkeypatch.chdir(tmp_path)
    scene = read(Path("scene"), ColmapReader(model=str(tmp_path / "scene" / "sparse" / "0")))
    assert any(f"from {Path('sparse', '0')} (" in note for note in scene.notes)
