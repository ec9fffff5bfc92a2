"""Rasterizers that differ from the rules in one way are refused for that reason."""

from dataclasses import replace

import pytest

from crossgrad_core.registry.entries import load
from crossgrad_core.testing.support import reference
from crossgrad_core.testing.support.contract import ContractError

Torch = load("rasterizers", "torch")


class Changed(Torch):
    """Draws as the reference does, but for one change of what it gets or gives."""

    def given(self, gaussians, camera, background):
        return gaussians, camera, background

    def render(self, gaussians, camera, background, outputs=frozenset()):
        return super().render(*self.given(gaussians, camera, background), outputs)


class Centred(Changed):
    def given(self, gaussians, camera, background):
        return gaussians, replace(camera, cx=camera.width / 2, cy=camera.height / 2), background


class OneFocalLength(Changed):
    def given(self, gaussians, camera, background):
        return gaussians, replace(camera, fy=camera.fx), background


class AllBands(Changed):
    def given(self, gaussians, camera, background):
        degree = 0 if gaussians.sh_rest is None else 3
        return replace(gaussians, sh_degree=degree), camera, background


class OneScale(Changed):
    def given(self, gaussians, camera, background):
        wider = gaussians.scales.clamp(min=0.02)
        return replace(gaussians, scales=wider), camera, background


class DepthOverAlpha(Torch):
    def render(self, gaussians, camera, background, outputs=frozenset()):
        render = super().render(gaussians, camera, background, outputs)
        if render.depth is None:
            return render
        return replace(render, depth=render.depth / render.alpha.clamp(min=1e-6))


class GradientsInNdc(Torch):
    def render(self, gaussians, camera, background, outputs=frozenset()):
        render = super().render(gaussians, camera, background, outputs)
        return replace(render, screen=Doubled(render.screen))


class Doubled:
    """Statistics whose mean gradient is twice as long."""

    def __init__(self, screen):
        self.screen = screen

    def __getattr__(self, name):
        value = getattr(self.screen, name)
        return 2.0 * value if name == "mean_gradient" and value is not None else value


class AlphaWithoutGradient(Torch):
    def render(self, gaussians, camera, background, outputs=frozenset()):
        render = super().render(gaussians, camera, background, outputs)
        return replace(render, alpha=render.alpha.detach())


class OneBackground(Torch):
    def render_views(self, views, backgrounds, outputs=frozenset()):
        return super().render_views(views, [backgrounds[0]] * len(views), outputs)


def fixing(**options):
    """A rasterizer that draws with these options, whatever it is told."""

    class Ignores(Torch):
        def render(self, gaussians, camera, background, outputs=frozenset()):
            usual = Torch(**{**self.model_dump(), **options})
            return usual.render(gaussians, camera, background, outputs)

    return Ignores


@pytest.mark.parametrize(
    ("check", "make", "words"),
    [
        (reference.the_camera_is_heeded, Centred, "principal point"),
        (reference.the_camera_is_heeded, OneFocalLength, "two focal lengths"),
        (reference.the_reference_draws_the_same, AllBands, "sh_degree"),
        (reference.the_reference_draws_the_same, DepthOverAlpha, "depth .* not divided by alpha"),
        (reference.the_reference_draws_the_same, GradientsInNdc, "screen.mean_gradient"),
        (reference.the_reference_draws_the_same, AlphaWithoutGradient, "gradient of"),
        (reference.extreme_gaussians_are_drawn_alike, OneScale, "needles"),
        (reference.its_options_are_heeded, fixing(max_alpha=0.99), "option max_alpha"),
        (reference.its_options_are_heeded, fixing(near=1e-3), "option near"),
        (reference.its_options_are_heeded, fixing(dilation=0.3), "option dilation"),
        (reference.views_drawn_together_are_the_same, OneBackground, "view 2 of 3"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_a_wrong_rasterizer_is_refused_with_the_right_reason(check, make, words):
    with pytest.raises(ContractError, match=words):
        check(make)


def test_a_rasterizer_with_the_published_footprint_passes():
    def make():
        return Torch(footprint="3-sigma", max_alpha=0.999)

    for check in reference.REFERENCE_CHECKS:
        check(make)
