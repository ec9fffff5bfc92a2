"""Exposure values from EXIF headers."""

from dataclasses import replace
from math import log2

import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_plugins.exposures.exif import _of_file, exposure_value

TIME, APERTURE, SENSITIVITY = 33434, 33437, 34855
WHOLE = {TIME: IFDRational(1, 250), APERTURE: IFDRational(8, 1), SENSITIVITY: 200}


def photo(path, tags):
    image = Image.new("RGB", (8, 8))
    exif = Image.Exif()
    exif[0x8769] = tags
    image.save(path, exif=exif)
    return path


def test_time_sensitivity_and_aperture_give_an_exposure_value(tmp_path):
    value = _of_file(photo(tmp_path / "a.jpg", WHOLE))
    assert value == pytest.approx(log2(200 / 250 / 64))


@pytest.mark.parametrize(
    "changes",
    [
        {TIME: IFDRational(0, 1)},
        {TIME: IFDRational(1, 0)},
        {APERTURE: IFDRational(0, 0)},
        {SENSITIVITY: 65535},
        {SENSITIVITY: 0},
    ],
)
def test_impossible_exif_values_give_no_exposure_value(tmp_path, changes):
    assert _of_file(photo(tmp_path / "a.jpg", {**WHOLE, **changes})) is None


@pytest.mark.parametrize("missing", [TIME, APERTURE, SENSITIVITY])
def test_incomplete_exif_values_give_no_exposure_value(tmp_path, missing):
    tags = {tag: value for tag, value in WHOLE.items() if tag != missing}
    assert _of_file(photo(tmp_path / "a.jpg", tags)) is None


def test_a_photo_without_readable_exif_has_no_exposure_value(tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "plain.png")
    assert _of_file(tmp_path / "plain.png") is None
    (tmp_path / "cut.jpg").write_bytes(photo(tmp_path / "a.jpg", WHOLE).read_bytes()[:60])
    assert _of_file(tmp_path / "cut.jpg") is None
    assert exposure_value(sample_scene().views[0]) is None
    assert exposure_value(replace(sample_scene().views[0], name="x")) is None
