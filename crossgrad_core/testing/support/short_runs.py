"""Short runs on the sample scene, which are either refused with reasons or trained."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.contexts import StepRecord
from crossgrad_core.contract.slots.observer import Observer
from crossgrad_core.numerics.threads import on_one_thread
from crossgrad_core.registry.entries import build
from crossgrad_core.run.assemble import assemble, reasons_against
from crossgrad_core.run.decisions import with_decisions
from crossgrad_core.run.select import select
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.testing.support.contract import require
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.start import first_state
from crossgrad_core.wording import listed

#: Upper limit of losses. Losses of images in [0, 1] are far below this limit.
_LARGEST_LOSS = 10.0


@dataclass(frozen=True)
class ShortRun:
    """The parameters and records of a few steps.

    Attributes:
        before: Parameters before the first step.
        early: Parameters after the first step.
        after: Parameters at the end.
        records: The record of each step.
    """

    before: Mapping[str, Tensor]
    early: Mapping[str, Tensor]
    after: Mapping[str, Tensor]
    records: tuple[StepRecord, ...]

    @property
    def losses(self) -> list[float]:
        """The losses of all views in all steps."""
        return [loss for record in self.records for loss in record.losses]


def reasons_to_refuse(config: RunConfig) -> tuple[str, ...]:
    """Return the reasons to refuse a run before training; empty if it is accepted.

    A combination is refused if a component objects (`crossgrad_validate_selection`), or if the
    declarations of its components do not match in numbers of views, tensors, statistics or devices.
    """
    config, *_ = with_decisions(config, sample_scene())
    selection, _ = select(config, sample_scene(), "none")
    # Do not register the observer with the manager, because registration would take most of the
    # time.
    observers = [build(Observer, choice.name, choice.options) for choice in config.observers]
    plugins = (*selection.plugins.values(), *observers)
    asked = (getattr(plugin, "crossgrad_validate_selection", None) for plugin in plugins)
    answers = [ask(selection) for ask in asked if ask is not None]
    return reasons_against(config, selection, [answer for answer in answers if answer])


def setup_of(config: RunConfig) -> Setup:
    """Assemble the run of a configuration on the sample scene.

    Raises:
        IncompatibleSelectionError: The configuration is refused.
    """
    return assemble(config, sample_scene(), "none")


def train(setup: Setup, steps: int) -> ShortRun:
    """Train the first steps of a run."""
    state = first_state(setup)
    stages, records = [_copied(state.parameters)], []
    for _ in range(steps):
        records.append(timed_step(setup, state))
        if len(records) in {1, steps}:
            stages.append(_copied(state.parameters))
    return ShortRun(stages[0], stages[1], stages[-1], tuple(records))


def _copied(parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in parameters.items()}


def require_sound(run: ShortRun) -> None:
    """Require finite losses and parameters, and that the first step changes a parameter."""
    for step, record in enumerate(run.records, 1):
        good = all(0.0 <= loss < _LARGEST_LOSS for loss in record.losses)
        require(good, f"step {step}: the losses are {record.losses}; expected 0 to 10")
    for name, tensor in run.after.items():
        require(tensor.isfinite().all(), f"the parameters {name} are not finite after training")
    moved = any(not torch.equal(tensor, run.early[name]) for name, tensor in run.before.items())
    require(moved, "the first step changes no parameter")


def require_repeated(run: ShortRun, again: ShortRun) -> None:
    """Require that two runs with one seed are equal to the bit."""
    for step, (one, other) in enumerate(zip(run.records, again.records, strict=True), 1):
        for what in ("views", "losses", "counts"):
            pair = getattr(one, what), getattr(other, what)
            same = pair[0] == pair[1]
            require(
                same,
                f"step {step}: two runs with the same seed have the {what} "
                f"{listed(map(str, pair))}",
            )
    require(
        run.after.keys() == again.after.keys(), "two runs with the same seed have other tensors"
    )
    for name, tensor in run.after.items():
        require(
            torch.equal(tensor, again.after[name]), f"two runs with the same seed differ in {name}"
        )


def try_out(config: RunConfig, steps: int) -> None:
    """Train a run for some steps, twice, and check the results.

    Raises:
        ContractError: A loss or parameter is not finite, nothing is trained, or the runs differ.
        UserError: The run cannot start, or a plugin gives a wrong answer.
    """
    setup = setup_of(config)
    with on_one_thread():
        run = train(setup, steps)
        require_sound(run)
        if setup.rasterizer.deterministic:
            require_repeated(run, train(setup, steps))
