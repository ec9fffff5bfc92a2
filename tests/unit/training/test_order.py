"""Primitives lie along a curve in memory, from the first step on and after each edit."""

import pytest
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import Block, LearningRate
from crossgrad_core.contract.topology import Edit, Rows, apply_to_parameters
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training import order
from crossgrad_core.training.edits import apply_edit
from crossgrad_core.training.order import along_curve, ordered, ordered_edit
from crossgrad_core.training.start import first_state

BLOCKS = (
    Block("means", ("means",), True, "geometry", LearningRate(0.1)),
    Block("codes", ("codes",), True, "neutral", LearningRate(0.1)),
    Block("shared", ("shared",), False, "neutral", LearningRate(0.1)),
)


@pytest.fixture(autouse=True)
def few_are_many(monkeypatch):
    monkeypatch.setattr(order, "FEWEST", 2)


def code(position):
    """Morton's code, bit by bit."""
    cells = [min(max(int(x * 2**13 + 2**20), 0), 2**21 - 1) for x in position]
    return sum(((cells[a] >> b) & 1) << (3 * b + a) for b in range(21) for a in range(3))


def random_parameters(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=generator) * 3
    return {"means": means, "codes": torch.arange(float(count)), "shared": torch.ones(2)}


def test_it_is_mortons_order_bit_by_bit():
    positions = torch.cat([torch.randn(500, 3), torch.randn(50, 3) * 1e3, torch.zeros(2, 3)])
    rows = along_curve(positions)
    assert rows.tolist() == sorted(range(552), key=lambda i: (code(positions[i].tolist()), i))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e38])
def test_positions_without_a_cell_are_put_somewhere(bad):
    positions = torch.tensor([[0.0, 0.0, 0.0], [bad, 0.0, 0.0], [1.0, 1.0, 1.0]])
    assert along_curve(positions).sort().values.tolist() == [0, 1, 2]


def test_neighbours_come_to_lie_side_by_side():
    means = random_parameters(4000)["means"]
    apart = (means[1:] - means[:-1]).norm(dim=1).median()
    means = means[along_curve(means)]
    assert (means[1:] - means[:-1]).norm(dim=1).median() < 0.2 * apart


def test_an_edit_means_the_same_in_another_order():
    parameters = ordered(random_parameters(50), BLOCKS, "means")
    assert parameters["shared"].shape == (2,)
    moved, codes = torch.randn(4, 3) * 3, torch.arange(100.0, 160.0)
    edit = Edit(
        source=torch.cat([torch.arange(50), torch.arange(10)]),
        fresh=torch.arange(60) >= 50,
        values={
            "means": Rows(moved, torch.tensor([3, 9, 55, 59]), keep_moments=True),
            "codes": Rows(codes),
        },
        counts={"cloned": 10},
    )
    other = ordered_edit(edit, parameters, BLOCKS, "means")
    plain = apply_to_parameters(edit, BLOCKS, parameters)
    found = apply_to_parameters(other, BLOCKS, parameters)
    rows = along_curve(plain["means"])
    assert torch.equal(found["means"], plain["means"][rows])
    assert torch.equal(found["codes"], plain["codes"][rows])
    assert torch.equal(other.fresh, edit.fresh[rows]) and other.counts == edit.counts
    assert other.values["means"].keep_moments and not torch.equal(rows, torch.arange(60))


def test_an_edit_of_values_and_a_backbone_without_positions_stay_as_they_are():
    parameters = random_parameters(5)
    edit = Edit(values={"means": Rows(torch.zeros(5, 3))})
    assert ordered_edit(edit, parameters, BLOCKS, "means") is edit
    edit = Edit(source=torch.tensor([4, 0]))
    for name in ("places", "shared", "codes"):
        assert ordered_edit(edit, parameters, BLOCKS, name) is edit
        assert ordered(parameters, BLOCKS, name) is parameters


@pytest.mark.parametrize("backbone", ["vanilla", "mip", "scaffold", "octree"])
def test_a_run_keeps_the_order(backbone):
    config = RunConfig.model_validate({"steps": 10, "backbone": {"name": backbone}})
    setup = assemble(config, sample_scene(), "none")
    state = first_state(setup)
    name = setup.backbone.positions
    for source in (None, torch.tensor([7, 1, 30, 3, 12, 0])):
        if source is not None:
            assert apply_edit(setup, state, Edit(source=source))
        positions = state.parameters[name]
        assert torch.equal(along_curve(positions), torch.arange(len(positions)))


def test_few_stay_in_their_order(monkeypatch):
    monkeypatch.setattr(order, "FEWEST", 51)
    parameters = random_parameters(50)
    assert ordered(parameters, BLOCKS, "means") is parameters
    edit = Edit(source=torch.arange(50))
    assert ordered_edit(edit, parameters, BLOCKS, "means") is edit
    edit = Edit(source=torch.arange(51) % 50)
    assert ordered_edit(edit, parameters, BLOCKS, "means") is not edit
