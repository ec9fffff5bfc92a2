"""The state of the training loop: all values that training changes and a checkpoint contains."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from time import perf_counter, process_time
from typing import Any, Final, Literal, SupportsIndex, get_args

import numpy as np
import torch
from pluggy import HookCaller
from torch import Tensor
from typing_extensions import override

from crossgrad_core.contract.blocks import (
    EMPTY_STATE,
    SLOTS,
    TAKEN,
    AdamState,
    Parameters,
    PluginState,
    primitives_of,
)
from crossgrad_core.contract.contexts import StepRecord
from crossgrad_core.errors import UserError
from crossgrad_core.gradients.finite import is_finite
from crossgrad_core.training.adam.late import Late
from crossgrad_core.training.rngs import make_streams, restored_streams, stream_states
from crossgrad_core.training.setup import Setup
from crossgrad_core.wording import listed

#: Clock of a time budget: wall-clock seconds, or CPU seconds of the process.
ClockKind = Literal["wall", "cpu"]
Phase = Literal[
    "photos",
    "decode",
    "render",
    "loss",
    "backward",
    "aggregation",
    "optimizer",
    "density_control",
    "other",
]
#: Phases of a step. `photos` is the time to choose views and scales and to read photos from the
#: cache. The time to decode photo files counts as loading, not as a phase. `loss` includes the
#: exposure model, pixel weights and regularization.
PHASES: Final[tuple[Phase, ...]] = get_args(Phase)


@dataclass
class Clock:
    """Seconds of each activity of the run. Only the seconds in `train` count as training.

    Attributes:
        train: Seconds of training.
        compile: Seconds of compiling kernels.
        load: Seconds of reading the scene and decoding photos.
        evaluate: Seconds of evaluating held-out views.
        report: Seconds of writing results.
        phases: Training seconds in each phase of a step; their sum is `train`. Work on a GPU or in
            other threads is counted in the phase that waits for its end.
        cpu: CPU seconds of the process during training, summed over all threads. The work of other
            threads between two steps is included only if the time budget counts CPU seconds.
    """

    train: float = 0.0
    compile: float = 0.0
    load: float = 0.0
    evaluate: float = 0.0
    report: float = 0.0
    phases: dict[str, float] = field(default_factory=dict)
    cpu: float = 0.0

    def trained(self, kind: ClockKind) -> float:
        """Return the training seconds, in wall-clock time or CPU time."""
        return self.cpu if kind == "cpu" else self.train

    def copy(self) -> "Clock":
        """Return an independent copy."""
        return replace(self, phases=dict(self.phases))

    def count(self, laps: "PhaseTimer") -> None:
        """Add the times of a step after the step is complete."""
        self.train += laps.total
        self.cpu += laps.cpu
        for phase in PHASES:
            self.phases[phase] = self.phases.get(phase, 0.0) + laps.spent.get(phase, 0.0)


@dataclass
class PhaseTimer:
    """A timer for the phases of the present step. An interrupted step is not counted.

    Attributes:
        phase_began: Time at which the present phase began, later by the excluded seconds.
        total: Seconds from the start of the step to the end of the previous phase. Excluded seconds
            are not counted.
        spent: Seconds of each phase so far.
        cpu: CPU seconds of the process during `total`. Excluded CPU seconds are not counted.
        cpu_border: CPU time of the process when the present phase began, later by the excluded CPU
            seconds.
    """

    phase_began: float = field(default_factory=perf_counter)
    total: float = 0.0
    spent: dict[str, float] = field(default_factory=dict)
    cpu: float = 0.0
    cpu_border: float = field(default_factory=process_time)

    def lap(self, phase: Phase) -> None:
        """End a phase: add the time since the previous phase ended to the seconds of this phase."""
        now = perf_counter()
        seconds = now - self.phase_began
        self.spent[phase] = self.spent.get(phase, 0.0) + seconds
        self.total += seconds
        self.phase_began = now
        cpu = process_time()
        self.cpu += cpu - self.cpu_border
        self.cpu_border = cpu

    def leave_out(self, seconds: float, cpu: float) -> None:
        """Exclude seconds from the present phase, because another activity of `Clock` counts them.

        Args:
            seconds: Wall-clock seconds.
            cpu: CPU seconds during this wall-clock time.
        """
        self.phase_began += seconds
        self.cpu_border += cpu


@dataclass
class Counters:
    """Counts of the work so far.

    Attributes:
        views: Number of rendered training views.
        backward_passes: Number of backward passes.
        dropped: Number of gradients (of one block and one view) that were dropped because they were
            not finite.
        peak_primitives: Largest number of primitives after a step.
    """

    views: int = 0
    backward_passes: int = 0
    dropped: int = 0
    peak_primitives: int = 0


@dataclass
class TrainState:
    """All values that a training step reads and changes.

    Attributes:
        tensors: The parameters in memory. Some rows may have deferred Adam steps, and other threads
            may still be changing rows.
        moments: The optimizer's moments in memory. Deferred steps and running steps also change the
            moments.
        rngs: Name of a random stream -> its generator.
        states: Name of a plugin -> its state.
        step: Number of steps, including the present step.
        last: Record of the last complete step; None before the first step.
        counters: Counts of the work so far.
        clock: Seconds of each activity so far.
        laps: Timer for the phases of the present step.
        rewinds: Number of rollbacks to the last good state.
        touched: True if a step has begun to change parameters or moments, but is not complete.
        late: The deferred steps of rows, and the steps that still run in other threads.
    """

    tensors: Parameters
    moments: AdamState
    rngs: dict[str, np.random.Generator]
    states: dict[str, PluginState] = field(default_factory=dict)
    step: int = 0
    last: StepRecord | None = None
    counters: Counters = field(default_factory=Counters)
    clock: Clock = field(default_factory=Clock)
    laps: PhaseTimer = field(default_factory=PhaseTimer)
    rewinds: int = 0
    touched: bool = False
    late: Late = field(default_factory=Late)

    @property
    def parameters(self) -> Parameters:
        """Tensor name -> parameter. All deferred steps are applied first."""
        self.settle()
        return self.tensors

    @parameters.setter
    def parameters(self, parameters: Parameters) -> None:
        self.settle()
        self.tensors = parameters

    @property
    def adam(self) -> AdamState:
        """The optimizer's moments. All deferred steps are applied first."""
        self.settle()
        return self.moments

    @adam.setter
    def adam(self, adam: AdamState) -> None:
        self.settle()
        self.moments = adam

    @property
    def current(self) -> Mapping[str, Tensor]:
        """The parameters by name.

        The deferred steps of a tensor are applied when the tensor is read.
        """
        return _Current(self)

    def settle(self, names: Iterable[str] | None = None) -> None:
        """Apply the deferred steps of the named tensors; by default, of all tensors."""
        for name in self.late.names.intersection(self.late.names if names is None else names):
            self.late.catch_up(name, self.tensors[name], self.moments)

    def primitives(self, setup: Setup) -> int:
        """Return the present number of primitives."""
        return primitives_of(setup.blocks, self.tensors)

    def commit(self, states: Mapping[str, PluginState]) -> None:
        """Store states that the core itself created, without checks."""
        self.states.update(states)

    def accept(self, states: Mapping[str, PluginState], hook: HookCaller) -> None:
        """Check and store the states that plugins returned from a hook.

        Args:
            states: State of each plugin, by the name of the plugin.
            hook: The hook. A component that implements the hook may use the name of its slot as the
                name of its state.

        Raises:
            UserError: A name is reserved for a slot or for the core, or a state is not valid.
        """
        if not isinstance(states, Mapping):
            raise _no_states(hook, "its states", "a mapping of names to PluginState", states)
        for name, held in states.items():
            if not isinstance(held, PluginState):
                raise _no_states(hook, f"its state {name!r}", "a PluginState", held)
            device = next(iter(self.tensors.values())).device.type
            if wrong := unsavable(held, device, self.states.get(name, EMPTY_STATE)):
                raise UserError(
                    f"a checkpoint cannot hold the state of plugin {name}",
                    where=f"{hook.name}, {wrong}",
                    expected="plain numbers, strings, lists and dictionaries with string keys in "
                    "`values`; dense tensors of the run in `tensors`",
                    todo="repair the plugin (docs/hooks.md)",
                )
        taken = TAKEN.intersection(states)
        stolen = taken - SLOTS.intersection(_answering(hook)) if taken else taken
        if stolen:
            raise UserError(
                f"a plugin stores its state under the name {min(stolen)!r}, which is reserved "
                "for crossgrad",
                where=f"{hook.name}, one of {listed(_answering(hook))}",
                expected=f"another name than {listed(sorted(TAKEN))}",
                todo="repair the plugin: use the plugin's name as the key of its state "
                "(docs/hooks.md)",
            )
        self.states.update(states)


def unsavable(new: PluginState, device: str, known: PluginState = EMPTY_STATE) -> str:
    """Return why a checkpoint cannot store a state.

    The text is empty if a checkpoint can store the state.

    To keep steps fast, only names that the state `known` does not contain are checked.
    """
    for kind in ("values", "tensors", "per_primitive"):
        have = getattr(known, kind)
        for name, value in getattr(new, kind).items():
            wrong = "" if isinstance(name, str) else "the key is not a string"
            if name not in have:
                wrong = wrong or (no_json(value) if kind == "values" else _odd(value, device))
            if wrong:
                return f"{kind}, {name}: {wrong}"
    return ""


def no_json(value: object) -> str:
    """Return the part of a value that JSON cannot store unchanged.

    The text is empty if JSON can store the value.
    """
    if isinstance(value, dict):
        odd = (f"the key {key!r}" for key in value if not isinstance(key, str))
        return next(odd, "") or no_json(list(value.values()))
    if isinstance(value, list):
        return next(filter(None, map(no_json, value)), "")
    plain = value is None or isinstance(value, bool | int | float | str)
    return "" if plain else f"{value!r:.60} of type {type(value).__name__}"


def _odd(value: object, device: str) -> str:
    """Return why a value cannot be stored as a tensor in a file.

    The text is empty if the value can be stored.
    """
    if not isinstance(value, Tensor):
        return f"of type {type(value).__name__}, not a tensor"
    plain = value.layout == torch.strided and not value.dtype.is_complex and not value.is_quantized
    facts = value.layout, value.dtype, value.device
    return "" if plain and value.device.type in {"cpu", device} else listed(map(str, facts))


def _answering(hook: HookCaller) -> list[str]:
    """Return the names of the plugins that implement a hook."""
    return [implementation.plugin_name for implementation in hook.get_hookimpls()]


def _no_states(hook: HookCaller, what: str, expected: str, found: object) -> UserError:
    return UserError(
        f"a plugin returned a value of a wrong type for {what}",
        where=f"{hook.name}, one of {listed(_answering(hook))}",
        expected=expected,
        found=type(found).__name__,
        todo="repair the plugin (docs/hooks.md)",
    )


class _Current(Mapping[str, Tensor]):
    """A mapping from the names of tensors to parameters.

    Reading a parameter applies its deferred Adam steps first. A copy of this mapping is a plain
    dict.
    """

    def __init__(self, state: TrainState) -> None:
        self._state = state

    @override
    def __reduce_ex__(self, protocol: SupportsIndex) -> tuple[type[Parameters], tuple[Parameters]]:
        return dict, (dict(self),)

    @override
    def __getitem__(self, name: str) -> Tensor:
        self._state.settle((name,))
        return self._state.tensors[name]

    @override
    def __iter__(self) -> Iterator[str]:
        return iter(self._state.tensors)

    @override
    def __len__(self) -> int:
        return len(self._state.tensors)


@dataclass(frozen=True, eq=False)
class StepSnapshot:
    """A snapshot of all values that a step changes, except parameters and moments.

    Plugin states and records are immutable, so they are not copied.
    """

    step: int
    last: StepRecord | None
    states: dict[str, PluginState]
    streams: dict[str, dict[str, Any]]
    counters: Counters
    clock: Clock
    rewinds: int

    @classmethod
    def of(cls, state: TrainState) -> "StepSnapshot":
        """Return a snapshot of the present values."""
        return cls(
            step=state.step,
            last=state.last,
            states=dict(state.states),
            streams=stream_states(state.rngs),
            counters=replace(state.counters),
            clock=state.clock.copy(),
            rewinds=state.rewinds,
        )

    def restore(self, state: TrainState) -> None:
        """Restore all values of the snapshot, including the positions of the random streams."""
        state.step = self.step
        state.last = self.last
        state.states = dict(self.states)
        state.rngs = restored_streams(self.streams)
        state.counters = replace(self.counters)
        state.clock = self.clock.copy()
        state.rewinds = self.rewinds


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A copy of the last state that was finite, for a rollback."""

    parameters: Parameters
    adam: AdamState
    mark: StepSnapshot

    @classmethod
    def of(cls, state: TrainState) -> "Snapshot":
        """Return a deep copy of all values that training changes."""
        return cls(
            parameters={name: t.detach().clone() for name, t in state.parameters.items()},
            adam=copied_moments(state.adam),
            mark=StepSnapshot.of(state),
        )

    def restore(self, state: TrainState, seed: int) -> None:
        """Restore `state`, but with new random streams.

        After the rollback, training makes other draws than before.
        """
        state.late.forget()
        state.tensors = self._tensors(state, {n: t.clone() for n, t in self.parameters.items()})
        state.moments = copied_moments(self.adam)
        state.states = dict(self.mark.states)
        state.step = self.mark.step
        state.last = self.mark.last
        state.rewinds += 1
        state.rngs = make_streams(seed, state.rewinds, state.rngs)

    def hand_over(self, state: TrainState) -> None:
        """Restore `state` exactly, including the random streams.

        `state` receives the tensors of the snapshot themselves, because a copy may not fit into
        memory. The snapshot cannot be used again.
        """
        state.late.forget()
        state.tensors = self._tensors(state, self.parameters)
        state.moments = self.adam
        self.mark.restore(state)

    @staticmethod
    def _tensors(state: TrainState, copies: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the copies; each gets the `requires_grad` of its tensor in the training state."""
        learns = {name: tensor.requires_grad for name, tensor in state.tensors.items()}
        return {name: copied.requires_grad_(learns[name]) for name, copied in copies.items()}


def copied_moments(adam: AdamState) -> AdamState:
    """Return a deep copy of the optimizer's moments."""
    return AdamState(
        exp_avg={name: tensor.clone() for name, tensor in adam.exp_avg.items()},
        exp_avg_sq={name: tensor.clone() for name, tensor in adam.exp_avg_sq.items()},
        steps=dict(adam.steps),
    )


class NonFiniteError(Exception):
    """A loss, gradient or parameter is NaN or infinite.

    Args:
        step: The step in which the value was found.
        views: Names of the views in this step, or only of the view that caused the value.
        block: Description of the value, for the message.
    """

    def __init__(self, step: int, views: tuple[str, ...], block: str) -> None:
        self.step = step
        self.views = views
        self.block = block
        super().__init__(
            f"{block} is not finite in step {step}, view{'s' if len(views) > 1 else ''} "
            f"{', '.join(views)}"
        )


class TrainingFailedError(Exception):
    """Training cannot continue. The results so far and the last checkpoint remain."""


def are_parameters_finite(state: TrainState) -> bool:
    """Return True if no parameter is NaN or infinite."""
    state.late.finish()
    return all(is_finite(tensor) for tensor in state.tensors.values())


def check_parameters(state: TrainState) -> None:
    """Raise NonFiniteError if a parameter is NaN or infinite."""
    state.late.finish()
    for name, tensor in state.tensors.items():
        if not is_finite(tensor):
            views = () if state.last is None else state.last.names
            raise NonFiniteError(state.step, views, f"block {name}")


def check_start(state: TrainState) -> None:
    """Check the state at the start of training, when no earlier state could be restored.

    Raises:
        TrainingFailedError: A parameter or moment is NaN or infinite. The message names the
            parameter.
    """
    parts = {
        "block": state.parameters,
        "the first moment of": state.adam.exp_avg,
        "the second moment of": state.adam.exp_avg_sq,
    }
    for kind, tensors in parts.items():
        for name, tensor in tensors.items():
            if not is_finite(tensor):
                raise TrainingFailedError(
                    f"{kind} {name} is not finite in the state of step {state.step}, from which "
                    f"training would continue; {_way_out(state.step)}"
                )


def _way_out(step: int) -> str:
    if step == 0:
        return "check the Gaussians of --init, and plugins that change the first parameters"
    return (
        f"remove checkpoints/step-{step:06d} to resume from an earlier checkpoint, if there is one"
    )


def check_dropped(setup: Setup, state: TrainState, record: StepRecord) -> None:
    """Raise TrainingFailedError if too many non-finite gradients were dropped so far."""
    if state.counters.dropped >= setup.config.max_nonfinite_blocks:
        raise TrainingFailedError(
            f"{state.counters.dropped} blocks of single views were dropped because their gradient "
            f"was not finite, the last in step {state.step} (views {', '.join(record.names)})"
        )


class RollbackGuard:
    """Protection against errors: values before the present step, and a copy of an earlier state.

    Most errors of a step occur before parameters change, for example in sampling, photo decoding or
    rendering. After an error of this kind, only the present step is lost. If an error interrupts
    the optimizer or an edit, the copy of the earlier state is restored. Only states that are finite
    are copied.

    Args:
        state: The training state at the start, which must already be checked.
    """

    def __init__(self, state: TrainState) -> None:
        self._snapshot = Snapshot.of(state)
        self._mark = self._snapshot.mark
        self._looked = state.step
        state.touched = False

    def commit(self, state: TrainState, *, look: bool = False) -> None:
        """Record that a step is complete. An error in the next step does not undo a complete step.

        Raises:
            NonFiniteError: `look` is True, and a parameter is NaN or infinite.
        """
        if look:
            self.check(state)
        self._mark = StepSnapshot.of(state)
        state.touched = False

    def check(self, state: TrainState) -> None:
        """Check the parameters, unless a check after this step has already been done.

        Raises:
            NonFiniteError: A parameter is NaN or infinite.
        """
        if self._looked != state.step:
            check_parameters(state)
            self._looked = state.step

    def copy(self, state: TrainState) -> None:
        """Copy this state. The copy can be restored after an error.

        Raises:
            NonFiniteError: A parameter is NaN or infinite.
        """
        self.check(state)
        self._snapshot = Snapshot.of(state)

    def rewind(self, state: TrainState, seed: int) -> None:
        """Restore `state` from the copy, but with new random streams."""
        self._snapshot.restore(state, seed)
        self._looked = state.step
        self.commit(state)

    def restore(self, state: TrainState) -> None:
        """Restore `state` to the end of the last complete step.

        If the snapshot cannot be restored, restore the copy.

        Call this method only at the end of training, because the copy cannot be used again.
        """
        for tensor in state.tensors.values():
            tensor.grad = None
        if not state.touched and is_whole(state):
            self._mark.restore(state)
        else:
            self._snapshot.hand_over(state)
            state.touched = False


def is_whole(state: TrainState) -> bool:
    """Return True if all parameters are finite.

    Return False if a parameter is not finite or the check fails.
    """
    try:
        return are_parameters_finite(state)
    except Exception:
        # The check itself fails if the last step failed, if memory is short, or if the GPU failed.
        return False
