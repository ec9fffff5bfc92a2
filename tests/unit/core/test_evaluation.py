"""Evaluation of held-out views: 8-bit renders, masks, means overall and per regime."""

from collections.abc import Callable
from dataclasses import replace
from math import log10

import numpy as np
import pytest
import torch
from support.figures import FIGURES, METRICS, of
from torch import Tensor

from crossgrad_core.contract.figure import Figure
from crossgrad_core.contract.scene import Camera, View
from crossgrad_core.contract.slots.metric import Metric
from crossgrad_core.evaluation.evaluation import Evaluated, evaluate
from crossgrad_core.evaluation.result import ViewMetrics, summarised

HEIGHT, WIDTH = 20, 32


class Constant(Metric):
    """0.25 of every view."""

    figure = Figure("lpips", "LPIPS")

    def measure(self, compared):
        return 0.25


class Brightness(Metric):
    """How much brighter the photo is, grey levels."""

    figure = Figure("lpips", "LPIPS")

    def measure(self, compared):
        return float((compared.photo.float() - compared.render.float()).mean())


class FlatPhoto:
    """A photo of one grey, with an optional mask."""

    def __init__(self, grey: int, mask: Tensor | None = None) -> None:
        self._grey, self._mask = grey, mask

    def image(self) -> Tensor:
        return torch.full((HEIGHT, WIDTH, 3), self._grey, dtype=torch.uint8)

    def mask(self) -> Tensor | None:
        return self._mask


def make_view(name: str, regime: str, grey: int = 100, mask: Tensor | None = None) -> View:
    pose = torch.eye(4, dtype=torch.float64)
    camera = Camera(WIDTH, HEIGHT, 20.0, 20.0, WIDTH / 2, HEIGHT / 2, pose)
    return View(name, camera, FlatPhoto(grey, mask), regime, np.empty(0, dtype=np.int64))


def flat(grey: float) -> Callable[[View], Tensor]:
    """Renders every view as one grey of 255."""
    return lambda _view: torch.full((HEIGHT, WIDTH, 3), grey / 255.0)


def decibel(difference: float) -> float:
    return -20.0 * log10(difference / 255.0)


def test_means_are_computed_overall_and_per_regime():
    views = [
        make_view("far/1", "far", grey=110),
        make_view("near/1", "near", grey=120),
        make_view("near/2", "near", grey=140),
    ]
    result = evaluate(views, flat(100), METRICS)
    each = [decibel(10), decibel(20), decibel(40)]
    assert [view.name for view in result.views] == ["far/1", "near/1", "near/2"]
    assert [view["psnr"] for view in result.views] == pytest.approx(each, abs=1e-4)
    assert result.overall["psnr"] == pytest.approx(sum(each) / 3, abs=1e-4)
    assert list(result.regimes) == ["far", "near"]
    assert result.regimes["far"]["psnr"] == pytest.approx(each[0], abs=1e-4)
    assert result.regimes["near"]["psnr"] == pytest.approx((each[1] + each[2]) / 2, abs=1e-4)
    assert (result.regimes["far"].views, result.regimes["near"].views) == (1, 2)
    assert result.overall["ssim"] is not None
    assert 0.0 < result.overall["ssim"] < 1.0
    assert result.overall["ssim_skimage"] is not None


@pytest.mark.parametrize(("render", "seen"), [(100.4, 100), (100.6, 101), (-50.0, 0), (900.0, 255)])
def test_renders_are_rounded_to_8_bits_before_comparison(render: float, seen: int):
    result = evaluate([make_view("a", "all", grey=90)], flat(render), METRICS)
    assert result.views[0]["psnr"] == pytest.approx(decibel(abs(seen - 90)), abs=1e-4)


def test_masked_pixels_do_not_count_in_the_metrics():
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, 20:] = False
    image = torch.full((HEIGHT, WIDTH, 3), 110 / 255.0)
    image[:, 20:] = 1.0
    result = evaluate([make_view("a", "all", 100, mask)], lambda _view: image, METRICS)
    assert result.views[0]["psnr"] == pytest.approx(decibel(10), abs=1e-4)


def test_a_fully_masked_view_does_not_count_in_the_means():
    nothing = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    views = [make_view("a", "x", 110, nothing), make_view("b", "x", 110)]
    result = evaluate(views, flat(100), (*METRICS[:3], Constant()))
    assert result.views[0] == replace(of("a", "x", None, None, None, 0.25), masked=True)
    assert result.overall["psnr"] == pytest.approx(decibel(10), abs=1e-4)
    assert result.overall["lpips"] == 0.25
    alone = evaluate(views[:1], flat(100), METRICS)
    assert alone.overall["psnr"] is None
    assert alone.reasons["psnr"] == "every pixel is masked"


def test_no_held_out_views_give_null_with_the_reason():
    result = evaluate([], flat(100), METRICS)
    assert result.overall.views == 0
    assert result.overall["psnr"] is None
    assert result.overall["ssim"] is None
    assert result.regimes == {}
    assert set(result.reasons) == {"psnr", "ssim", "ssim_skimage", "lpips"}
    assert "no held-out views" in result.reasons["psnr"]


def test_lpips_is_measured_only_if_requested():
    views = [make_view("a", "x", 100), make_view("b", "x", 120)]

    without = evaluate(views, flat(100), METRICS)
    assert without.overall["lpips"] is None
    assert list(without.reasons) == ["lpips"]
    result = evaluate(views, flat(100), (*METRICS[:3], Brightness()))
    assert result.overall["lpips"] == pytest.approx(10.0, abs=1e-4)
    assert result.reasons == {}


def test_panels_receive_the_compared_images():
    offered: list[Evaluated] = []
    views = [make_view("a", "x", 7), make_view("b", "x", 9)]
    result = evaluate(views, flat(100.4), METRICS, on_view=offered.append)
    assert [item.compared.view for item in offered] == views
    assert [item.metrics for item in offered] == list(result.views)
    assert offered[1].compared.render.dtype == torch.uint8
    assert offered[1].compared.render.unique().tolist() == [100]
    assert offered[1].compared.photo.unique().tolist() == [9]


def test_an_image_too_small_for_one_metric_keeps_the_other_metrics():
    border = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    border[5:-5, 5:-5] = False  # scikit-image's SSIM leaves out just these five pixels
    result = evaluate([make_view("a", "x", 110, border)], flat(100), METRICS)
    assert result.overall["psnr"] == pytest.approx(decibel(10), abs=1e-4)
    assert result.overall["ssim_skimage"] is None
    assert "scikit-image" in result.reasons["ssim_skimage"]


def test_evaluation_records_no_operations_for_gradients():
    parameter = torch.tensor(0.5, requires_grad=True)

    def render(_view: View) -> Tensor:
        assert not torch.is_grad_enabled()
        return parameter.expand(HEIGHT, WIDTH, 3)

    assert evaluate([make_view("a", "x")], render, METRICS).overall["psnr"] is not None


def test_means_omit_views_without_a_value():
    result = summarised(
        [
            of("a", "x", 20.0, 0.5, 0.5, None),
            of("b", "x", None, None, None, 0.3),
            of("c", "y", 30.0, 0.7, 0.9, None),
        ],
        FIGURES,
    )
    assert result.overall["psnr"] == 25.0
    assert result.overall["lpips"] == 0.3
    assert result.regimes["x"]["psnr"] == 20.0
    assert result.regimes["x"].views == 2
    assert result.regimes["y"]["lpips"] is None


def test_fully_masked_views_are_not_counted():
    figure = Figure("psnr", "PSNR")
    views = [
        ViewMetrics("a", "near", {"psnr": 20.0}),
        ViewMetrics("b", "near", {"psnr": None}, masked=True),
        ViewMetrics("c", "far", {"psnr": None}, masked=True),
    ]
    result = summarised(views, [figure])
    assert result.overall.as_data() == {"views": 1, "psnr": 20.0}
    assert result.regimes["far"].views == 0
