"""Primitives lie along a curve in memory, from the first step on and after each edit."""

import pytest
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import Block, Edit, LearningRate, PluginState
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training import step
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_core.training.step import along_curve, apply_edit, in_order, ordered, put_in_order

BLOCKS = (
    Block("means", ("means",), True, "geometry", LearningRate(0.1)),
    Block("codes", ("codes",), True, "neutral", LearningRate(0.1)),
    Block("shared", ("shared",), False, "neutral", LearningRate(0.1)),
)


@pytest.fixture(autouse=True)
def few_are_many(monkeypatch):
    monkeypatch.setattr(step, "FEWEST_SORTED", 2)


def code(position):
    """Morton's code, bit by bit."""
    cells = [min(max(int(x * 2**13 + 2**20), 0), 2**21 - 1) for x in position]
    return sum(((cells[a] >> b) & 1) << (3 * b + a) for b in range(21) for a in range(3))


def random_parameters(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=generator) * 3
    return {"means": means, "codes": torch.arange(float(count)), "shared": torch.ones(2)}


def test_primitives_are_sorted_in_morton_order():
    positions = torch.cat([torch.randn(500, 3), torch.randn(50, 3) * 1e3, torch.zeros(2, 3)])
    rows = along_curve(positions)
    assert rows.tolist() == sorted(range(552), key=lambda i: (code(positions[i].tolist()), i))


@pytest.mark.parametrize(
    ("far", "place"), [(torch.nan, 0), (-torch.inf, 0), (torch.inf, 2), (1e38, 2)]
)
def test_positions_without_a_cell_are_sorted_to_the_start_or_the_end(far, place):
    """A position is first if x is NaN or below all cells, and last if x is above all cells."""
    positions = torch.tensor([[0.0, 0.0, 0.0], [far, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert along_curve(positions).tolist().index(1) == place


def test_neighbouring_primitives_become_neighbours_in_memory():
    means = random_parameters(4000)["means"]
    apart = (means[1:] - means[:-1]).norm(dim=1).median()
    means = means[along_curve(means)]
    assert (means[1:] - means[:-1]).norm(dim=1).median() < 0.2 * apart


def test_all_rows_are_reordered_together_and_shared_tensors_are_unchanged():
    parameters = random_parameters(50)
    found = ordered(parameters, BLOCKS, "means")
    rows = found["codes"].long()
    assert torch.equal(rows, along_curve(parameters["means"]))
    assert torch.equal(found["means"], parameters["means"][rows])
    assert found["shared"] is parameters["shared"]


@pytest.mark.parametrize("name", ["", "places", "shared"])
def test_parameters_without_a_tensor_of_positions_are_not_reordered(name):
    parameters = random_parameters(5)
    assert in_order(parameters, BLOCKS, name) is None
    assert ordered(parameters, BLOCKS, name) is parameters


@pytest.mark.parametrize("backbone", ["vanilla", "mip", "scaffold", "octree"])
def test_a_step_with_an_edit_reorders_all_rows_together(backbone, monkeypatch):
    """The edit reverses the order. Moments and plugin rows stay with their primitives."""
    config = RunConfig.model_validate({"steps": 10, "backbone": {"name": backbone}})
    setup = assemble(config, sample_scene(), "none")
    state = first_state(setup)
    name = setup.backbone.positions
    count = len(state.parameters[name])
    assert torch.equal(along_curve(state.parameters[name]), torch.arange(count))
    marks = torch.arange(float(count))
    state.states["mine"] = PluginState(per_primitive={"marks": marks})
    for moments in (state.moments.exp_avg, state.moments.exp_avg_sq):
        moments[name] = marks[:, None].repeat(1, 3)
    before = state.parameters[name].detach().clone()
    assert apply_edit(setup, state, Edit(source=torch.arange(count - 1, -1, -1)))
    assert torch.equal(state.parameters[name], before.flip(0))
    put_in_order(setup, state)
    assert torch.equal(state.parameters[name], before)
    found = state.states["mine"].per_primitive["marks"]
    assert torch.equal(before[found.long()], before)
    assert torch.equal(state.moments.exp_avg[name][:, 0], found)
    assert torch.equal(state.moments.exp_avg_sq[name][:, 2], found)


def test_gaussians_are_in_morton_order_after_each_edit_of_a_run():
    given = {"steps": 60, "densify_from": 5, "densify_every": 5, "densify_until": 50}
    setup = assemble(
        RunConfig.model_validate({**given, "schedule_unit": "steps"}), sample_scene(), "none"
    )
    state = first_state(setup)
    last, edits = len(state.parameters["means"]), 0
    for _ in range(60):
        timed_step(setup, state)
        means = state.parameters["means"]
        if len(means) != last:
            assert torch.equal(along_curve(means), torch.arange(len(means)))
            last, edits = len(means), edits + 1
    assert edits > 2


def test_a_small_number_of_rows_is_not_sorted(monkeypatch):
    monkeypatch.setattr(step, "FEWEST_SORTED", 51)
    parameters = random_parameters(50)
    assert in_order(parameters, BLOCKS, "means") is None
    assert in_order(random_parameters(51), BLOCKS, "means") is not None
