"""Bad input: exit code 2, one message that says what to do, no traceback, nothing overwritten."""

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from support.scenes import write_tiny_scene

from crossgrad_core.cli.main import main

BASE = ["--steps", "2", "-q"]


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad") / "scene"
    write_tiny_scene(folder, views=5, suffix=".jpg")
    return folder


@pytest.fixture
def scene(pristine, tmp_path):
    return Path(shutil.copytree(pristine, tmp_path / "scene"))


def truncate(path: Path, keep: float = 0.5) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])


def edited(scene: Path, change: Callable[[pycolmap.Reconstruction], None]) -> None:
    model = scene / "sparse" / "0"
    reconstruction = pycolmap.Reconstruction(str(model))
    change(reconstruction)
    reconstruction.write(str(model))


def as_text(scene: Path) -> Path:
    model = scene / "sparse" / "0"
    reconstruction = pycolmap.Reconstruction(str(model))
    for file in model.glob("*.bin"):
        file.unlink()
    reconstruction.write_text(str(model))
    return model


def replace_in(path: Path, line_of: Callable[[list[str]], int], change: Callable[[str], str]):
    lines = path.read_text().splitlines()
    at = line_of(lines)
    lines[at] = change(lines[at])
    path.write_text("\n".join(lines) + "\n")


def first_data(lines: list[str]) -> int:
    return next(i for i, line in enumerate(lines) if line and not line.startswith("#"))


# Each maker spoils something and returns the arguments of the command line.


def truncated_cameras(scene, tmp):
    truncate(scene / "sparse/0/cameras.bin")
    return ["run", str(scene), *BASE]


def truncated_images(scene, tmp):
    truncate(scene / "sparse/0/images.bin", 0.7)
    return ["run", str(scene), *BASE]


def truncated_points(scene, tmp):
    truncate(scene / "sparse/0/points3D.bin", 0.7)
    return ["run", str(scene), *BASE]


def garbage_cameras(scene, tmp):
    (scene / "sparse/0/cameras.bin").write_bytes(os.urandom(64))
    return ["run", str(scene), *BASE]


def empty_model(scene, tmp):
    shutil.rmtree(scene / "sparse/0")
    (scene / "sparse/0").mkdir()
    return ["run", str(scene), *BASE]


def no_sparse(scene, tmp):
    shutil.rmtree(scene / "sparse")
    return ["run", str(scene), *BASE]


def no_photos(scene, tmp):
    shutil.rmtree(scene / "images")
    return ["run", str(scene), *BASE]


def half_a_photo(scene, tmp):
    truncate(scene / "images/0001.jpg")
    return ["run", str(scene), *BASE]


def photo_is_text(scene, tmp):
    (scene / "images/0001.jpg").write_text("not a photo")
    return ["run", str(scene), *BASE]


def photo_of_another_shape(scene, tmp):
    Image.new("RGB", (40, 40)).save(scene / "images/0001.jpg")
    return ["run", str(scene), *BASE]


def nan_pose(scene, tmp):
    images = as_text(scene) / "images.txt"
    replace_in(images, first_data, lambda line: " ".join(
        "nan" if i == 5 else word for i, word in enumerate(line.split())
    ))  # fmt: skip
    return ["run", str(scene), *BASE]


def negative_focal(scene, tmp):
    cameras = as_text(scene) / "cameras.txt"
    replace_in(cameras, first_data, lambda line: " ".join(
        "-50" if i == 4 else word for i, word in enumerate(line.split())
    ))  # fmt: skip
    return ["run", str(scene), *BASE]


def unknown_camera_model(scene, tmp):
    cameras = as_text(scene) / "cameras.txt"
    replace_in(cameras, first_data, lambda line: line.replace("PINHOLE", "PINHOOL"))
    return ["run", str(scene), *BASE]


def two_images_of_one_name(scene, tmp):
    images = as_text(scene) / "images.txt"
    text = images.read_text().replace("0001.jpg", "0002.jpg")
    images.write_text(text)
    return ["run", str(scene), *BASE]


def zero_points(scene, tmp):
    def change(reconstruction):
        for point in list(reconstruction.points3D):
            reconstruction.delete_point3D(point)

    edited(scene, change)
    return ["run", str(scene), *BASE]


def masked(scene: Path, grey: int) -> list[str]:
    (scene / "masks").mkdir()
    for photo in (scene / "images").iterdir():
        Image.new("L", (48, 32), grey).save(scene / "masks" / f"{photo.name}.png")
    return ["run", str(scene), *BASE]


def all_photos_masked(scene, tmp):
    return masked(scene, 0)


def all_photos_transparent(scene, tmp):
    for photo in sorted((scene / "images").iterdir()):
        Image.new("RGBA", (48, 32)).save(photo.with_suffix(".png"))
        photo.unlink()
    return ["run", str(scene), *BASE]


def mask_of_another_shape(scene, tmp):
    arguments = masked(scene, 255)
    Image.new("L", (48, 48)).save(scene / "masks" / "0001.jpg.png")
    return arguments


def mask_folder_not_there(scene, tmp):
    return ["run", str(scene), "--set", "data.masks=msks", *BASE]


def masks_of_other_photos(scene, tmp):
    (scene / "mine").mkdir()
    Image.new("L", (48, 32)).save(scene / "mine" / "other.png")
    return ["run", str(scene), "--set", "data.masks=mine", *BASE]


def scene_not_there(scene, tmp):
    return ["run", str(tmp / "scen"), *BASE]


def scene_is_a_file(scene, tmp):
    path = tmp / "file"
    path.write_text("x")
    return ["run", str(path), *BASE]


def unknown_option(scene, tmp):
    return ["run", str(scene), "--stepz", "3"]


def unknown_operator(scene, tmp):
    return ["run", str(scene), "--operator", "symetric", *BASE]


def unknown_component_option(scene, tmp):
    return ["run", str(scene), "--set", "rasterizer.max_alhpa=0.9", "--rasterizer", "numba", *BASE]


def option_out_of_bounds(scene, tmp):
    return ["run", str(scene), "--rasterizer", "numba", "--set", "rasterizer.max_alpha=1.5", *BASE]


def unknown_setting(scene, tmp):
    return ["run", str(scene), "--set", "stepps=3", *BASE]


def set_without_value(scene, tmp):
    return ["run", str(scene), "--set", "operator", *BASE]


def zero_steps(scene, tmp):
    return ["run", str(scene), "--steps", "0"]


def steps_and_seconds(scene, tmp):
    return ["run", str(scene), "--steps", "3", "--seconds", "5"]


def odd_pair(scene, tmp):
    return ["run", str(scene), "--sampler", "near-far", "--views", "3", *BASE]


def bad_background(scene, tmp):
    return ["run", str(scene), "--background", "green", *BASE]


def no_such_device(scene, tmp):
    return ["run", str(scene), "--device", "cuda:7", *BASE]


def used_output_folder(scene, tmp):
    out = tmp / "out"
    out.mkdir()
    (out / "precious.txt").write_text("precious")
    return ["run", str(scene), "--out", str(out), *BASE]


def broken_config(scene, tmp):
    path = tmp / "run.yaml"
    path.write_text("steps: [3\n")
    return ["run", str(scene), "--config", str(path)]


def config_not_there(scene, tmp):
    return ["run", str(scene), "--config", str(tmp / "no.yaml"), *BASE]


def init_is_no_ply(scene, tmp):
    path = tmp / "model.ply"
    path.write_text("hello")
    return ["run", str(scene), "--init", str(path), *BASE]


def init_not_there(scene, tmp):
    return ["run", str(scene), "--init", str(tmp / "no.ply"), *BASE]


def resume_of_no_run(scene, tmp):
    return ["run", "--resume", str(scene)]


def test_list_names_nobody(scene, tmp):
    (scene / "train_list.txt").write_text("0000.jpg\n")
    (scene / "test_list.txt").write_text("nobody.jpg\n")
    return ["run", str(scene), *BASE]


def eval_of_no_run(scene, tmp):
    return ["eval", str(tmp)]


def export_format(scene, tmp):
    return ["export", str(tmp), "--format", "doc"]


def reader_of_another_format(scene, tmp):
    return ["run", str(scene), "--reader", "nerfstudio", *BASE]


def exposures_not_there(scene, tmp):
    return ["run", str(scene), "--exposure", "gain", "--exposure-from", str(tmp / "no"), *BASE]


def engine_without_options(scene, tmp):
    (tmp / "grid.yaml").write_text("name: a\nscenes: [scene]\nbase: {steps: 2}\n")
    return ["sweep", str(tmp / "grid.yaml"), "--dry-run", "--engine-option", "address=auto"]


def plugin_not_there(scene, tmp):
    return ["plugins", "show", "symetric"]


MAKERS = [
    truncated_cameras, truncated_images, truncated_points, garbage_cameras, empty_model, no_sparse,
    no_photos, half_a_photo, photo_is_text, photo_of_another_shape, nan_pose, negative_focal,
    unknown_camera_model, two_images_of_one_name, zero_points, all_photos_masked,
    all_photos_transparent, mask_of_another_shape, mask_folder_not_there, masks_of_other_photos,
    scene_not_there, scene_is_a_file,
    unknown_option, unknown_operator, unknown_component_option, option_out_of_bounds,
    unknown_setting, set_without_value, zero_steps, steps_and_seconds, odd_pair, bad_background,
    no_such_device, used_output_folder, broken_config, config_not_there, init_is_no_ply,
    init_not_there, resume_of_no_run, test_list_names_nobody, eval_of_no_run, export_format,
    plugin_not_there, reader_of_another_format, exposures_not_there, engine_without_options,
]  # fmt: skip
test_list_names_nobody.__test__ = False


def everything_below(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def what_to_do(message: str) -> str:
    """What a message tells the user to do; the parser of options points to the help."""
    lines = [line.strip() for line in message.splitlines()]
    told = [line.removeprefix("to do:").strip() for line in lines if line.startswith("to do:")]
    helped = [line for line in lines if line.startswith("Try 'crossgrad")]
    return " ".join(told + helped)


def failing(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    return int(stopped.value.code or 0)


@pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__)
def test_bad_input_is_refused_with_one_message(make, scene, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = make(scene, tmp_path)
    before = everything_below(tmp_path)
    assert failing(arguments) == 2
    message = capfd.readouterr().err
    assert "Traceback" not in message
    assert message.lower().count("error") >= 1
    assert what_to_do(message)
    assert everything_below(tmp_path) == before


@pytest.mark.parametrize(
    ("text", "more", "where"),
    [
        ("steps: -3", [], "steps in run.yaml"),
        ("stepz: 3", [], "stepz in run.yaml"),
        ("device: gpu", [], "device in run.yaml"),
        ("densifier: {name: adc, division: axes}", [], "densifier.division in run.yaml"),
        ("steps: 3", ["--steps", "-3"], "steps"),
        ("device: cpu", ["--device", "gpu"], "--device"),
        ("densifier: adc", ["--set", "densifier.division=axes"], "densifier.division"),
        ("seed: 3", ["--device", "gpu"], "--device"),
    ],
)
def test_an_error_names_the_file_that_contains_the_wrong_setting(
    text, more, where, scene, tmp_path, capfd
):
    path = tmp_path / "run.yaml"
    path.write_text(text)
    out = ["--out", str(tmp_path / "out")]
    assert failing(["run", str(scene), "--config", str(path), *out, *more]) == 2
    lines = capfd.readouterr().err.splitlines()
    told = [line.split(":", 1)[1].strip() for line in lines if "where:" in line]
    assert told == [where.replace("run.yaml", str(path))]


def full_disk(*args: object, **kwargs: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_gives_one_error_and_keeps_earlier_results(scene, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1000))
    assert failing(["run", str(scene), "--out", str(tmp_path / "out"), *BASE]) == 2
    message = capfd.readouterr().err
    assert "space" in message and "Traceback" not in message
    assert not (tmp_path / "out").exists()


def test_a_disk_that_fills_during_the_run_gives_one_error(scene, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("crossgrad_core.run.checkpoint.write_tensors", full_disk)
    assert failing(["run", str(scene), "--out", str(tmp_path / "out"), *BASE]) == 1
    message = capfd.readouterr().err
    assert message.count("not enough disk space") == 1 and "Traceback" not in message
    assert "the state of step 1 could not be saved; there is no checkpoint" in message
    assert (tmp_path / "out" / "config.yaml").is_file()


def test_the_tests_cover_at_least_25_kinds_of_bad_input():
    assert len(MAKERS) >= 25
    assert np.unique([make.__name__ for make in MAKERS]).size == len(MAKERS)
