"""The memory guard counts what a step keeps; systems that do not tell their memory do no harm."""

import gc
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.component import hookimpl
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.results.metrics_csv import Totals
from crossgrad_core.run.results.summary import cost_line
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training import growth_budget, memory, step
from crossgrad_core.training.memory import Demand, available_bytes, peak_mebibytes
from crossgrad_core.training.start import first_state

pytestmark = pytest.mark.usefixtures("few_objects")

CPU = torch.device("cpu")
GIB = 2**30


@pytest.mark.parametrize(
    ("kind", "copies"),
    [
        ({"views": 1}, 10),
        ({"views": 2}, 11),  # the sum so far, and the newest view's
        ({"views": 8}, 11),
        ({"views": 1, "separate": True}, 10),
        ({"views": 8, "separate": True}, 17),
        ({"views": 8, "separate": True, "watched": True}, 18),
        ({"views": 1, "joint": True}, 10),
        ({"views": 1, "copies": 3}, 13),
        ({"views": 4, "joint": True}, 6 + 2 + 4 * 3),  # four graphs instead of an edit
    ],
)
def test_the_peak_memory_counts_copies_of_the_parameters(kind, copies):
    assert Demand(parameters=236, kept=0, **kind).bytes == copies * 236


def test_decoded_tensors_count_if_they_exceed_the_parameters():
    assert Demand(parameters=100, kept=800, views=4).bytes == 8 * 100 + 800 + 3 * 200


class Look:
    """Notes what is alive when gradients are combined, and in density control how much room."""

    def __init__(self):
        self.alive, self.left, self.room, self.demand = 0, 0, 0, None
        self.shape = None

    @hookimpl(wrapper=True)
    def crossgrad_aggregate_gradients(self, context):
        self.alive = self._alive()
        return (yield)

    @hookimpl(wrapper=True)
    def crossgrad_densify(self, context):
        self.shape = context.parameters["quats"].shape
        self.left, self.room = self._alive(), context.room
        return (yield)

    def _alive(self):
        kinds = (torch.Tensor, torch.nn.Parameter)
        found = (each for each in gc.get_objects() if type(each) in kinds)
        shaped = (each for each in found if not each.is_sparse and each.shape == self.shape)
        return len({each.untyped_storage().data_ptr() for each in shaped})


def looked(monkeypatch, available=GIB, **settings):
    """What a step sees in which density control may edit."""
    monkeypatch.setattr(memory, "available_bytes", lambda _: available)
    demands = []
    room_for = memory.room_for_primitives
    monkeypatch.setattr(
        growth_budget,
        "room_for_primitives",
        lambda d, demand: demands.append(demand) or room_for(d, demand),
    )
    times = {"densify_from": 1, "densify_until": 9, "densify_every": 2, "schedule_unit": "steps"}
    given = {"steps": 9, **times, "sh_from": 3}
    setup = assemble(RunConfig.model_validate({**given, **settings}), sample_scene(), "none")
    look = Look()
    setup = replace(setup, manager=make_manager({**setup.plugins, "look": look}))
    state = first_state(setup)
    step.take_step(setup, state)
    gc.collect()
    step.take_step(setup, state)
    (look.demand,) = demands
    return look


#: The parameter and two moments.
OTHERS = 3


@pytest.mark.sampled(1)
@pytest.mark.parametrize("views", [2, 5])
def test_all_stored_gradients_are_counted(monkeypatch, views):
    look = looked(monkeypatch, views=views, operator={"name": "pcgrad"})
    assert look.demand.gradients == views <= look.alive - OTHERS <= views + 1


def test_a_sum_stores_no_gradient_of_a_single_view(monkeypatch):
    look = looked(monkeypatch, views=5)
    assert look.alive - OTHERS <= look.demand.gradients == 2


@pytest.mark.sampled(1)
@pytest.mark.parametrize("operator", ["sum", "pcgrad"])
def test_no_gradient_is_alive_during_an_edit(monkeypatch, operator):
    assert looked(monkeypatch, views=2, operator={"name": operator}).left == OTHERS


@pytest.mark.slow
def test_more_views_leave_less_free_memory(monkeypatch):
    operator = {"name": "pcgrad"}
    few, many = (looked(monkeypatch, views=k, operator=operator) for k in (2, 8))
    joint = looked(monkeypatch, views=8, backward="joint")
    assert few.room == GIB // 2 // few.demand.bytes
    assert few.room > 1.4 * many.room > 1.4 * joint.room
    assert many.demand.kept == pytest.approx(4 * few.demand.kept, rel=0.3)


def test_memory_is_not_shown_on_systems_without_this_information(monkeypatch):
    monkeypatch.setitem(sys.modules, "resource", None)  # as on Windows
    assert peak_mebibytes(CPU) is None
    line = cost_line(Totals(1, 2, 3, 4.0, 5, peak_mebibytes(CPU), 0.5))
    assert "5 primitives" in line and "memory" not in line


@pytest.mark.slow
def test_no_module_requires_a_module_that_only_some_systems_have():
    absent = "import sys; sys.modules.update(dict.fromkeys(['resource', 'fcntl', 'termios']))\n"
    ours = "import crossgrad_core.run.app, crossgrad_core.run.postprocess.evaluate\n"
    ours += "import crossgrad_plugins.diagnostics.app"
    subprocess.run([sys.executable, "-c", absent + ours], check=True, timeout=100)


def test_memory_reserved_by_torch_counts_as_available(monkeypatch):
    for name, answer in {
        "mem_get_info": (3000, 8000),
        "memory_reserved": 4000,
        "memory_allocated": 1500,
    }.items():
        monkeypatch.setattr(torch.cuda, name, lambda _device, answer=answer: answer)
    assert available_bytes(torch.device("cuda")) == 5500


def test_the_available_memory_of_this_machine_is_found():
    available = available_bytes(CPU)
    assert available is None or available > 0
