"""The gate in front of another densifier: what several views do not ask for does not grow."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from crossgrad_backbones.anchors.growth.anchor_base import GrowthRequest
from crossgrad_backbones.anchors.growth.control import AnchorControl
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.blocks import Edit, PluginState
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.resolve import resolved
from crossgrad_core.run.unused_settings import refuse_settings_for_nothing
from crossgrad_core.testing.backbones import created
from crossgrad_core.testing.densifiers import DensifierRun
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_plugins.densifiers.adc import AdaptiveDensityControl
from crossgrad_plugins.densifiers.multiview_gate import MultiViewGate

SCAFFOLD = {"name": "scaffold", "voxel_size": 1e-5}
OCTREE = {"name": "octree", "middle_cell": 1e-5}
ANCHOR = {"name": "anchor", "success_threshold": 0, "coarsest": 1, "grad_threshold": 1e-9}
LEVELS = {"name": "octree", "success_threshold": 0, "grad_threshold": 1e-9}
ADC = {"name": "adc", "grad_threshold": 1e-9}


def run_of(backbone, of, views=2, steps=7, **options):
    config = RunConfig(
        steps=60, schedule_unit="steps", densify_from=1, densify_until=30, densify_every=3,
        sampler=ComponentChoice(name="random"), views_per_step=views,
        backbone=ComponentChoice(**backbone),
        densifier=ComponentChoice(name="multiview-gate", of=of, **options),
    )  # fmt: skip
    state = first_state(setup := assemble(config, sample_scene(), "none"))
    records = [timed_step(setup, state) for _ in range(steps)]
    grown = sum(r.counts.get(k, 0) for r in records for k in ("cloned", "split", "grown"))
    return setup, state, grown


OTHERS = [({"name": "vanilla"}, ADC), (SCAFFOLD, ANCHOR), (OCTREE, LEVELS)]
#: Every two of a K, a way to count and a backbone meet.
RUNS = [
    (*other, ("render", "running")[(place + views) % 2], views)
    for place, other in enumerate(OTHERS)
    for views in (1, 2, 3)
]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("backbone", "of", "count", "views"), RUNS)
def test_no_gaussian_grows_with_a_closed_gate_and_many_grow_with_an_open_gate(
    backbone, of, count, views
):
    _, _, closed = run_of(backbone, of, views, count=count, importance=1e9)
    _, _, opened = run_of(backbone, of, views, count=count, importance=0)
    assert closed == 0 < opened


@pytest.mark.parametrize("count", ["render", "running"])
def test_the_gate_passes_growth_that_several_views_request(count):
    other = AdaptiveDensityControl(grad_threshold=1e-9)
    run = DensifierRun.of(MultiViewGate(of=other, count=count, share=1.0))
    for step in range(596, 600):
        run.take_step(step)

    def context():
        return replace(run.context(600), rng=np.random.default_rng(3))

    own, inner = (
        {n.removeprefix("gate/"): t for n, t in run.state.per_primitive.items() if n[:5] in names}
        for names in ({"gate/"}, {"gradi", "rende"})
    )
    gate = run.densifier
    seen = gate.importance_of(gate.counted(context(), PluginState(per_primitive=own)))
    middle = float(seen.marked.median().floor())
    edit, _ = gate.model_copy(update={"importance": middle}).densify(context(), run.state)
    allowed = set((seen.marked[:, 0].floor() > middle).nonzero().squeeze(1).tolist())
    free, _ = other.densify(context(), PluginState(per_primitive=inner))
    assert 0 < len(allowed) < run.primitives
    assert grown(edit) == grown(free) & allowed
    assert 0 < len(grown(edit)) < len(grown(free))


def grown(edit):
    return set(edit.source[edit.fresh].tolist())


def test_an_anchor_grows_only_if_the_gate_allows_growth():
    backbone = build("backbones", "scaffold", {"voxel_size": 1e-5})
    options = {name: value for name, value in ANCHOR.items() if name != "name"}
    parameters = created(backbone)
    with torch.no_grad():
        parameters["offsets"].normal_(generator=torch.Generator().manual_seed(0))
    run = DensifierRun(AnchorControl(**options), backbone, parameters)
    for step in range(596, 600):
        run.take_step(step)
    context = replace(run.context(600), rng=np.random.default_rng(3))
    may_grow = torch.arange(run.primitives) % 3 == 0
    edit, state = run.densifier.densify(replace(context, may_grow=may_grow), run.state)
    free, whole = run.densifier.densify(replace(context, rng=np.random.default_rng(3)), run.state)
    assert may_grow[edit.source[edit.fresh]].all()
    assert 0 < int(edit.fresh.sum()) < int(free.fresh.sum())
    # What was judged starts anew, whether or not it may grow.
    for name, rows in whole.per_primitive.items():
        assert torch.equal(state.per_primitive[name], rows)


def test_a_growth_request_excludes_rows_that_may_not_grow():
    request = GrowthRequest(torch.ones(3, 2), torch.ones(3, 2, dtype=torch.bool))
    assert request.among(None) is request
    allowed = request.among(torch.tensor([True, False, True])).eligible
    assert allowed.tolist() == [[True, True], [False, False], [True, True]]


@pytest.mark.parametrize("name", ["mcmc", "none", "multiview", "multiview-gate"])
def test_a_densifier_that_cannot_be_nested_is_refused_in_the_gate(name):
    with pytest.raises(UserError) as refused:
        build("densifiers", "multiview-gate", {"of": name})
    assert "cannot be used inside another densifier" in str(refused.value)


@pytest.mark.parametrize(
    "of", ["adx", {"name": "adc", "grad_threshold": -1}, {"grad_threshold": 1}, 3]
)
def test_a_value_that_is_not_a_densifier_is_refused_in_the_gate(of):
    with pytest.raises(UserError):
        build("densifiers", "multiview-gate", {"of": of})


def test_the_options_of_the_inner_densifier_are_kept_in_the_configuration():
    setup, _, _ = run_of(SCAFFOLD, {"name": "anchor", "levels": 2}, steps=1)
    choice = resolved(setup).densifier
    assert choice.options["of"] == {"name": "anchor", "levels": 2}
    again = build("densifiers", choice.name, choice.options)
    assert again == setup.densifier
    assert again.tensors == AnchorControl.tensors and not again.resets
    assert again.needs == {"count"}
    assert MultiViewGate(of="absgrad").needs == {"count", "abs_gradient"}


def test_options_without_an_effect_are_refused():
    for options, named in (
        ({"share": 0.5}, "densifier.share"),
        ({"count": "running", "views": 3}, "densifier.views"),
        ({"of": {"name": "absgrad", "criterion": "gsplat", "abs_threshold": 1}}, "densifier.of"),
    ):
        choice = ComponentChoice(name="multiview-gate", **options)
        config = RunConfig(steps=10, densifier=choice)
        setup = assemble(config, sample_scene(), "none")
        with pytest.raises(UserError) as refused:
            refuse_settings_for_nothing(config, setup)
        assert refused.value.where == named


class Heedless(AdaptiveDensityControl):
    """Grows whatever there is."""

    def densify(self, context, state):
        if not context.schedule.densifies(context.step):
            return super().densify(context, state)
        rows = torch.arange(context.parameters["means"].shape[0])
        source = torch.cat([rows, rows])
        return Edit(source, torch.arange(len(source)) >= len(rows)), state


def test_a_densifier_that_ignores_the_gate_is_reported():
    run = DensifierRun.of(MultiViewGate(of=Heedless(), importance=1e9))
    run.take_step(599)
    with pytest.raises(UserError, match="grew Gaussians that the gate"):
        run.take_step(600)
