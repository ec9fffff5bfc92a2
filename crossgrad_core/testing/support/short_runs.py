"""Short runs on the sample scene. A run is either refused with reasons, or trained."""

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

#: Largest allowed loss. For images in [0, 1], losses are far below this number.
_LARGEST_LOSS = 10.0


@dataclass(frozen=True)
class ShortRun:
    """The parameters before, during and after a few steps, and the records of these steps.

    Attributes:
        before: Parameters before the first step.
        early: Parameters after the first step.
        after: Parameters after the last step.
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
    """Return the reasons why a run is refused before training; empty if the run is accepted.

    A component may refuse the selection (`crossgrad_validate_selection`). A run is also refused if
    the numbers of views, tensors, statistics or devices that its components declare do not match.
    """
    config, *_ = with_decisions(config, sample_scene())
    selection, _ = select(config, sample_scene(), "none")
    # Call the hooks of observers directly, because registering observers with a manager would take
    # most of the time.
    observers = [build(Observer, choice.name, choice.options) for choice in config.observers]
    plugins = (*selection.plugins.values(), *observers)
    asked = (getattr(plugin, "crossgrad_validate_selection", None) for plugin in plugins)
    answers = [ask(selection) for ask in asked if ask is not None]
    return reasons_against(config, selection, [answer for answer in answers if answer])


def setup_of(config: RunConfig) -> Setup:
    """Create the setup of a configuration for the sample scene.

    Raises:
        IncompatibleSelectionError: The configuration is refused before training.
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
    """Require finite losses and parameters. The first step must change a parameter."""
    for step, record in enumerate(run.records, 1):
        good = all(0.0 <= loss < _LARGEST_LOSS for loss in record.losses)
        require(good, f"step {step}: the losses are {record.losses}; expected 0 to 10")
    for name, tensor in run.after.items():
        require(tensor.isfinite().all(), f"the parameters {name} are not finite after training")
    moved = any(not torch.equal(tensor, run.early[name]) for name, tensor in run.before.items())
    require(moved, "the first step changes no parameter")


def require_repeated(run: ShortRun, again: ShortRun) -> None:
    """Require that two runs with equal seeds give bit-identical results."""
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
    """Train the first steps of a run twice, and check the results.

    Raises:
        ContractError: A loss or parameter is not finite, no parameter changes, or the two runs
            differ.
        UserError: The run cannot start, or a plugin returns an invalid result.
    """
    setup = setup_of(config)
    with on_one_thread():
        run = train(setup, steps)
        require_sound(run)
        if setup.rasterizer.deterministic:
            require_repeated(run, train(setup, steps))
