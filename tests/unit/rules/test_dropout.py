"""Gaussians that training views are drawn without."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.contexts import ViewSample
from crossgrad_core.contract.slots.rule import GaussiansContext
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.load_run import from_checkpoint, to_checkpoint
from crossgrad_core.run.resolve import resolved
from crossgrad_core.scene.shown_points import photos_per_point
from crossgrad_core.testing.fixtures import posed_scene, posed_view, sample_scene
from crossgrad_core.training.rules import view_gaussians
from crossgrad_core.training.start import first_state
from crossgrad_core.training.step import take_step
from crossgrad_core.training.views import RenderCallback, context_fields, render_views
from crossgrad_plugins.recipes.auto import DROPOUT, FEW_PHOTOS


def setup_of(scene=None, **given):
    config = RunConfig.model_validate({"steps": 12, "rasterizer": {"name": "torch"}, **given})
    return assemble(config, scene or sample_scene(), "colmap")


def decoded(setup, state):
    camera = setup.train_views[0].camera
    return setup.backbone.decode(state.parameters, camera, setup.phase(1, training=True))


def dropped(setup, state, gaussians):
    """What a training view is rendered from."""
    fields = context_fields(setup, state, "regularize")
    view = setup.train_views[0]
    context = GaussiansContext(**fields, view=view, gaussians=gaussians, rngs=state.rngs)
    return view_gaussians(setup, state, context)


def with_photos(count):
    """The scene with so many training photos, all of which show its points."""
    scene = sample_scene()
    return replace(scene, train=tuple(scene.train[0] for _ in range(count)))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("share", [0.1, 0.3, 0.9])
def test_dropout_removes_a_share_of_gaussians_and_increases_the_other_opacities(share):
    setup = setup_of(rules={"dropout": {"share": share}})
    state = first_state(setup)
    whole = decoded(setup, state)
    raised, shares = (whole.opacities / (1.0 - share)).clamp(max=1.0), []
    for _ in range(200):
        part = dropped(setup, state, whole)
        left_out = part.opacities == 0.0
        torch.testing.assert_close(part.opacities[~left_out], raised[~left_out])
        shares.append(left_out.float().mean().item())
        assert part.means is whole.means
    error = 4.0 * np.sqrt(share * (1.0 - share) / (200 * len(whole)))
    assert np.mean(shares) == pytest.approx(share, abs=error)


def test_nearly_opaque_gaussians_still_get_a_gradient_under_dropout():
    """The opacity is clipped at 1, but its gradient is not."""
    setup = setup_of(rules={"dropout": {"share": 0.3}})
    state = first_state(setup)
    logits = torch.full((500,), 3.0, requires_grad=True)
    gaussians = replace(
        decoded(setup, state),
        **{name: torch.ones(500, n) for name, n in (("means", 3), ("quats", 4), ("scales", 3))},
        opacities=torch.sigmoid(logits),
    )
    part = dropped(setup, state, gaussians)
    assert set(part.opacities.tolist()) == {0.0, 1.0}
    (gradient,) = torch.autograd.grad(part.opacities.sum(), [logits])
    slope = torch.sigmoid(logits) * (1.0 - torch.sigmoid(logits)) / 0.7
    torch.testing.assert_close(gradient, torch.where(part.opacities > 0.0, slope, 0.0))


def test_a_run_without_the_dropout_rule_is_unchanged():
    setup = setup_of(rules={"dropout": False})
    state = first_state(setup)
    whole = decoded(setup, state)
    assert dropped(setup, state, whole) is whole
    assert "dropout" not in state.rngs


def test_dropped_gaussians_get_no_gradient_and_plugins_see_all_gaussians():
    setup = setup_of(rules={"dropout": {"share": 0.5}})
    state = first_state(setup)
    rendered, _ = render_views(setup, state, ViewSample((0,)), (1.0,))
    left_out = rendered.records[0].gaussians.opacities == 0.0
    assert 0 < int(left_out.sum()) < len(left_out)
    part = dropped(setup, state, decoded(setup, state))
    (gradient,) = torch.autograd.grad(part.opacities.sum(), [state.parameters["opacities"]])
    assert torch.equal(gradient == 0.0, part.opacities == 0.0)
    asked = RenderCallback(setup, state, counted=False)(0)
    assert torch.equal(asked.gaussians.opacities, decoded(setup, state).opacities)


@pytest.mark.parametrize(
    ("photos", "given", "share"),
    [
        (FEW_PHOTOS, {}, DROPOUT),
        (FEW_PHOTOS + 1, {}, 0.0),
        (FEW_PHOTOS, {"recipe": {"name": "published"}}, 0.0),
        (FEW_PHOTOS, {"rules": {"dropout": False}}, 0.0),
        (FEW_PHOTOS + 1, {"rules": {"dropout": {"share": 0.2}}}, 0.2),
        (1, {"recipe": {"name": "published"}, "rules": {"dropout": {"share": 0.2}}}, 0.2),
    ],
)
def test_dropout_is_the_default_for_scenes_with_few_photos(photos, given, share):
    setup = setup_of(with_photos(photos), **given)
    assert resolved(setup).rules.get("dropout", False) == (share > 0.0 and {"share": share})
    noted = [row for row in setup.decisions if row.setting == "rules.dropout" and row.override]
    assert len(noted) == (share > 0.0 and "rules" not in given)


def test_the_documented_dropout_default_is_correct():
    said = (Path(__file__).parents[3] / "docs" / "rules.md").read_text(encoding="utf-8")
    row = next(line for line in said.splitlines() if line.startswith("| `rules.dropout`"))
    assert f"{DROPOUT}" in row and f"{FEW_PHOTOS} training photos" in row


@pytest.mark.slow
def test_a_resumed_run_has_the_same_bits():
    setup = setup_of(rules={"dropout": {"share": 0.3}})
    whole = first_state(setup)
    for _ in range(5):
        take_step(setup, whole)
    part = from_checkpoint(setup, to_checkpoint(whole))
    for _ in range(5):
        take_step(setup, whole)
        take_step(setup, part)
    assert all(torch.equal(part.parameters[n], t) for n, t in whole.parameters.items())


def test_photos_per_point_counts_the_photos_whose_image_contains_the_point():
    points = [(0.0, 5.0, 0.0), (0.1, 5.0, 0.0), (0.0, 5.0, 0.1), (0.0, -5.0, 0.0), (90.0, 1.0, 0.0)]
    ahead = [posed_view((0, 0, 0), f"{i}.png") for i in range(3)]
    behind = [posed_view((0, 0, 0), "b.png", forward=(0, -1, 0))]
    scene = posed_scene([*ahead, *behind], points)
    # Three points lie in three photos, one in one, and one in none, which does not count.
    assert photos_per_point(scene) == 3.0
    assert photos_per_point(posed_scene(ahead)) == 0.0
