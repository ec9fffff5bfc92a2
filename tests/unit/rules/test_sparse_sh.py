"""Tensors that learn in some steps only: the rule `sparse-sh`."""

from dataclasses import replace
from typing import ClassVar

import pytest
import torch

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.component import hookimpl
from crossgrad_core.contract.contexts import RegularizeResult
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.resolve import resolved
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.rates import rates_at
from crossgrad_core.training.setup import learns_in
from crossgrad_core.training.start import first_state
from crossgrad_plugins.rasterizers import numba_cpu
from crossgrad_plugins.rasterizers.numba_cpu import NumbaRasterizer
from crossgrad_plugins.rasterizers.numba_kernels import frame

STEPS, EVERY = 12, 3
RULES = {"sparse-sh": {"every": EVERY}}


class Decay:
    """Pulls at the higher bands in every step."""

    @hookimpl
    def crossgrad_regularize(self, context):
        if context.gaussians is not None:
            return None
        return RegularizeResult(1e-3 * context.parameters["f_rest"].square().sum())


def setup_of(backbone="vanilla", **settings):
    options = {"sh_degree": 3} if backbone == "vanilla" else {}
    given = {
        "steps": STEPS,
        "sh_from": 3,
        "backbone": ComponentChoice.model_validate({"name": backbone, **options}),
        "densifier": ComponentChoice(name="none"),
        **settings,
    }
    return assemble(RunConfig(**given), sample_scene(), "none")


def changes(setup):
    """Name of each trained tensor -> the steps that changed it; and the state at the end."""
    state = first_state(setup)
    found = {name: [] for block in setup.trained_blocks for name in block.tensors}
    for step in range(1, STEPS + 1):
        before = {name: state.parameters[name].detach().clone() for name in found}
        timed_step(setup, state)
        for name, steps in found.items():
            if not torch.equal(before[name], state.parameters[name]):
                steps.append(step)
    return found, state


@pytest.mark.sampled(4)
@pytest.mark.parametrize("plugins", [(), (Decay,)], ids=["alone", "with a term"])
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"views_per_step": 2},
        {"views_per_step": 2, "operator": ComponentChoice(name="pcgrad")},
        {"views_per_step": 2, "backward": "joint"},
        {"rasterizer": ComponentChoice(name="torch")},
        {"recipe": {"name": "published"}},
        {"backbone": "mip"},
    ],
    ids=str,
)
def test_higher_bands_change_in_their_update_steps_and_other_tensors_in_every_step(
    settings, plugins
):
    setup = setup_of(rules=RULES, **settings)
    for plugin in plugins:
        setup.manager.register(plugin())
    found, state = changes(setup)
    # In the published order the last step has none of the optimizer.
    last = STEPS - ("recipe" in settings)
    due = [step for step in range(1, last + 1) if learns_in(step, EVERY)]
    assert found.pop("f_rest") == due
    assert state.adam.steps["f_rest"] == len(due)
    assert all(steps == list(range(1, last + 1)) for steps in found.values())


def test_sh_bands_without_an_update_in_a_step_get_no_gradient(monkeypatch):
    setup = setup_of(rules=RULES, views_per_step=2)
    due = [step for step in range(1, STEPS + 1) if learns_in(step, EVERY)]
    decoded, worked_out = [], []
    decode = Vanilla.decode

    def watched(self, parameters, camera, phase):
        needs = {name for name, tensor in parameters.items() if tensor.requires_grad}
        if phase.training:
            decoded.append((phase.step, "f_rest" in needs, needs - {"f_rest"}))
        return decode(self, parameters, camera, phase)

    def backward(*args, harmonics, **options):
        worked_out.append(harmonics)
        return frame.backward(*args, harmonics=harmonics, **options)

    monkeypatch.setattr(Vanilla, "decode", watched)
    monkeypatch.setattr(numba_cpu, "backward", backward)
    changes(setup)
    others = {"means", "scales", "quats", "opacities", "f_dc"}
    steps = [step for step in range(1, STEPS + 1) for _ in range(2)]
    assert decoded == [(step, step in due, others) for step in steps]
    assert worked_out == [step in due for step in steps]


class Together(NumbaRasterizer):
    """Draws the views of a step in one call."""

    together: ClassVar[bool] = True

    def render_views(self, views, backgrounds, outputs=frozenset()):
        pairs = zip(views, backgrounds, strict=True)
        return [self.render(*view, background, outputs) for view, background in pairs]


def test_views_rendered_together_give_the_same_parameters():
    apart = setup_of(rules=RULES, views_per_step=2)
    selection = replace(apart.selection, rasterizer=Together())
    ours, theirs = changes(replace(apart, selection=selection)), changes(apart)
    assert ours[0] == theirs[0]
    for name, tensor in theirs[1].parameters.items():
        torch.testing.assert_close(ours[1].parameters[name], tensor)


def test_a_run_records_the_update_interval_of_its_sh_bands():
    assert resolved(setup_of(rules=RULES)).rules["sparse-sh"] == {"every": EVERY}
    assert "sparse-sh" not in resolved(setup_of()).rules


def test_all_tensors_change_in_every_step_without_the_sparse_sh_rule():
    plain, every = setup_of(), setup_of(rules=RULES)
    assert changes(plain)[0]["f_rest"] == list(range(1, STEPS + 1))
    ours, theirs = rates_at(every, 1), rates_at(plain, 1)
    assert ours.pop("f_rest") == pytest.approx(theirs.pop("f_rest") * EVERY**0.5)
    assert ours == theirs


def test_the_sparse_sh_rule_is_not_selected_for_backbones_without_harmonics():
    setup = setup_of("scaffold", rules=RULES)
    assert not any(setup.resting(step) for step in range(1, STEPS + 1))
