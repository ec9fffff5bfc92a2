"""Contract checks for densifiers, with a real backbone and artificial screen statistics."""

from dataclasses import dataclass, field, replace
from itertools import count

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.contract.blocks import (
    Block,
    Edit,
    Parameters,
    PluginState,
    apply_to_parameters,
    gather_indices,
    misfit_of,
    primitives_of,
)
from crossgrad_core.contract.contexts import DensifyContext, ViewRecord
from crossgrad_core.contract.gaussians import Screen
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.defaults import BACKBONE, REFERENCE_RASTERIZER
from crossgrad_core.registry.entries import build, entries, load
from crossgrad_core.testing.backbones import created
from crossgrad_core.testing.fixtures import sample_phase, sample_scene, step_fields
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import (
    Check,
    Make,
    cannot_tell,
    global_randomness_untouched,
    require,
    revived,
    same_state,
)
from crossgrad_core.testing.support.growth import require_bounded, size_of
from crossgrad_core.testing.support.renders import (
    gaussians_in_a_run,
    parameters_in_a_run,
    renders_of,
    view_record,
)
from crossgrad_core.wording import listed

#: Steps of the published schedule before, during and after its second and third edit, at steps 600
#: and 700.
_AROUND_EDITS = (*range(596, 602), *range(698, 702))
_EDIT = 600
_ROOM = 10_000
#: Smallest share of the Gaussians that must remain after an edit.
_LEFT = 0.1
#: Typical gradient with respect to the projected mean, per pixel. For images of this size, the
#: published threshold in NDC units corresponds to 2e-5.
_GRADIENT = 5e-5


@dataclass
class DensifierRun:
    """A densifier that is called step by step, as in a training run.

    The edits of the densifier are applied to the parameters.

    Attributes:
        densifier: The densifier.
        backbone: A backbone that has the tensors that the densifier edits.
        parameters: The present parameters.
        state: The present state of the densifier.
        rng: The random generator that the hook receives.
    """

    densifier: Densifier
    backbone: Backbone
    parameters: Parameters
    state: PluginState = field(default_factory=PluginState)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    @classmethod
    def of(cls, densifier: Densifier) -> "DensifierRun":
        """Create a run before its first step.

        Raises:
            SkipTest: No installed backbone has the tensors that the densifier edits.
        """
        backbone = _backbone_for(densifier)
        return cls(densifier, backbone, created(backbone))

    @property
    def primitives(self) -> int:
        """The present number of primitives."""
        return primitives_of(self.backbone.blocks(), self.parameters)

    def context(self, step: int, room: int = _ROOM) -> DensifyContext:
        """Return the context of the densifier for a step with two rendered views."""
        fields = {**step_fields(step), "rng": self.rng}
        rasterizer = build(Rasterizer, REFERENCE_RASTERIZER, {})
        return DensifyContext(
            **fields,
            parameters=parameters_in_a_run(self.parameters),
            backbone=self.backbone,
            rasterizer=rasterizer,
            views=tuple(self._rendered(index, step) for index in (step % 4, 4 + step % 5)),
            means_lr=1e-4,
            room=room,
            render=renders_of(
                sample_scene(), sample_phase(step), self.backbone, rasterizer, self.parameters
            ),
        )

    def take_step(self, step: int, room: int = _ROOM) -> Edit:
        """Call the densifier for a step, apply its edit, and return the edit."""
        edit, state = self.densifier.densify(self.context(step, room), self.state)
        require(isinstance(edit, Edit), f"the result is {edit!r}, not an Edit or NO_EDIT")
        require(isinstance(state, PluginState), f"the new state is {state!r}, not a PluginState")
        self._require_rows(state)
        self.state = state
        self._apply(edit)
        return edit

    def _rendered(self, index: int, step: int) -> ViewRecord:
        view = sample_scene().train_views[index]
        with torch.no_grad():
            gaussians = self.backbone.decode(self.parameters, view.camera, sample_phase(step))
        screen = _screen(len(gaussians), self.densifier.needs, (index, step))
        return view_record(view, gaussians_in_a_run(gaussians, self.backbone), screen, index)

    def _require_rows(self, state: PluginState) -> None:
        for name, tensor in state.per_primitive.items():
            rows = tensor.shape[0]
            require(
                rows == self.primitives,
                f"the returned state's {name} has {rows} rows for {self.primitives} "
                "Gaussians; the edit selects the rows later",
            )

    def _apply(self, edit: Edit) -> None:
        blocks, before = self.backbone.blocks(), self.primitives
        require_good(edit, blocks, self.parameters)
        self.parameters = apply_to_parameters(edit, blocks, self.parameters)
        self.state = self.state.gathered(*gather_indices(edit, before, torch.device("cpu")))
        if edit.source is not None:
            phase = sample_phase()
            self.parameters = self.backbone.prepare(self.parameters, sample_scene(), phase)


def _screen(gaussians: int, needs: frozenset[str], seed: tuple[int, int]) -> Screen:
    """Create artificial statistics.

    One third of the Gaussians is invisible, and most of the visible ones need densification.
    """
    rng = np.random.default_rng(seed)
    radii = torch.from_numpy(rng.integers(0, 3, gaussians) * 4).int()
    seen = (radii > 0).float()
    gradient = torch.from_numpy(rng.normal(0.0, _GRADIENT, (gaussians, 2))).float()
    gradient *= seen[:, None]
    return Screen(
        radii=radii,
        pixels=(radii * radii) if "pixels" in needs else None,
        mean_gradient=gradient,
        abs_gradient=2.0 * gradient.abs() if "abs_gradient" in needs else None,
        directions=_directions(radii, gradient, rng) if "directions" in needs else None,
        count=(lambda _: radii * radii) if "count" in needs else None,
    )


def _directions(radii: Tensor, gradient: Tensor, rng: np.random.Generator) -> Tensor:
    """Create up to four pixels in each of six direction bins.

    The absolute gradients of these pixels sum to twice the absolute value of `gradient`.
    """
    shape = (radii.shape[0], 6, 4)
    angles = torch.from_numpy(rng.uniform(0.0, 2.0 * np.pi, shape)).float()
    there = torch.from_numpy(rng.random(shape) < 0.5).float()  # noqa: PLR2004 - each value is 1 with probability one half
    there *= (radii > 0)[:, None, None]
    units = torch.stack([angles.cos(), angles.sin(), there], -1) * there[..., None]
    sums = units.sum(2)
    absolute = gradient.abs()[:, None, :].expand(-1, 6, -1) / 3.0
    return torch.cat([sums[..., :2], absolute, sums[..., 2:]], -1)


def _backbone_for(densifier: Densifier) -> Backbone:
    """Return a backbone for the densifier.

    If possible, the backbone uses this densifier by default. In any case, the backbone has the
    tensors that the densifier edits.
    """
    fitting = []
    # If several backbones are suitable, the first one is used. Backbones of crossgrad precede the
    # backbones of other packages.
    candidates = sorted(
        entries("backbones").values(), key=lambda entry: entry.distribution != "crossgrad"
    )
    for entry in sorted(candidates, key=lambda entry: entry.name != BACKBONE):
        try:
            backbone = build(Backbone, entry.name, {})
            have = {tensor for block in backbone.blocks() for tensor in block.tensors}
            default = load("densifiers", backbone.default_densifier)
        except (Exception, SystemExit):
            # A broken backbone of another package is not an error of the densifier.
            continue
        if densifier.tensors <= have:
            fitting.append((type(densifier) is not default, backbone))
    if not fitting:
        wanted = ", ".join(sorted(densifier.tensors))
        raise cannot_tell(f"no installed backbone has the tensors {wanted}")
    return min(fitting, key=lambda pair: pair[0])[1]


def require_good(edit: Edit, blocks: tuple[Block, ...], parameters: Parameters) -> None:
    """Require that an edit matches the parameters and that its values are finite."""
    misfit = misfit_of(edit, blocks, parameters)
    require(not misfit, f"the edit is inconsistent: {misfit}")
    plain = all(type(number) is int for number in edit.counts.values())
    require(plain, f"edit.counts is {edit.counts!r}; expected plain integers")
    number = primitives_of(blocks, parameters) if edit.source is None else len(edit.source)
    for name, overwrite in edit.values.items():
        values, rows = overwrite.values, overwrite.rows
        # A training run would copy a smaller tensor to all rows, which is almost never intended.
        wanted = (number if rows is None else len(rows), *parameters[name].shape[1:])
        shape = tuple(values.shape)
        require(shape == wanted, f"edit.values of {name} has the shape {shape}, expected {wanted}")
        require(values.isfinite().all(), f"edit.values of {name} is not finite")


def its_needs_are_statistics(make: Make[Densifier]) -> None:
    """`needs` contains only optional outputs that a rasterizer may provide.

    With any other name, no run could start.
    """
    statistics = ("depth", "pixels", "abs_gradient", "directions", "count")
    more = sorted(make().needs.difference(statistics))
    require(
        not more, f"needs contains {listed(more)}; rasterizers can provide {listed(statistics)}"
    )


def quiet_before_its_time(make: Make[Densifier]) -> None:
    """The densifier makes no edit before or at step `densify_from`."""
    run = DensifierRun.of(make())
    for step in (1, 100, 499, 500):
        edit = run.take_step(step)
        require(edit.is_empty, f"step {step} of 30,000: {edit!r}, expected NO_EDIT")


def edits_keep_everything_aligned(make: Make[Densifier]) -> None:
    """Edits are valid.

    After an edit, all per-primitive parameters and statistics have one row for each primitive.
    """
    run = DensifierRun.of(make())
    for step in _AROUND_EDITS:
        run.take_step(step)
        for block in run.backbone.blocks():
            for name in block.tensors if block.per_primitive else ():
                rows = run.parameters[name].shape[0]
                require(rows == run.primitives, f"step {step}: {name} has {rows} rows")
                finite = run.parameters[name].isfinite().all()
                require(finite, f"step {step}: {name} is not finite")


def never_outgrows_the_room(make: Make[Densifier]) -> None:
    """An edit adds at most `context.room` primitives."""
    for room in (0, 1, 5):
        run = DensifierRun.of(make())
        for step in range(_EDIT - 4, _EDIT):
            run.take_step(step, room)
        before = run.primitives
        run.take_step(_EDIT, room)
        grown = run.primitives - before
        require(grown <= room, f"{grown} Gaussians were added, but context.room was {room}")


def most_primitives_survive(make: Make[Densifier]) -> None:
    """No edit removes nearly all primitives of a good model.

    Training could not replace so many removed primitives.
    """
    run = DensifierRun.of(make())
    for step in range(_EDIT - 4, _EDIT + 1):
        before = run.primitives
        edit = run.take_step(step)
        left = before if edit.source is None else len(set(edit.source.tolist()))
        require(
            left >= _LEFT * before,
            f"step {step}: the edit of densify keeps {left} of {before} Gaussians at the "
            f"start of training; expected at least {_LEFT:.0%}",
        )


def same_seed_same_edits(make: Make[Densifier]) -> None:
    """Edits depend only on the arguments, and random numbers come from `context.rng`."""
    with global_randomness_untouched():
        one, other = DensifierRun.of(make()), DensifierRun.of(make())
        for step in _AROUND_EDITS:
            one.take_step(step)
            other.take_step(step)
            _require_same(one, other, f"step {step}: two runs with the same seed differ")


def resumes_exactly(make: Make[Densifier]) -> None:
    """A resumed run makes the same edits as an uninterrupted run."""
    whole, broken = DensifierRun.of(make()), DensifierRun.of(make())
    for step in _AROUND_EDITS:
        whole.take_step(step)
        broken.densifier, broken.state = make(), revived(broken.state)
        broken.take_step(step)
        _require_same(
            whole,
            broken,
            f"step {step}: a resumed run differs; keep all state in the returned state",
        )


def _require_same(one: DensifierRun, other: DensifierRun, otherwise: str) -> None:
    equal = one.primitives == other.primitives and all(
        torch.equal(tensor, other.parameters[name]) for name, tensor in one.parameters.items()
    )
    require(equal, otherwise)


def inputs_stay_untouched(make: Make[Densifier]) -> None:
    """Parameters change only through the returned edit, and the old state does not change."""
    run = DensifierRun.of(make())
    for step in _AROUND_EDITS:
        copies: dict[str, Tensor] = {n: t.detach().clone() for n, t in run.parameters.items()}
        kept = revived(run.state)
        context = run.context(step)
        run.densifier.densify(replace(context, rng=np.random.default_rng(step)), run.state)
        for name, tensor in run.parameters.items():
            same = torch.equal(tensor.detach(), copies[name])
            require(same, f"step {step}: densify changes {name} itself; return an edit instead")
        require(
            same_state(run.state, kept), f"step {step}: densify changes the state that it received"
        )
        run.take_step(step)


def states_stay_bounded(make: Make[Densifier]) -> None:
    """The state does not grow with the number of steps."""
    run = DensifierRun.of(make())
    require_bounded((size_of(run.state) for step in count(_EDIT) if run.take_step(step)), "densify")


DENSIFIER_CHECKS: tuple[Check[Densifier], ...] = (
    *COMPONENT_CHECKS,
    its_needs_are_statistics,
    quiet_before_its_time,
    edits_keep_everything_aligned,
    never_outgrows_the_room,
    most_primitives_survive,
    same_seed_same_edits,
    resumes_exactly,
    inputs_stay_untouched,
    states_stay_bounded,
)
