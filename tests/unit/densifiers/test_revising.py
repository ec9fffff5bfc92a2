"""Revising Densification against its rules; shares of the error pixel by pixel."""

from dataclasses import replace
from math import log, sqrt
from time import sleep

import mpmath as mp
import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from support.brute_force import trace

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.blocks import (
    EMPTY_STATE,
    NO_EDIT,
    apply_to_moment,
    apply_to_parameters,
)
from crossgrad_core.contract.contexts import DensifyContext
from crossgrad_core.contract.schedule import Phase, Schedule
from crossgrad_core.registry.entries import build
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import HEIGHT, WIDTH, sample_scene, step_fields
from crossgrad_core.testing.support.renders import renders_of
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_plugins.densifiers.revising import (
    RevisingDensification,
    halved_logits,
    largest_shares,
    lowered_logits,
    pixel_error,
    spread_views,
)

VIEWS = len(sample_scene().train)


class Bright(Vanilla):
    """Vanilla with colours given as RGB, and every other primitive drawn by two Gaussians."""

    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        number = len(gaussians)
        origin = torch.cat([torch.arange(number), torch.arange(0, number, 2)])
        rows = gaussians.mapped(lambda tensor: tensor[origin])
        colors = torch.sigmoid(rows.sh_dc[:, 0])
        return replace(rows, colors=colors, sh_dc=None, sh_rest=None, sh_degree=0, origin=origin)


def scene_of(mask=None):
    """The sample scene; with `mask`, every photo has it."""
    scene = sample_scene()
    if mask is None:
        return scene

    class Masked:
        def __init__(self, photo):
            self.image = photo.image

        def mask(self):
            return mask

    views = tuple(replace(view, photo=Masked(view.photo)) for view in scene.views)
    return replace(scene, views=views)


def context(*, backbone=None, step=600, room=10**6, rasterizer="torch", mask=None):
    backbone = backbone or Vanilla()
    params = backbone.create(sample_scene(), np.random.default_rng(0))
    rng = np.random.default_rng(2)
    with torch.no_grad():
        params["scales"] += torch.from_numpy(rng.normal(1.0, 0.5, (40, 3))).float()
        params["opacities"][:] = torch.from_numpy(rng.normal(0.0, 2.0, 40)).float()
    fields = {**step_fields(step), "scene": scene_of(mask)}
    rasterizer = build("rasterizers", rasterizer, {})
    phase = Phase(step, training=True, schedule=fields["schedule"])
    return DensifyContext(
        **fields,
        parameters=params,
        backbone=backbone,
        rasterizer=rasterizer,
        render=renders_of(fields["scene"], phase, backbone, rasterizer, params),
        views=(),
        means_lr=1e-4,
        room=room,
    )


def error_of(image, photo, kind, mask=None):
    """[H, W] by scikit-image: zero borders are written out, since it knows none."""
    image, photo = image.astype(float), photo.astype(float) / 255
    if mask is not None:
        image, photo = image * mask[..., None], photo * mask[..., None]
    if kind == "l1":
        return np.abs(image - photo).mean(-1)
    wide = [np.pad(each, ((8, 8), (8, 8), (0, 0))) for each in (image, photo)]
    _, ssim = structural_similarity(
        *wide, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        data_range=1.0, channel_axis=-1, full=True,
    )  # fmt: skip
    error = 1 - ssim[8:-8, 8:-8].mean(-1)
    return error if mask is None else error * mask


def share_of(ctx, index, kind, mask=None):
    """[P] by compositing one Gaussian after the other."""
    view = ctx.scene.train_views[index]
    phase = Phase(ctx.step, training=True, schedule=ctx.schedule)
    gaussians = ctx.backbone.decode(ctx.parameters, view.camera, phase)
    drawn = trace(gaussians, view.camera)
    pose = view.camera.world_to_camera.numpy()
    depths = gaussians.means.detach().double().numpy() @ pose[2, :3] + pose[2, 3]
    error = error_of(drawn.image, view.photo.image().numpy(), kind, mask)
    transmittance = np.ones((HEIGHT, WIDTH))
    shares = np.zeros(ctx.parameters["means"].shape[0])
    for i in np.argsort(depths, kind="stable"):
        alpha = np.where(drawn.blended[i], np.minimum(drawn.raw[i], 0.99), 0.0)
        owner = i if gaussians.origin is None else gaussians.origin[i]
        shares[owner] += (alpha * transmittance * error).sum()
        transmittance = transmittance * (1 - alpha)
    return shares


@pytest.mark.parametrize("kind", ["ssim", "l1"])
@pytest.mark.parametrize("backbone", [Vanilla(), Bright()], ids=["harmonics", "two per primitive"])
@pytest.mark.parametrize("rasterizer", ["torch", "numba"])
def test_the_error_share_of_a_gaussian_is_its_largest_share_over_the_sampled_views(
    kind, backbone, rasterizer
):
    ctx = context(backbone=backbone, rasterizer=rasterizer)
    expected = np.max([share_of(ctx, index, kind) for index in (0, 3, 7)], axis=0)
    assert (expected > 0).sum() > 20
    found = largest_shares(ctx, (0, 3, 7), kind)
    assert found.numpy() == pytest.approx(expected, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("kind", ["ssim", "l1"])
def test_error_shares_ignore_masked_pixels(kind):
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[4:12, 5:20] = True
    ctx = context(mask=mask)
    found = largest_shares(ctx, (2,), kind)
    assert found.numpy() == pytest.approx(share_of(ctx, 2, kind, mask.numpy()), rel=1e-3, abs=1e-4)
    image = torch.full((HEIGHT, WIDTH, 3), torch.nan)
    image[mask] = 0.5
    photo = ctx.scene.train_views[0].photo
    error = pixel_error(image, (photo.image(), photo.mask()), kind)
    assert error[~mask].eq(0).all()


@pytest.mark.parametrize(("number", "most"), [(5, 32), (32, 32), (33, 32), (1000, 32), (7, 1)])
def test_sampled_views_are_spread_evenly_over_the_photos(number, most):
    drawn = [spread_views(number, most, np.random.default_rng(seed)) for seed in range(50)]
    for views in drawn:
        assert len(set(views)) == len(views) == min(number, most)
        assert views == sorted(views) and views[-1] < number
        for place, view in enumerate(views):
            assert abs(view - number * (place + 0.5) / len(views)) <= number / len(views) / 2 + 1
    if number < 40:  # Every view is drawn at times.
        assert {view for views in drawn for view in views} == set(range(number))


def edit_of(ctx, **options):
    return RevisingDensification(**options).densify(ctx, EMPTY_STATE)[0]


def test_the_largest_error_shares_grow_within_the_growth_limit():
    ctx = context()
    shares = np.max([share_of(ctx, index, "ssim") for index in range(VIEWS)], axis=0)
    edit = edit_of(ctx, growth_budget=0.2, prune_opacity=0.0)
    grown = {i for i in range(40) if edit.source.tolist().count(i) == 2}
    assert grown == set(np.argsort(-shares)[:8].tolist())
    assert edit.source.shape[0] == 48
    assert edit.counts["cloned"] + edit.counts["split"] == 8
    threshold = float(np.sort(shares)[-4:-2].mean())
    few = edit_of(ctx, growth_budget=0.2, prune_opacity=0.0, error_threshold=threshold)
    assert few.source.shape[0] == 43


def test_the_primitive_limit_overrides_the_growth_limit():
    edit = edit_of(context(room=3), growth_budget=0.2, prune_opacity=0.0)
    assert edit.source.shape[0] == 43
    assert edit.counts["held_back"] == 5


def test_clones_and_children_share_their_opacity_and_all_opacities_decrease_a_little():
    ctx = context()
    middle = torch.exp(ctx.parameters["scales"].detach()).amax(1).median().item()
    edit = edit_of(ctx, growth_budget=0.5, prune_opacity=0.0, split_scale=middle)
    assert edit.counts["cloned"] > 2 and edit.counts["split"] > 2
    new = apply_to_parameters(edit, Vanilla().blocks(), ctx.parameters)
    opacities = torch.sigmoid(ctx.parameters["opacities"].detach().double()).numpy()
    source = edit.source.tolist()
    for i, origin in enumerate(source):
        shared = source.count(origin) == 2
        before = 1 - sqrt(1 - opacities[origin]) if shared else opacities[origin]
        expected = min(before, max(before - 0.001, 1e-6))
        assert torch.sigmoid(new["opacities"][i]).item() == pytest.approx(expected, rel=1e-4)
    # The decrease is no new start: moments of old rows stay, those of new ones are zero.
    moment = apply_to_moment(edit, "opacities", torch.ones(40))
    assert torch.equal(moment == 0, edit.fresh)


@pytest.mark.parametrize("logit", [-1e4, -200.0, -90.0, -16.0, -15.0, -1.0, 0.0, 5.0, 40.0, 1e4])
def test_halved_opacities_agree_with_a_high_precision_computation(logit):
    with mp.workdps(200):
        transparent = mp.sqrt(1 / (1 + mp.exp(mp.mpf(max(min(logit, 1e3), -1e3)))))
        if abs(logit) < 1e3:
            expected = float(mp.log((1 - transparent) / transparent))
        else:
            # o / 2 at one end, (1 - o) to the power 1/2 at the other.
            expected = logit - log(2) if logit < 0 else logit / 2
    found = halved_logits(torch.tensor([logit])).item()
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_decreased_opacities_are_finite_and_none_increases():
    logits = torch.tensor([-1e4, -20.0, -7.0, -6.0, 0.0, 20.0, 1e4])
    lowered = lowered_logits(logits, 0.001)
    assert lowered.isfinite().all() and (lowered <= logits).all()
    assert torch.sigmoid(lowered)[[4, 6]].tolist() == pytest.approx([0.499, 0.999])


@pytest.mark.parametrize(("mode", "total"), [("scaled", 30_000), ("absolute", 7_000)])
def test_density_control_ends_at_step_27_000_without_opacity_resets(mode, total):
    schedule = Schedule.for_run(total, mode)
    window = RevisingDensification().window(schedule)
    assert (window.densify_from, window.densify_until) == (500, 27_000)
    assert window.reset_every is None
    resetting = RevisingDensification(opacity_decrease=0).window(schedule)
    assert resetting.reset_every == schedule.reset_every is not None


def test_with_resets_opacities_do_not_decrease_between_the_resets():
    ctx = context(step=600)
    edit = edit_of(ctx, opacity_decrease=0, growth_budget=0.01, prune_opacity=0.0)
    assert edit.source is None and not edit.values


def test_nothing_changes_between_edits():
    assert edit_of(context(step=601)) == NO_EDIT
    window = RevisingDensification().window(Schedule.for_run(30_000))
    last, over = (replace(context(step=step), schedule=window) for step in (26_900, 27_000))
    assert edit_of(last) != NO_EDIT and edit_of(over) == NO_EDIT


def test_a_run_grows_in_every_second_step_and_stays_finite():
    config = RunConfig(
        steps=10, densify_from=1, densify_until=9, densify_every=2, schedule_unit="steps",
        densifier=ComponentChoice(name="revising", growth_budget=0.1, error_threshold=0.01),
    )  # fmt: skip
    state = first_state(setup := assemble(config, sample_scene(), "none"))
    records = [timed_step(setup, state) for _ in range(6)]
    grown = [record.counts.get("cloned", 0) + record.counts.get("split", 0) for record in records]
    assert [count > 0 for count in grown] == [False, True] * 3
    assert all(tensor.isfinite().all() for tensor in state.parameters.values())


class Slow:
    """A photo that takes a while to decode."""

    SECONDS = 0.05

    def __init__(self, photo):
        self.mask = photo.mask
        self._image = photo.image

    def image(self):
        sleep(self.SECONDS)
        return self._image()


@pytest.mark.slow
def test_decoding_photos_for_an_edit_counts_as_loading_time():
    scene = sample_scene()
    views = tuple(replace(view, photo=Slow(view.photo)) for view in scene.views)
    config = RunConfig(
        data={"init": "random"}, steps=30, densify_from=1, densify_until=29, densify_every=2,
        schedule_unit="steps",
        rasterizer=ComponentChoice(name="torch"), sampler=ComponentChoice(name="epoch"),
        densifier=ComponentChoice(name="revising", growth_budget=0.1, error_threshold=0.01),
    )  # fmt: skip
    state = first_state(setup := assemble(config, replace(scene, views=views), "none"))
    timed_step(setup, state)
    before = state.clock.load
    timed_step(setup, state)  # Its edit measures every training view.
    assert state.clock.load - before >= (1 + VIEWS) * Slow.SECONDS


def test_an_edit_without_growth_and_pruning_still_decreases_opacities():
    ctx = context()
    before = ctx.parameters["opacities"].detach()
    kept = RevisingDensification(error_threshold=1e9, prune_opacity=0.0)
    edit, _ = kept.densify(ctx, EMPTY_STATE)
    assert edit.source is None
    assert torch.equal(edit.values["opacities"].values, lowered_logits(before, 0.001))
