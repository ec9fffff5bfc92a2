"""Steps of Adam that rows are late with: the bits of steps that are taken at once."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import AdamRule, AdamState
from crossgrad_core.contract.component import hookimpl
from crossgrad_core.contract.contexts import RegularizeResult
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.screen_statistics import seen
from crossgrad_core.gradients.sparse_rows import coalesced, dense, rows_of, sparse_rows, values_of
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.checkpoint import Keep, latest, load, save
from crossgrad_core.run.load_run import from_checkpoint, to_checkpoint
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.adam import late
from crossgrad_core.training.adam.adam import adam_step, counted
from crossgrad_core.training.adam.late import Late
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.rngs import make_streams
from crossgrad_core.training.start import first_state
from crossgrad_core.training.state import RollbackGuard, Snapshot, TrainState
from crossgrad_operators.graddrop import GradDrop
from crossgrad_operators.projection import PCGrad
from crossgrad_operators.sum import Sum
from crossgrad_plugins.rasterizers.numba_cpu import NumbaRasterizer

SHAPES = [(15, 3), (1, 3), (), (8,), (3, 3)]


@pytest.fixture(autouse=True)
def _rows_wait(monkeypatch):
    """Whatever share of the rows is drawn: the scenes of these tests are small."""
    monkeypatch.setattr(late, "MOST_ROWS", 2.0)


class Both:
    """One tensor trained in both ways: `whole` at once, `rows` late."""

    def __init__(self, start):
        self.whole, self.rows = start.clone(), start.clone()
        self.adam, self.other, self.late = AdamState(), AdamState(), Late()

    def step(self, rows, values, lr, rule, scale=1.0):
        gradient = sparse_rows(torch.from_numpy(rows), torch.from_numpy(values), self.whole.shape)
        adam_step(
            {"x": self.whole}, {"x": dense(gradient)}, self.adam, {"x": lr}, rule, {"x": scale}
        )
        step = counted("x", self.rows, self.other, lr, rule, scale)
        self.late.step("x", self.rows, gradient, self.other, step)

    def catch_up(self, rows=None):
        chosen = None if rows is None else torch.from_numpy(rows.astype(np.int32))
        self.late.catch_up("x", self.rows, self.other, chosen)

    def same(self):
        pairs = [(self.whole, self.rows)]
        pairs += [(getattr(self.adam, k)["x"], getattr(self.other, k)["x"])
                  for k in ("exp_avg", "exp_avg_sq")]  # fmt: skip
        return self.adam.steps == self.other.steps and all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("most", [0.2, 2.0])
def test_learning_rates_beyond_single_precision_are_infinite_without_a_warning(monkeypatch, most):
    monkeypatch.setattr(late, "MOST_ROWS", most)
    both = Both(torch.zeros(10, 3))
    both.step(np.arange(4), np.ones((4, 3), np.float32), 1e300, AdamRule())
    both.catch_up()
    for found in (both.whole, both.rows):
        assert torch.equal(found[:4], torch.full((4, 3), -torch.inf))


@pytest.mark.sampled(5)
@pytest.mark.parametrize("most", [0.2, 2.0])
@pytest.mark.parametrize("seed", range(10))
def test_deferred_steps_have_the_bits_of_immediate_steps(monkeypatch, seed, most):
    monkeypatch.setattr(late, "MOST_ROWS", most)
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(1, 300)), *SHAPES[seed % len(SHAPES)])
    both = Both(
        torch.from_numpy(rng.normal(size=shape).astype(np.float32)) * 10.0 ** rng.uniform(-9, 3)
    )
    rule = AdamRule.for_views(int(rng.integers(1, 11))) if seed % 2 else AdamRule()
    size, lr = 10.0 ** rng.uniform(-25, 3), 10.0 ** rng.uniform(-6, -1)
    for step in range(120):
        share = 0.0 if rng.random() < 0.6 else rng.random() ** 3
        rows = np.flatnonzero(rng.random(shape[0]) < share)
        values = rng.normal(size=(len(rows), *shape[1:])) * size
        values *= rng.random(values.shape) < 0.8
        both.step(rows, values.astype(np.float32), lr * 0.98**step, rule, 1.0 + seed % 3)
        if step % 7 == 3:
            both.catch_up(np.flatnonzero(rng.random(shape[0]) < 0.3))
        if step % 50 == 40:
            both.catch_up()
            assert both.same()
    both.catch_up()
    assert both.same()


@pytest.fixture(scope="module")
def long_wait():
    """Rows of all sizes that one step moves and ten thousand do not see, and their oracle."""
    rng = np.random.default_rng(5)
    start = (rng.normal(size=(64, 3, 3)) * 10.0 ** rng.uniform(-8, 1, (64, 1, 1))).astype(
        np.float32
    )
    both = Both(torch.from_numpy(start))
    every, none = np.arange(64), np.zeros(0, np.int64)
    values = rng.normal(size=start.shape) * 10.0 ** rng.uniform(-12, 0, (64, 1, 1))
    rates = 1e-3 * 0.9997 ** np.arange(10_001)
    both.step(every, values.astype(np.float32), rates[0], AdamRule())
    for rate in rates[1:]:
        both.step(none, np.zeros((0, 3, 3), np.float32), rate, AdamRule())
    both.catch_up()
    p, m, v = start.astype(np.float64), 0.0, 0.0
    gradient = values.astype(np.float32).astype(np.float64)
    for t, rate in enumerate(rates, 1):
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
        root = np.sqrt(v / (1 - 0.999**t)) + 1e-15
        p -= rate * (m / (1 - 0.9**t)) / root
        gradient = 0.0
    return both, start, p


@pytest.mark.parametrize("shape", [(3000, 15, 3), (3000, 1, 3)])
@pytest.mark.parametrize("share", [0.25, 0.9, 1.0])
def test_a_step_with_many_rows_updates_all_rows(monkeypatch, shape, share):
    monkeypatch.setattr(late, "MOST_ROWS", 0.2)
    rng = np.random.default_rng(3)
    both = Both(torch.from_numpy(rng.normal(size=shape).astype(np.float32)))
    for size in (0.02, share, share):
        rows = np.flatnonzero(np.repeat(rng.random(300) < size, 10))
        both.step(
            rows, rng.normal(size=(len(rows), *shape[1:])).astype(np.float32), 1e-3, AdamRule()
        )
        both.late.finish()
        assert ("x" in both.late.names) == (size < 0.2)
    assert both.same()


@pytest.mark.slow
def test_ten_thousand_deferred_steps_have_the_bits_of_immediate_steps(long_wait):
    assert long_wait[0].same()


@pytest.mark.slow
def test_ten_thousand_deferred_steps_are_accurate_to_rounding(long_wait):
    both, start, oracle = long_wait
    way, error = np.abs(oracle - start).max(), np.abs(both.rows.double().numpy() - oracle)
    # Each step rounds the parameter once; some 200 of them are larger than its last place.
    largest = np.maximum(np.abs(start), np.abs(oracle))
    assert (error <= 200 * 2.0**-24 * largest + 1e-5 * way).all()
    assert way > 5e-3 and np.median(error / largest) < 1e-6


def test_a_nan_survives_deferred_steps():
    both = Both(torch.ones(20, 3))
    values = np.ones((2, 3), np.float32)
    values[0, 1] = np.nan
    both.step(np.array([3, 7]), values, 1e-3, AdamRule())
    for _ in range(70):
        both.step(np.array([5]), values[1:], 1e-3, AdamRule())
    both.catch_up()
    assert both.rows.isnan().nonzero().tolist() == [[3, 1]]


def setup_of(operator="sum", backbone="vanilla", **settings):
    options = {"sh_degree": 3} if backbone == "vanilla" else {}
    times = {"densify_from": 8, "densify_every": 8, "densify_until": 20, "schedule_unit": "steps"}
    given = {
        "steps": 24,
        "sampler": {"name": "random"},
        "operator": {"name": operator},
        "backbone": {"name": backbone, **options},
        "densifier": {"name": "adc"},
        **times,
        "sh_from": 3,
        **settings,
    }
    return assemble(RunConfig.model_validate(given), half_seen(), "none")


def half_seen():
    """The sample scene with photos of one side of the cloud each, and a copy where none looks."""
    scene, views = sample_scene(), []
    for k, view in enumerate(scene.views):
        aside = (-1) ** k * 0.5 * view.camera.width
        views.append(replace(view, camera=replace(view.camera, cx=view.camera.cx + aside)))
    points = np.concatenate([scene.points, scene.points + np.array([0.0, 0.0, 50.0])])
    colors = np.concatenate([scene.point_colors, scene.point_colors])
    return replace(scene, views=tuple(views), points=points, point_colors=colors)


class PerView:
    """Reads the higher bands of what a view and density control are given, and pulls at them."""

    @hookimpl
    def crossgrad_regularize(self, context):
        if context.gaussians is None or context.step % 5:
            return None
        return RegularizeResult(1e-3 * context.gaussians.sh_rest.square().sum())

    @hookimpl(wrapper=True)
    def crossgrad_densify(self, context):
        if context.step % 3 == 0:
            for record in context.views:
                assert record.gaussians.on_demand is None
                read = record.gaussians.sh_rest.clone()
                assert torch.equal(read, context.parameters["f_rest"])
        return (yield)


#: Ways to copy Gaussians without their graph.
COPIES = (
    copy.copy,
    copy.deepcopy,
    replace,
    Gaussians.detached,
    lambda gaussians: gaussians.mapped(torch.clone),
    lambda gaussians: Gaussians(**vars(gaussians)),
    lambda gaussians: pickle.loads(pickle.dumps(gaussians)),
)


class Copies:
    """Copies what it is given in every third step, in another way each time."""

    @hookimpl
    def crossgrad_regularize(self, context):
        if context.step % 3:
            return
        if context.gaussians is None:
            copied = (copy.copy, copy.deepcopy)[context.step % 2](context.parameters)
            assert type(copied) is dict
            assert torch.equal(copied["f_rest"], context.parameters["f_rest"])
        elif context.step % 2:
            self.copy(context.gaussians.detached(), context, context.step // 2)
        else:
            assert replace(context.gaussians).sh_rest is context.gaussians.sh_rest

    @hookimpl(wrapper=True)
    def crossgrad_densify(self, context):
        for record in context.views if context.step % 3 == 1 else ():
            self.copy(record.gaussians, context, context.step // 3)
        return (yield)

    def copy(self, gaussians, context, number):
        copied = COPIES[number % len(COPIES)](gaussians)
        assert type(copied) is Gaussians and copied.on_demand is None and not copied.misfit()
        assert torch.equal(copied.sh_rest, context.parameters["f_rest"])


class Decay:
    """Reads the higher bands in every fifth step, and pulls at them."""

    @hookimpl
    def crossgrad_regularize(self, context):
        if context.gaussians is not None or context.step % 5:
            return None
        return RegularizeResult(1e-3 * context.parameters["f_rest"].square().sum())


class Seen:
    """Looks at the Gaussians that a view shows, in the list of those drawn and in all."""

    def __init__(self):
        self.looks = 0

    @hookimpl(wrapper=True)
    def crossgrad_densify(self, context):
        for record in context.views:
            radii, rows = record.screen.radii, record.screen.rows
            assert rows.dtype == torch.int64 and 0 < len(rows) < len(radii)
            assert torch.equal(seen(record), radii.nonzero()[:, 0])
            self.looks += 1
        return (yield)


def trained(setup, plugins=()):
    for k, plugin in enumerate(plugins):
        setup.manager.register(plugin, name=f"own{k}")
    state = first_state(setup)
    waited = 0
    for _ in range(setup.schedule.total):
        timed_step(setup, state)
        waited += bool(state.late.names)
    return state, waited


def everything(state):
    saved = to_checkpoint(state)
    return {f"{kind} {name}": tensor for kind in ("parameters", "exp_avg", "exp_avg_sq")
            for name, tensor in getattr(saved, kind).items()}, saved.adam_steps  # fmt: skip


#: SH bands above the first learn in one of three steps.
THIRD = {"rules": {"sparse-sh": {"every": 3}}}


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("settings", "plugins"),
    [
        ({}, ()),
        ({"operator": "sum", "views": 2, "backbone": "mip"}, ()),
        ({"operator": "pcgrad", "views": 3}, ()),
        ({"operator": "pcgrad", "views": 2, "backbone": "distance"}, ()),
        ({"operator": "graddrop", "views": 2}, ()),
        ({"recipe": {"name": "published"}}, ()),
        ({"rules": {"weight-averaging": {"share": 0.5}}}, ()),
        ({}, (Decay,)),
        ({"views": 2}, (PerView,)),
        ({}, (Copies,)),
        (THIRD, (Decay,)),
        ({**THIRD, "operator": "pcgrad", "views": 2}, (PerView,)),
    ],
    ids=str,
)
def test_runs_with_deferred_steps_have_the_bits_of_runs_without(monkeypatch, settings, plugins):
    lazy, waited = trained(setup_of(**settings), [plugin() for plugin in plugins])
    monkeypatch.setattr(late, "MOST_ROWS", 0.2)
    mixed, _ = trained(setup_of(**settings), [plugin() for plugin in plugins])
    monkeypatch.setattr(NumbaRasterizer, "sparse_rows", False)
    plain, none = trained(setup_of(**settings), [plugin() for plugin in plugins])
    assert none == 0 and (waited > 5 or settings.get("operator") == "graddrop")
    theirs, others = everything(plain)
    for run in (lazy, mixed):
        ours, steps = everything(run)
        assert steps == others and ours.keys() == theirs.keys()
        assert all(torch.equal(ours[name], theirs[name]) for name in ours)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("settings", "stop"),
    [
        ({}, 6),
        ({}, 13),
        ({"operator": "pcgrad", "views": 2}, 14),
        (THIRD, 6),
        (THIRD, 13),
    ],
    ids=str,
)
def test_a_run_resumed_with_deferred_rows_has_the_same_bits(tmp_path, monkeypatch, stop, settings):
    with monkeypatch.context() as patched:
        patched.setattr(NumbaRasterizer, "sparse_rows", False)
        whole, none = trained(setup_of(**settings))
    setup = setup_of(**settings)
    first = first_state(setup)
    for _ in range(stop):
        timed_step(setup, first)
    assert none == 0 and first.late.names
    save(tmp_path, to_checkpoint(first), Keep(every=None))
    second = from_checkpoint(setup, load(latest(tmp_path)))
    counts = [timed_step(setup, second).primitives for _ in range(setup.schedule.total - stop)]
    assert len(set(counts)) > 1
    (ours, steps), (theirs, others) = everything(second), everything(whole)
    assert steps == others and ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


class Brightened(Vanilla):
    """Inherits, and reads in `decode` what its parent only hands over."""

    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        brightness = parameters["f_dc"][:, 0].mean(dim=1)
        return replace(gaussians, opacities=gaussians.opacities * brightness.sigmoid())


def test_passthrough_of_a_backbone_is_not_inherited():
    assert Brightened.passthrough == {} and Vanilla.passthrough
    setup = setup_of()
    own = replace(setup.selection, backbone=Brightened())
    assert setup.sparse_rows and not replace(setup, selection=own).sparse_rows


class Clipped(Sum):
    """Inherits, and computes with what its parent only hands on."""

    def aggregate(self, context, state):
        answer, state = super().aggregate(context, state)
        gradients = {name: None if g is None else g.clamp(-1.0, 1.0)
                     for name, g in answer.gradients.items()}  # fmt: skip
        return replace(answer, gradients=gradients), state


class Clip:
    """A wrapper that computes with the aggregated gradients."""

    @hookimpl(wrapper=True)
    def crossgrad_aggregate_gradients(self, context):
        answer = yield
        assert not any(g.is_sparse for g in answer.gradients.values() if g is not None)
        return answer


def test_sparse_rows_of_an_operator_is_not_inherited():
    assert (
        not Clipped.sparse_rows
        and not GradDrop.sparse_rows
        and Sum.sparse_rows
        and PCGrad.sparse_rows
    )
    setup = setup_of()
    own = replace(setup.selection, operator=Clipped())
    assert setup.sparse_rows and not replace(setup, selection=own).sparse_rows


def test_wrappers_of_the_aggregation_get_dense_gradients():
    _, late = trained(setup_of(views=2, operator="sum"), [Clip()])
    assert late == 0


def test_unordered_sparse_gradients_are_sorted_and_merged():
    """Autograd and sums of wrappers return rows in any order and more than once."""
    rows, values = torch.tensor([4, 1, 4]), torch.tensor([[1.0], [2.0], [4.0]])
    found = coalesced(sparse_rows(rows, values, (6, 1)))
    assert rows_of(found).tolist() == [1, 4] and values_of(found).tolist() == [[2.0], [5.0]]
    assert coalesced(dense(found).to_sparse()).tolist() == dense(found).tolist()


def behind():
    """A state with a tensor of which row 1 is behind."""
    state = TrainState({"x": torch.ones(3, 2), "y": torch.ones(1)}, AdamState(), {})
    for step in range(3):
        rows = torch.tensor([0, 1, 2] if step == 0 else [0, 2])
        gradient = sparse_rows(rows, torch.ones(len(rows), 2), (3, 2))
        coefficients = counted("x", state.tensors["x"], state.moments, 0.1, AdamRule(), 1.0)
        state.late.step("x", state.tensors["x"], gradient, state.moments, coefficients)
    state.late.finish()
    return state


@pytest.mark.parametrize(
    "read",
    [
        lambda state: state.parameters["x"],
        lambda state: state.current["x"],
        lambda state: dict(state.current)["x"],
        lambda state: {**state.current}["x"],
        lambda state: Snapshot.of(state).parameters["x"],
    ],
)
def test_reading_a_tensor_applies_its_deferred_steps(read):
    state = behind()
    raw = state.tensors["x"].clone()
    assert state.late.names == {"x"} and state.current["y"] is state.tensors["y"]
    found = read(state)
    assert not state.late.names
    assert torch.equal(found[[0, 2]], raw[[0, 2]]) and (found[1] < raw[1]).all()


@pytest.mark.parametrize(
    "go_back",
    [Snapshot.hand_over, lambda snapshot, state: snapshot.restore(state, seed=1)],
    ids=["hand over", "rewind"],
)
def test_a_rewind_discards_deferred_steps(go_back):
    state = behind()
    state.rngs = make_streams(0)
    snapshot = Snapshot.of(state)
    kept = state.tensors["x"].clone()
    gradient = sparse_rows(torch.tensor([1]), torch.full((1, 2), 9.0), (3, 2))
    coefficients = counted("x", state.tensors["x"], state.moments, 0.1, AdamRule(), 1.0)
    state.late.step("x", state.tensors["x"], gradient, state.moments, coefficients)
    go_back(snapshot, state)
    assert not state.late.names and torch.equal(state.parameters["x"], kept)


class Failing:
    """A step under way whose end is an error."""

    def __init__(self, tensor):
        self.tensor = tensor

    def end(self):
        self.leave()
        raise LookupError("of a helper")

    def leave(self):
        self.tensor[0] = 5.0


def test_a_failed_update_of_deferred_steps_is_rolled_back():
    state = behind()
    state.rngs = make_streams(0)
    guard, kept = RollbackGuard(state), state.parameters["x"].clone()
    state.touched = True
    state.late._under_way["x"] = Failing(state.tensors["x"])
    guard.commit(state)
    # It is noticed when the tensor is wanted, and whenever it is wanted.
    for _ in range(2):
        with pytest.raises(LookupError):
            state.late.catch_up("x", state.tensors["x"], state.moments)
    guard.restore(state)
    assert torch.equal(state.parameters["x"], kept)


def test_density_control_gets_visible_primitives_of_the_rendered_views():
    looks = Seen()
    trained(setup_of(), (looks,))
    assert looks.looks > 10
