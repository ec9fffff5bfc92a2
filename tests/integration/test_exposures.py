"""Exposures in whole runs: found, off where nothing calls for them, reused, and at extremes."""

import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from support.scenes import write_tiny_scene

from crossgrad_core.errors import UserError
from crossgrad_core.run import app
from crossgrad_core.run.checkpoint import latest, load
from crossgrad_core.run.results.reading import read_run

MODELS = ("gain", "channel", "affine")


def with_long(model):
    """All models; those but one belong to `make exposures`."""
    return [model if each == model else pytest.param(each, marks=pytest.mark.exposures)
            for each in MODELS]  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    return write_tiny_scene(folder, views=9, width=64, height=48, points=400, suffix=".png")


def changed(scene, folder, change):
    """The scene with `change(number, linear light)` of each photo in place of its light."""
    shutil.copytree(scene, folder)
    for number, path in enumerate(sorted(folder.glob("images/**/*.png"))):
        light = (np.asarray(Image.open(path), dtype=np.float64) / 255) ** 2.2
        values = np.clip(change(number, light), 0, 1) ** (1 / 2.2)
        Image.fromarray((255 * values).round().astype(np.uint8)).save(path)
    return folder


@pytest.fixture(scope="module")
def varied(scene, tmp_path_factory):
    """Every other photo a stop and a half darker."""
    folder = tmp_path_factory.mktemp("varied") / "tiny"
    return changed(scene, folder, lambda number, light: light * (0.35 if number % 2 else 1.0))


def run(scene, out, **settings):
    given = {"scene": str(scene), "out": str(out), "steps": 12, "threads": 1}
    return app.run({**given, **settings}, verbosity=-1)


def parameters(out):
    return load(latest(out)).parameters


def same(one, other):
    one, other = parameters(one), parameters(other)
    return one.keys() == other.keys() and all(torch.equal(one[n], other[n]) for n in one)


def photos(out):
    content = json.loads((out / "exposure.json").read_text())
    return content["exposure"], content["photos"]


def notes(out):
    return " ".join(read_run(out).summary["notes"])


@pytest.mark.slow
def test_exposure_auto_is_off_if_photos_agree_and_changes_no_bit(scene, tmp_path):
    assert run(scene, tmp_path / "none", exposure={"name": "none"}) == 0
    assert run(scene, tmp_path / "auto") == 0
    assert same(tmp_path / "none", tmp_path / "auto")
    assert read_run(tmp_path / "auto").config["exposure"]["name"] == "none"
    assert "exposure auto: none" in notes(tmp_path / "auto")
    assert "--exposure" not in notes(tmp_path / "none")
    assert not (tmp_path / "none" / "exposure.json").exists()


def test_exposure_auto_selects_gain_if_photos_differ_and_exposure_none_suggests_gain(
    varied, tmp_path
):
    assert run(varied, tmp_path / "auto") == 0
    assert run(varied, tmp_path / "gain", exposure={"name": "gain"}) == 0
    assert run(varied, tmp_path / "none", exposure={"name": "none"}) == 0
    assert same(tmp_path / "auto", tmp_path / "gain")
    assert read_run(tmp_path / "auto").config["exposure"]["name"] == "gain"
    assert "gains with a standard deviation of" in notes(tmp_path / "auto")
    assert "--exposure gain" in notes(tmp_path / "none")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("model", MODELS)
def test_each_exposure_model_starts_at_the_measured_values(varied, tmp_path, model):
    assert run(varied, tmp_path / "run", steps=1, exposure={"name": model}) == 0
    name, found = photos(tmp_path / "run")
    assert name == model
    kind = "matrix" if model == "affine" else "stops"
    values = {photo: np.array(each[kind]) for photo, each in found.items()}
    level = {photo: float(np.diag(v[:, :3]).mean() if model == "affine" else v.mean())
             for photo, v in values.items()}  # fmt: skip
    number = {photo: int(photo.removesuffix(".png")) for photo in level}
    dark = [level[photo] for photo in level if number[photo] % 2]
    bright = [level[photo] for photo in level if not number[photo] % 2]
    if model == "affine":
        dark, bright = np.log2(dark) * 2.4, np.log2(bright) * 2.4
    assert np.mean(bright) - np.mean(dark) == pytest.approx(np.log2(1 / 0.35), abs=0.3)
    neutral = np.eye(3, 4) if model == "affine" else 0.0
    assert np.mean(list(values.values()), axis=0) == pytest.approx(neutral, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("model", with_long("channel"))
def test_a_resumed_run_ends_with_the_bits_of_an_uninterrupted_run(varied, tmp_path, model):
    settings = {"exposure": {"name": model, "rate": 0.05}, "views_per_step": 3}
    assert run(varied, tmp_path / "whole", **settings) == 0
    assert run(varied, tmp_path / "broken", stop_after=5, **settings) == 0
    assert app.run({}, resume=tmp_path / "broken", verbosity=-1) == 0
    assert same(tmp_path / "whole", tmp_path / "broken")
    assert photos(tmp_path / "whole") == photos(tmp_path / "broken")


@pytest.mark.slow
def test_an_exposure_learning_rate_of_zero_keeps_the_initial_values(varied, tmp_path):
    kept = {"name": "gain", "rate": 0.0}
    assert run(varied, tmp_path / "one", steps=1, exposure=kept) == 0
    assert run(varied, tmp_path / "more", exposure=kept) == 0
    assert photos(tmp_path / "one") == photos(tmp_path / "more")
    with pytest.raises(UserError, match="have no effect") as caught:
        run(varied, tmp_path / "idle", exposure={**kept, "decay": 0.5})
    assert "exposure.decay" in caught.value.where


def test_exposure_from_starts_at_the_values_of_another_run(varied, tmp_path):
    fast = {"name": "gain", "rate": 0.05}
    assert run(varied, tmp_path / "first", exposure=fast) == 0
    values = tmp_path / "first" / "exposure.json"
    kept = {"exposure": {"name": "gain", "rate": 0.0}, "exposure_from": str(values)}
    assert run(varied, tmp_path / "second", **kept) == 0
    one, other = photos(tmp_path / "first")[1], photos(tmp_path / "second")[1]
    assert one.keys() == other.keys()
    for photo in one:
        assert one[photo]["stops"] == pytest.approx(other[photo]["stops"], abs=1e-6)
    config = tmp_path / "second" / "config.yaml"
    assert str(values) in config.read_text()


@pytest.mark.sampled(1)
@pytest.mark.parametrize("model", ["gain", "affine"])
def test_photos_missing_from_the_file_keep_their_exposure_relative_to_other_photos(
    varied, tmp_path, model
):
    """The file contains three photos, each three stops brighter than in the earlier run."""
    kind = "matrix" if model == "affine" else "stops"

    def levels(values):
        numbers = (np.array(values[name][kind]) for name in sorted(values))
        return [2.4 * np.log2(each[1, 1]) if model == "affine" else each for each in numbers]

    def brighter(value):
        if model == "gain":
            return value + 3.0
        return (np.array(value) @ np.diag([2.0**1.25] * 3 + [1.0])).tolist()

    exposure = {"name": model, "rate": 0.0}
    values = tmp_path / "exposure.json"
    assert run(varied, tmp_path / "first", steps=1, exposure=exposure) == 0
    known = photos(tmp_path / "first")[1]
    some = {name: {kind: brighter(known[name][kind])} for name in sorted(known)[:3]}
    values.write_text(json.dumps({"format": 1, "exposure": model, "photos": some}))
    kept = {"exposure": exposure, "exposure_from": str(values)}
    assert run(varied, tmp_path / "second", steps=1, **kept) == 0
    after = photos(tmp_path / "second")[1]
    assert after.keys() == known.keys()
    assert np.diff(levels(after)) == pytest.approx(np.diff(levels(known)), abs=1e-5)


WRONG = {
    "no JSON": (b"{", "cannot be read"),
    "another file": (b'{"status": "finished"}', "does not contain parameters"),
    "other photos": (
        b'{"format": 1, "exposure": "gain", "photos": {"x.png": {"stops": 0}}}',
        "no values for the training photos",
    ),
    "another exposure": (
        b'{"format": 1, "exposure": "channel", "photos": {"0001.png": {"stops": [0, 0, 0]}}}',
        "another exposure model",
    ),
    "other parameters": (
        b'{"format": 1, "exposure": "x", "photos": {"0001.png": {"matrix": 0}}}',
        "another exposure model",
    ),
    "no numbers": (
        b'{"format": 1, "exposure": "gain", "photos": {"0001.png": {"stops": "bright"}}}',
        "another exposure model",
    ),
    "not finite": (
        b'{"format": 1, "exposure": "gain", "photos": {"0001.png": {"stops": NaN}}}',
        "another exposure model",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_an_invalid_exposure_file_is_refused_before_anything_is_written(varied, tmp_path, case):
    content, why = WRONG[case]
    (tmp_path / "values.json").write_bytes(content)
    settings = {"exposure": {"name": "gain"}, "exposure_from": str(tmp_path / "values.json")}
    with pytest.raises(UserError, match=why):
        run(varied, tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()


def test_an_exposure_file_for_an_exposure_without_values_is_refused(scene, tmp_path):
    (tmp_path / "values.json").write_text("{}")
    with pytest.raises(UserError, match="have no effect") as caught:
        run(scene, tmp_path / "run", exposure_from=str(tmp_path / "values.json"))
    assert "no per-photo values" in caught.value.found


def finite(out):
    assert all(torch.isfinite(tensor).all() for tensor in parameters(out).values())
    for state in load(latest(out)).plugins.values():
        assert all(torch.isfinite(tensor).all() for tensor in state.tensors.values())
    return True


EXTREMES = {
    "ten stops": lambda number, light: light * 2.0 ** (10 - 20 * (number % 2)),
    "a black photo": lambda number, light: light * (number != 3) * (0.3 if number % 2 else 1.0),
    "black photos": lambda number, light: 0 * light,
    "white photos": lambda number, light: 0 * light + 1,
}


def check_extremes(scene, tmp_path, case, model, views):
    folder = changed(scene, tmp_path / "scene", EXTREMES[case])
    settings = {"exposure": {"name": model}, "views_per_step": views}
    assert run(folder, tmp_path / "run", steps=6, **settings) == 0
    assert finite(tmp_path / "run")
    assert "because there are no usable tracks and no EXIF data" in notes(tmp_path / "run")


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("case", "model"), [("ten stops", "gain"), ("a black photo", "affine")], ids=" ".join
)
def test_extreme_photos_give_finite_results_and_are_named(scene, tmp_path, case, model):
    check_extremes(scene, tmp_path, case, model, 2)


@pytest.mark.exposures
@pytest.mark.parametrize("views", [1, 3])
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("case", EXTREMES)
def test_all_extreme_photos_give_finite_results_with_all_models(
    scene, tmp_path, case, model, views
):
    check_extremes(scene, tmp_path, case, model, views)


@pytest.mark.slow
@pytest.mark.parametrize("model", with_long("gain"))
def test_gains_of_ten_stops_from_a_file_give_finite_results_and_are_named(varied, tmp_path, model):
    assert run(varied, tmp_path / "first", steps=1, exposure={"name": "gain"}) == 0
    names = sorted(photos(tmp_path / "first")[1])
    kind = "matrix" if model == "affine" else "stops"
    gains = [10.0 - 20.0 * (row % 2) for row in range(len(names))]
    values = {
        "gain": list,
        "channel": lambda gains: [[gain] * 3 for gain in gains],
        "affine": lambda gains: [(2 ** (gain / 2.4) * np.eye(3, 4)).tolist() for gain in gains],
    }[model](gains)
    content = {name: {kind: value} for name, value in zip(names, values, strict=True)}
    file = tmp_path / "values.json"
    file.write_text(json.dumps({"format": 1, "exposure": model, "photos": content}))
    settings = {"exposure": {"name": model}, "exposure_from": str(file)}
    assert run(varied, tmp_path / "run", steps=6, **settings) == 0
    assert finite(tmp_path / "run")
    assert "photos differ by more than 4 stops from the mean" in notes(tmp_path / "run")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("model", [*with_long("gain"), "auto"])
def test_photos_without_tracks_start_at_the_exposure_of_their_regime(varied, tmp_path, model):
    folder = tmp_path / "scene"
    shutil.copytree(varied, folder)
    (folder / "sparse" / "0" / "points3D.bin").unlink()
    settings = {"exposure": {"name": model}, "data": {"init": "random"}}
    assert run(folder, tmp_path / "run", steps=2, **settings) == 0
    assert finite(tmp_path / "run")
    assert "no SfM tracks connect the photos" in notes(tmp_path / "run")


@pytest.mark.parametrize("model", [*with_long("channel"), "auto"])
def test_a_single_photo_gets_no_exposure_correction(scene, tmp_path, model):
    folder = tmp_path / "scene"
    shutil.copytree(scene, folder)
    names = sorted(path.name for path in (folder / "images").iterdir())
    (folder / "train_list.txt").write_text(names[0])
    (folder / "test_list.txt").write_text("\n".join(names[1:3]))
    exposure = {"name": model} if model == "auto" else {"name": model, "rate": 0.1}
    assert run(folder, tmp_path / "run", steps=3, exposure=exposure) == 0
    assert finite(tmp_path / "run")
    if model == "auto":
        assert "exposure auto: none" in notes(tmp_path / "run")
    else:
        assert "only one training photo" in notes(tmp_path / "run")


def with_exif(path, stops):
    from PIL.TiffImagePlugin import IFDRational

    image = Image.open(path)
    exif = Image.Exif()
    time, aperture = IFDRational(round(1e6 * 2.0**stops), 10**8), IFDRational(4, 1)
    exif[0x8769] = {33434: time, 33437: aperture, 34855: 100}
    image.save(path.with_suffix(".jpg"), exif=exif, quality=95)
    path.unlink()


@pytest.mark.slow
@pytest.mark.parametrize("model", with_long("gain"))
def test_exif_gives_initial_exposures_and_predicts_unseen_photos(varied, tmp_path, model):
    folder = tmp_path / "scene"
    shutil.copytree(varied, folder)
    for number, path in enumerate(sorted(folder.glob("images/*.png"))):
        with_exif(path, np.log2(0.35) if number % 2 else 0.0)
    settings = {"exposure": {"name": model, "start": "exif"}}
    # The photos held out are the first and the last, both bright; the others are half and half.
    assert run(folder, tmp_path / "exif", steps=120, **settings) == 0
    told = read_run(tmp_path / "exif").figure("psnr")
    for path in folder.glob("images/*.jpg"):
        photo = Image.open(path)
        photo.save(path, quality=95)
    blind = {"exposure": {"name": model}}
    assert run(folder, tmp_path / "blind", steps=120, **blind) == 0
    assert told > read_run(tmp_path / "blind").figure("psnr") + 0.5
