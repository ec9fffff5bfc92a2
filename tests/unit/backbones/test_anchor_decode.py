"""Anchors decode to what the formulas say, one anchor and one slot at a time."""

import math

import numpy as np
import pytest
import torch
from support.extremes import jittered

from crossgrad_backbones.anchors.base import in_frustum
from crossgrad_backbones.anchors.decode import decoded
from crossgrad_backbones.anchors.heads import Seen
from crossgrad_backbones.scaffold import Scaffold
from crossgrad_core.testing.fixtures import sample_phase, sample_scene

OPTIONS = [
    {},
    {"offsets": 3, "feature": 12},
    {"opacity_distance": True},
    {"cov_distance": True, "color_distance": True},
    {"feature_bank": True},
    {"feature_bank": True, "feature": 10},
    {"appearance": 5, "color_distance": True},
]
VIEWS = sample_scene().train_views


def model(options, dtype=torch.float64):
    """A backbone of these options and parameters in which nothing is zero."""
    backbone = Scaffold(**options)
    return backbone, {name: t.detach().to(dtype) for name, t in jittered(backbone).items()}


def network(parameters, name, inputs):
    weight, bias, last, last_bias = (
        parameters[f"{name}.{part}"].double().numpy()
        for part in ("0.weight", "0.bias", "2.weight", "2.bias")
    )
    return last @ np.maximum(weight @ inputs + bias, 0.0) + last_bias


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def mixed(parameters, feature, view):
    """The feature read at strides 4, 2, 1 and mixed by the softmax of the bank's outputs."""
    shares = np.exp(network(parameters, "mlp_bank", view))
    shares /= shares.sum()
    width = len(feature)
    result = np.zeros(width)
    for share, stride in zip(shares, (4, 2, 1), strict=True):
        read = feature[::stride]
        result += share * np.array([read[c % len(read)] for c in range(width)])
    return result


def anchor_gaussians(backbone, parameters, row, camera, factor, code):
    """[(mean, quat, scale, opacity, colour, slot)] of one anchor, from the formulas."""
    feature = parameters["features"][row].double().numpy()
    position = parameters["anchors"][row].double().numpy()
    away = position - camera.center.numpy()
    distance = np.linalg.norm(away)
    direction = away / distance
    if backbone.feature_bank:
        feature = mixed(parameters, feature, np.append(direction, distance))
    outputs = {}
    for name, far in (
        ("mlp_opacity", backbone.opacity_distance),
        ("mlp_cov", backbone.cov_distance),
        ("mlp_color", backbone.color_distance),
    ):
        inputs = [*feature, *direction, *([distance] if far else [])]
        if name == "mlp_color" and code is not None:
            inputs += list(code)
        outputs[name] = network(parameters, name, np.array(inputs))
    log_scales = parameters["scales"][row].double().numpy()
    gaussians = []
    for j in range(backbone.offsets):
        opacity = np.tanh(outputs["mlp_opacity"][j]) * factor
        if opacity <= 0:
            continue
        offset = parameters["offsets"][row, j].double().numpy()
        covariance = outputs["mlp_cov"][7 * j : 7 * j + 7]
        scale = np.exp(log_scales[3:]) * sigmoid(covariance[:3])
        quat = covariance[3:] / np.linalg.norm(covariance[3:])
        color = sigmoid(outputs["mlp_color"][3 * j : 3 * j + 3])
        mean = position + offset * np.exp(log_scales[:3])
        gaussians.append((mean, quat, scale, opacity, color, j))
    return gaussians


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("faded", [False, True])
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_every_decoded_gaussian_agrees_with_the_formulas(options, faded, dtype):
    backbone, parameters = model(options, dtype)
    camera = VIEWS[0].camera
    rows = torch.tensor([0, 3, 4, 11, 17, 21])
    factor = torch.tensor([1.0, 0.25, 0.0, 0.5, 1.0, 0.125]) if faded else torch.ones(6)
    code = parameters["appearance"][1] if backbone.appearance else None
    seen = Seen(rows, factor.to(dtype) if faded else None)
    found = decoded(backbone.heads, parameters, camera, seen, code)
    wanted = [
        (int(row), *gaussian)
        for row, share in zip(rows, factor.numpy(), strict=True)
        for gaussian in anchor_gaussians(backbone, parameters, row, camera, share, code)
    ]
    assert len(wanted) > 3
    close = (
        {"rtol": 1e-12, "atol": 1e-12} if dtype == torch.float64 else {"rtol": 2e-5, "atol": 1e-6}
    )
    for name, column in zip(
        ("origin", "means", "quats", "scales", "opacities", "colors", "slot"),
        zip(*wanted, strict=True),
        strict=True,
    ):
        have = getattr(found, name)
        if name == "quats":
            have = torch.nn.functional.normalize(have)
        np.testing.assert_allclose(have.numpy(), np.array(column), **close)
    assert found.decoded.nonzero().squeeze(1).tolist() == rows.tolist()


def test_an_anchor_without_visible_gaussians_counts_as_decoded():
    backbone, parameters = model({})
    parameters["mlp_opacity.2.bias"] -= 30.0
    found = decoded(backbone.heads, parameters, VIEWS[0].camera, Seen(torch.tensor([2, 5])))
    assert len(found) == 0
    assert found.decoded.nonzero().squeeze(1).tolist() == [2, 5]


def passes(position, log_scale, camera):
    """The filter from the definition: some pixel centre lies in the box of the footprint."""
    pose = camera.world_to_camera.numpy()
    x, y, z = pose[:3, :3] @ position + pose[:3, 3]
    if z <= 1e-3:
        return False
    slopes = []
    for along, focal, center, size in (
        (x, camera.fx, camera.cx, camera.width),
        (y, camera.fy, camera.cy, camera.height),
    ):
        margin = 0.3 * size / (2 * focal)
        slopes.append(
            np.clip(along / z, -center / focal - margin, (size - center) / focal + margin)
        )
    jacobian = np.array(
        [
            [camera.fx / z, 0, -camera.fx * slopes[0] / z],
            [0, camera.fy / z, -camera.fy * slopes[1] / z],
        ]
    )
    axes = jacobian @ pose[:3, :3]
    covariance = axes @ np.diag(np.exp(2 * log_scale)) @ axes.T + 0.3 * np.eye(2)
    reach = math.sqrt(2 * math.log(255)) * np.sqrt(np.diag(covariance))
    center = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
    sizes = (camera.width, camera.height)
    return all(
        any(abs(pixel + 0.5 - center[k]) <= reach[k] for pixel in range(sizes[k])) for k in (0, 1)
    )


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_frustum_filter_keeps_gaussians_that_reach_a_pixel(dtype):
    rng = np.random.default_rng(5)
    kept = 0
    for view in VIEWS:
        positions = rng.normal(0.0, 0.6, (60, 3))
        log_scales = rng.normal(-3.0, 1.5, (60, 6))
        found = in_frustum(
            torch.from_numpy(positions).to(dtype),
            torch.from_numpy(log_scales).to(dtype),
            view.camera,
        )
        wanted = [passes(p, s[:3], view.camera) for p, s in zip(positions, log_scales, strict=True)]
        assert found.tolist() == wanted
        kept += sum(wanted)
    assert 100 < kept < 60 * len(VIEWS) - 100


def test_a_camera_decodes_exactly_the_anchors_that_pass_the_frustum_filter():
    backbone, parameters = model({})
    parameters["anchors"] *= 8.0
    camera = VIEWS[1].camera
    found = backbone.decode(parameters, camera, sample_phase())
    wanted = [
        passes(p.numpy(), s[:3].numpy(), camera)
        for p, s in zip(parameters["anchors"], parameters["scales"], strict=True)
    ]
    assert found.decoded.tolist() == wanted
    assert 0 < sum(wanted) < len(wanted)
