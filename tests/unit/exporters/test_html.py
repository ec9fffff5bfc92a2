"""The file of the HTML page: its data, its text and its size. tests/browser looks at the page."""

import json
import re
import zlib
from base64 import b64decode
from dataclasses import replace
from html import unescape

import numpy as np
import pytest
import torch
from support.gaussians import posed_camera, random_gaussians

from crossgrad_core.errors import UserError
from crossgrad_core.plugin import ExportContent, Similarity, View
from crossgrad_plugins.exporters.html import MOST_GAUSSIANS, Html, QuantisedCloud

FRAME = Similarity(np.array([5.0, 6.0, 7.0]), 0.5)
CAMERA = posed_camera()
HOSTILE = "a</script><!--<script>alert(1)</script> & 'b' \"c\" \u2028"


def make(number=40, degree=3, seed=0, **changes):
    gaussians = random_gaussians(number, CAMERA, seed=seed, sh_degree=degree)
    return replace(gaussians.detached().mapped(torch.Tensor.float), **changes)


def written(folder, gaussians, file="page.html", **facts):
    path = folder / file
    assert Html().write(ExportContent(gaussians, FRAME, **facts), path) == ()
    return path.read_text(encoding="utf-8")


def element(text, name):
    return re.search(f'<script type="[a-z/]+" id="{name}">(.*?)</script>', text, re.DOTALL)[1]


def scene_of(text):
    return json.loads(element(text, "scene"))


def decoded(text):
    """The Gaussians in the page, by a decoder of its own."""
    scene, data = scene_of(text), zlib.decompress(b64decode(element(text, "data"), validate=True))
    n, degree = scene["gaussians"], scene["degree"]

    def take(kind, columns):
        nonlocal data
        size = n * columns * np.dtype(kind).itemsize
        part, data = data[:size], data[size:]
        return np.frombuffer(part, kind).reshape(n, columns)

    means, harmonics = take("<f4", 3), take("i1", 16 * degree)
    scales, quats, colors = take("<u2", 4), take("<i2", 4), take("<u2", 4)
    assert data == b""

    def real(stored, between):
        return between[0] + stored / 65535 * (between[1] - between[0])

    ranges = np.ascontiguousarray(scales[:, 3]).view("<f2").astype(float)
    rest = np.zeros((n, (degree + 1) ** 2 - 1, 3))
    for k in range(rest.shape[1]):
        for channel in range(3):
            rest[:, k, channel] = harmonics[:, 12 * (k // 4) + 4 * channel + k % 4] / 127 * ranges
    return {
        "means": means,
        "scales": np.exp(real(scales[:, :3], scene["scale_range"])),
        "quats": quats / 32767,
        "opacities": colors[:, 3] / 65535,
        "sh_dc": real(colors[:, :3], scene["color_range"])[:, None],
        "sh_rest": rest,
    }


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_page_contains_what_stored_returns(tmp_path, degree):
    gaussians = make(degree=degree)
    stored = Html().stored(gaussians, FRAME)
    assert stored.sh_degree == degree
    for name, values in decoded(written(tmp_path, gaussians)).items():
        tensor = getattr(stored, name)
        assert (values.size == 0) == (tensor is None)
        if tensor is not None:
            assert np.allclose(values, tensor.numpy(), rtol=1e-6, atol=1e-7), name


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_stored_gaussians_are_within_the_steps_of_the_format(degree):
    gaussians = make(300, degree)
    gaussians.quats.mul_(3.0)
    stored = Html().stored(gaussians, FRAME)
    assert torch.equal(stored.means, gaussians.means)
    unit = gaussians.quats / gaussians.quats.norm(dim=1, keepdim=True)
    assert (stored.quats - unit).abs().max() < 0.51 / 32767
    logs = gaussians.scales.log()
    span = float(logs.max() - logs.min())
    assert (stored.scales.log() - logs).abs().max() < 0.51 * span / 65535 + 1e-6
    assert (stored.opacities - gaussians.opacities).abs().max() < 0.51 / 65535
    span = float(gaussians.sh_dc.max() - gaussians.sh_dc.min())
    assert (stored.sh_dc - gaussians.sh_dc).abs().max() < 0.51 * span / 65535
    if degree:
        largest = gaussians.sh_rest.abs().amax(dim=(1, 2), keepdim=True).clamp(min=1.0)
        assert ((stored.sh_rest - gaussians.sh_rest).abs() / largest).max() < 0.51 / 127


def test_one_large_coefficient_does_not_coarsen_other_gaussians():
    gaussians = make(100)
    before = Html().stored(gaussians, FRAME)
    gaussians.sh_rest[0, 4, 1] = -300.0
    stored = Html().stored(gaussians, FRAME)
    assert stored.sh_rest[0, 4, 1] == pytest.approx(-300.0, rel=0.005)
    assert torch.equal(stored.sh_rest[1:], before.sh_rest[1:])


def test_the_response_and_the_dilation_are_kept(tmp_path):
    gaussians = make(response="antialiased", dilation=0.1)
    stored = Html().stored(gaussians, FRAME)
    assert (stored.response, stored.dilation) == ("antialiased", 0.1)
    scene = scene_of(written(tmp_path, gaussians))
    assert (scene["antialiased"], scene["dilation"]) == (True, 0.1)
    assert Html().stored(make(), FRAME).dilation is None
    assert scene_of(written(tmp_path, make()))["dilation"] == 0.3


def test_a_gaussian_that_is_not_finite_changes_no_other_gaussian():
    gaussians = make()
    before = Html().stored(gaussians.selected(torch.arange(1, 40)), FRAME)
    for values in (gaussians.means, gaussians.scales, gaussians.sh_dc, gaussians.sh_rest):
        values[0] = torch.nan
    stored = Html().stored(gaussians, FRAME)
    for one, other in zip(before.floats(), stored.floats(), strict=True):
        assert torch.equal(one, other[1:])


def test_the_cameras_are_those_of_the_views(tmp_path):
    view = View("street/0001.jpg", CAMERA, None, "street", np.zeros(0, np.int64))
    up = np.array([0.0, 0.6, 0.8])
    scene = scene_of(written(tmp_path, make(), views=(view,), up=up))
    (camera,) = scene["cameras"]
    assert (camera["name"], camera["regime"]) == ("street/0001.jpg", "street")
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        assert camera[name] == getattr(CAMERA, name)
    assert np.array_equal(camera["world_to_camera"], CAMERA.world_to_camera[:3])
    assert (scene["up"], scene["offset"], scene["scale"]) == ([0.0, 0.6, 0.8], [5, 6, 7], 0.5)


def test_a_scene_without_cameras_gets_one_that_sees_the_gaussians(tmp_path):
    gaussians = make()
    (camera,) = scene_of(written(tmp_path, gaussians))["cameras"]
    pose = np.array(camera["world_to_camera"])
    depths = gaussians.means.numpy() @ pose[2, :3] + pose[2, 3]
    assert (depths > 0).mean() > 0.9


def test_names_cannot_leave_their_elements(tmp_path):
    view = View(HOSTILE, CAMERA, None, HOSTILE, np.zeros(0, np.int64))
    plain = written(tmp_path, make(), views=(replace(view, name="a", regime="a"),))
    text = written(tmp_path, make(), views=(view,), comments=(HOSTILE,), name=HOSTILE)
    for mark in ("<script", "</script", "<!--"):
        assert text.count(mark) == plain.count(mark)
    scene = scene_of(text)
    assert scene["cameras"][0]["name"] == scene["comments"][0] == HOSTILE
    assert unescape(re.search("<title>(.*?)</title>", text)[1]) == HOSTILE


def test_the_page_needs_no_network(tmp_path):
    text = written(tmp_path, make())
    assert re.search(r"https?:|[\"'(=]\s*//|\bimport\b", text) is None
    policy = re.search('Content-Security-Policy" content="(.*?)"', text)[1]
    assert policy.startswith("default-src 'none';") and "http" not in policy


def test_the_same_gaussians_give_the_same_bytes(tmp_path):
    assert written(tmp_path, make(), "a") == written(tmp_path, make(), "b")


@pytest.mark.parametrize("number", [0, MOST_GAUSSIANS + 1])
def test_a_number_of_gaussians_that_no_page_can_show_is_refused(tmp_path, number):
    row = make(1)
    gaussians = row.mapped(lambda tensor: tensor.expand(number, *tensor.shape[1:]))
    with pytest.raises(UserError, match="4,000,000"):
        Html().write(ExportContent(gaussians, FRAME), tmp_path / "page.html")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("degree", [0, 3])
def test_a_page_is_at_most_as_large_as_announced(tmp_path, degree):
    rest = torch.rand((5000, 15, 3), generator=torch.Generator().manual_seed(0)) * 200 - 100
    gaussians = make(5000, degree, sh_rest=rest if degree else None)
    size = len(written(tmp_path, gaussians).encode())
    assert size <= Html().largest_size(5000)


def test_a_gaussian_of_degree_3_has_84_bytes():
    cloud = QuantisedCloud.from_gaussians(make(10))
    arrays = (cloud.means, cloud.harmonics, cloud.scales, cloud.quats, cloud.colors)
    assert sum(array.nbytes for array in arrays) == 84 * len(cloud.means)
