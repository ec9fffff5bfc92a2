"""The footprint of the original 3DGS code, against its rules in a loop over pixels."""

from dataclasses import replace
from math import ceil, exp, floor, sqrt

import numpy as np
import pytest
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build
from crossgrad_core.run import select as selecting
from crossgrad_core.run.decisions import with_decisions
from crossgrad_core.testing.fixtures import sample_camera, sample_scene
from crossgrad_plugins.rasterizers.reference.projection import project

NAMES = ("torch", "numba")
WIDTH, HEIGHT, NEAR = 72, 40, 0.2


def camera():
    made = sample_camera()
    return replace(made, width=WIDTH, height=HEIGHT, fx=60.0, fy=60.0, cx=36.0, cy=20.0)


def gaussians(seed, number=40):
    """Of all sizes, some faint, some behind the near plane, some off the image."""
    rng = np.random.default_rng(seed)
    drawn = {
        "means": rng.uniform(-0.9, 0.9, (number, 3)),
        "quats": rng.normal(size=(number, 4)),
        "scales": np.exp(rng.uniform(-6.0, -1.5, (number, 3))),
        "opacities": rng.uniform(0.0, 1.0, number) ** 3,
        "colors": rng.uniform(size=(number, 3)),
    }
    return Gaussians(**{k: torch.from_numpy(v.astype(np.float32)) for k, v in drawn.items()})


def rendered(name, of, footprint="3-sigma"):
    of = replace(of, means=of.means.clone().requires_grad_())
    if name == "torch":
        names = ("means", "quats", "scales", "opacities", "colors")
        of = replace(of, **{key: getattr(of, key).double() for key in names})
    rasterizer = build("rasterizers", name, {"footprint": footprint, "near": NEAR})
    return rasterizer.render(of, camera(), torch.zeros(3))


def by_pixel(of):
    """Image [H, W, 3] and radii by the rules of methods.md 1.5 and 1.6, one pixel at a time."""
    of = replace(of, **{k: getattr(of, k).double() for k in ("means", "quats", "scales")})
    flat = project(of.means, of.quats, of.scales, camera())
    image, radii = np.zeros((HEIGHT, WIDTH, 3)), np.zeros(len(of), dtype=int)
    through, stopped = np.ones((HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH), dtype=bool)
    for i in np.argsort(flat.depths.numpy(), kind="stable"):
        if flat.depths[i] <= NEAR:
            continue
        a, b, c = float(flat.xx[i]) + 0.3, float(flat.xy[i]), float(flat.yy[i]) + 0.3
        middle, det = (a + c) / 2, a * c - b * b
        radius = ceil(3 * sqrt(middle + sqrt(max(0.1, middle**2 - det))))
        # Pixels are numbered from the centre of the first one.
        x, y = (float(each) - 0.5 for each in flat.means[i])
        x0, x1 = floor((x - radius) / 16) * 16, floor((x + radius) / 16) * 16 + 16
        y0, y1 = floor((y - radius) / 16) * 16, floor((y + radius) / 16) * 16 + 16
        for row in range(max(y0, 0), min(y1, HEIGHT)):
            for column in range(max(x0, 0), min(x1, WIDTH)):
                radii[i] = radius
                dx, dy = x - column, y - row
                power = -(c * dx * dx + a * dy * dy) / (2 * det) + b * dx * dy / det
                alpha = min(0.99, float(of.opacities[i]) * exp(power))
                if alpha < 1 / 255 or stopped[row, column]:
                    continue
                after = through[row, column] * (1 - alpha)
                if after < 1e-4:
                    stopped[row, column] = True
                    continue
                image[row, column] += alpha * through[row, column] * of.colors[i].numpy()
                through[row, column] = after
    return image, radii


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", range(3))
def test_every_pixel_follows_the_published_rule(name, seed):
    of = gaussians(seed)
    image, radii = by_pixel(of)
    drawn = rendered(name, of)
    # No footprint that misses a pixel by rounding in these scenes.
    assert np.abs(drawn.image.detach().numpy() - image).max() < 2e-6
    assert drawn.screen.radii.tolist() == radii.tolist()


@pytest.mark.parametrize("name", NAMES)
def test_the_published_footprint_is_smaller_than_the_default_footprint(name):
    """A round Gaussian reaches one more tile with 3.3 standard deviations than with 3."""
    scale = torch.full((1, 3), 0.0643)  # 3.9 pixels, dilated
    facing = sample_camera().world_to_camera[2, :3].float()
    mean = (sample_camera().center.float() + facing)[None]
    of = Gaussians(mean, torch.tensor([[1.0, 0, 0, 0]]), scale, torch.ones(1), torch.ones(1, 3))
    whole, cut = (rendered(name, of, footprint) for footprint in ("alpha", "3-sigma"))
    lost = (whole.image - cut.image).detach()
    # The square spans columns 23.5 to 47.5 and rows 7.5 to 31.5: the tiles up to 48 and 32.
    assert 0 < float(lost.max()) < 0.02
    assert not lost[:32, 16:48].any()
    assert lost[32:].any() and lost[:, 48:].any()
    assert (int(whole.screen.radii), int(cut.screen.radii)) == (13, 12)


def gradients(name, of):
    drawn = rendered(name, of)
    weights = torch.linspace(-1, 1, drawn.image.numel()).view_as(drawn.image).to(drawn.image)
    (drawn.image * weights).sum().backward()
    return drawn.screen.mean_gradient.double()


def test_the_backward_pass_uses_the_pixels_of_the_forward_pass():
    one, other = (gradients(name, gaussians(5)) for name in NAMES)
    assert float((one - other).norm() / one.norm()) < 1e-5


@pytest.mark.parametrize("name", NAMES)
def test_a_gaussian_too_transparent_to_render_counts_as_visible(name):
    of = gaussians(1)
    faint = replace(of, opacities=torch.full_like(of.opacities, 1e-4))
    radii = rendered(name, of).screen.radii
    assert rendered(name, faint).screen.radii.tolist() == radii.tolist()
    assert not rendered(name, faint).image.any() and radii.any()


def options_of(**settings):
    scene = replace(sample_scene(), similarity=replace(sample_scene().similarity, scale=0.01))
    config = RunConfig.model_validate({"steps": 5, "device": "cpu", **settings})
    config, *_ = with_decisions(config, scene)
    selection, _ = selecting.select(config, scene, "none")
    return selection.rasterizer


def test_the_published_recipe_sets_the_published_footprint_and_near_plane():
    published = options_of(recipe={"name": "published"})
    assert published.footprint == "3-sigma"
    assert published.near == pytest.approx(0.2 * 0.01)
    assert (published.max_alpha, published.dilation) == (0.99, 0.3)
    default = options_of()
    assert (default.footprint, default.near) == ("alpha", 1e-3)


def test_settings_of_the_user_override_the_published_recipe():
    chosen = {"name": "torch", "footprint": "alpha", "near": 0.5}
    assert options_of(recipe={"name": "published"}, rasterizer=chosen).footprint == "alpha"
    assert options_of(recipe={"name": "published"}, rasterizer=chosen).near == 0.5


def test_a_rasterizer_without_the_published_footprint_is_refused_with_a_remedy(monkeypatch):
    class Common(Rasterizer):
        def render(self, gaussians, camera, background, outputs=frozenset()):
            raise NotImplementedError

    monkeypatch.setattr(selecting, "load", lambda slot, name: Common)
    with pytest.raises(UserError) as caught:
        options_of(recipe={"name": "published"})
    assert "has no option footprint" in str(caught.value)
    assert "leave --rasterizer out" in str(caught.value)
