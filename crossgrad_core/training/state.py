"""The state of the training loop: everything that changes and that a checkpoint contains."""

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

#: Clock of a time budget: it measures wall-clock seconds or CPU seconds of the process.
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
#: Phases of a step. `photos` includes the choice of views and scales and the access to photos.
#: Decoding of files belongs to loading. `loss` includes exposure, pixel weights and regularisation.
PHASES: Final[tuple[Phase, ...]] = get_args(Phase)


@dataclass
class Clock:
    """Seconds by activity; only `train` counts as training.

    Attributes:
        train: Training.
        compile: Compiling kernels.
        load: Reading the scene and decoding photos.
        evaluate: Evaluating held-out views.
        report: Writing results.
        phases: Training seconds by phase of the step; their sum is `train`. Work on a GPU or on
            other threads is counted in the phase that waits for it.
        cpu: CPU seconds of the process during training, for all threads. Work of other threads
            between two steps is included only if the run has a budget in CPU seconds.
    """

    train: float = 0.0
    compile: float = 0.0
    load: float = 0.0
    evaluate: float = 0.0
    report: float = 0.0
    phases: dict[str, float] = field(default_factory=dict)
    cpu: float = 0.0

    def trained(self, kind: ClockKind) -> float:
        """Return the training seconds on this clock."""
        return self.cpu if kind == "cpu" else self.train

    def copy(self) -> "Clock":
        """Return an independent copy."""
        return replace(self, phases=dict(self.phases))

    def count(self, laps: "PhaseTimer") -> None:
        """Add the times of a complete step."""
        self.train += laps.total
        self.cpu += laps.cpu
        for phase in PHASES:
            self.phases[phase] = self.phases.get(phase, 0.0) + laps.spent.get(phase, 0.0)


@dataclass
class PhaseTimer:
    """The phases of the current step; an interrupted step is not counted.

    Attributes:
        phase_began: Time at which the present phase began.
        total: Seconds from the start of the step to the end of the previous phase, without excluded
            seconds.
        spent: Phase -> seconds.
        cpu: CPU seconds of the process during `total`, without excluded CPU seconds.
        cpu_border: CPU time of the process at the end of the previous phase.
    """

    phase_began: float = field(default_factory=perf_counter)
    total: float = 0.0
    spent: dict[str, float] = field(default_factory=dict)
    cpu: float = 0.0
    cpu_border: float = field(default_factory=process_time)

    def lap(self, phase: Phase) -> None:
        """End a phase: add the time since the end of the previous phase to its total."""
        now = perf_counter()
        seconds = now - self.phase_began
        self.spent[phase] = self.spent.get(phase, 0.0) + seconds
        self.total += seconds
        self.phase_began = now
        cpu = process_time()
        self.cpu += cpu - self.cpu_border
        self.cpu_border = cpu

    def leave_out(self, seconds: float, cpu: float) -> None:
        """Exclude seconds from the present phase, because these seconds belong to another clock.

        Args:
            seconds: Wall-clock seconds.
            cpu: CPU seconds in this time.
        """
        self.phase_began += seconds
        self.cpu_border += cpu


@dataclass
class Counters:
    """Counts of the work done so far.

    Attributes:
        views: Rendered training views.
        backward_passes: Backward passes.
        dropped: Blocks of views that were dropped because their gradient was not finite.
        peak_primitives: Largest number of primitives after any step.
    """

    views: int = 0
    backward_passes: int = 0
    dropped: int = 0
    peak_primitives: int = 0


@dataclass
class TrainState:
    """All values that a step reads and writes.

    Attributes:
        tensors: The parameters as stored in memory. Some rows may have deferred Adam steps, and a
            step may still run on other threads.
        moments: The optimizer's moments as stored in memory. Deferred and running steps may change
            them, too.
        rngs: Stream name -> generator of the stream.
        states: Plugin name -> its state.
        step: Number of steps, including the present one.
        last: Record of the last complete step.
        counters: Counts of the work so far.
        clock: Seconds so far.
        laps: Phases of the present step.
        rewinds: How often training was rewound to the last good state.
        touched: True if an incomplete step has begun to change parameters or moments.
        late: The deferred steps of rows, and the steps that still run on other threads.
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
        """Tensor name -> parameter, after all deferred steps."""
        self.settle()
        return self.tensors

    @parameters.setter
    def parameters(self, parameters: Parameters) -> None:
        self.settle()
        self.tensors = parameters

    @property
    def adam(self) -> AdamState:
        """The optimizer's moments, after all deferred steps."""
        self.settle()
        return self.moments

    @adam.setter
    def adam(self, adam: AdamState) -> None:
        self.settle()
        self.moments = adam

    @property
    def current(self) -> Mapping[str, Tensor]:
        """The parameters; deferred steps of a tensor are applied when it is read."""
        return _Current(self)

    def settle(self, names: Iterable[str] | None = None) -> None:
        """Apply the deferred steps of these tensors, by default of all tensors."""
        for name in self.late.names.intersection(self.late.names if names is None else names):
            self.late.catch_up(name, self.tensors[name], self.moments)

    def primitives(self, setup: Setup) -> int:
        """Return the number of primitives."""
        return primitives_of(setup.blocks, self.tensors)

    def commit(self, states: Mapping[str, PluginState]) -> None:
        """Store states of the core."""
        self.states.update(states)

    def accept(self, states: Mapping[str, PluginState], hook: HookCaller) -> None:
        """Check and store the states that plugins returned from a hook.

        Args:
            states: Name -> state.
            hook: The hook; a component that implements it may use the name of its slot.

        Raises:
            UserError: A name belongs to a slot or to the core, or a state is not valid.
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
    """Return the part of a state that a checkpoint cannot store; empty if there is none.

    For speed in each step, only names that are not in the state `known` are checked.
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
    """Return the part of a value that JSON cannot store unchanged; empty if there is none."""
    if isinstance(value, dict):
        odd = (f"the key {key!r}" for key in value if not isinstance(key, str))
        return next(odd, "") or no_json(list(value.values()))
    if isinstance(value, list):
        return next(filter(None, map(no_json, value)), "")
    plain = value is None or isinstance(value, bool | int | float | str)
    return "" if plain else f"{value!r:.60} of type {type(value).__name__}"


def _odd(value: object, device: str) -> str:
    """Return how a value differs from a tensor that a file can store; empty if it can be stored."""
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
    """Tensor name -> parameter; reading applies deferred Adam steps. A copy is a plain dict."""

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
    """All values that a step changes except parameters and moments, at one time.

    Plugin states and records are immutable values and need no copy.
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
        """Return a snapshot of the present moment."""
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
        """Restore everything, including the positions of the random streams."""
        state.step = self.step
        state.last = self.last
        state.states = dict(self.states)
        state.rngs = restored_streams(self.streams)
        state.counters = replace(self.counters)
        state.clock = self.clock.copy()
        state.rewinds = self.rewinds


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A copy of the last good state, for a rollback."""

    parameters: Parameters
    adam: AdamState
    mark: StepSnapshot

    @classmethod
    def of(cls, state: TrainState) -> "Snapshot":
        """Return a deep copy of everything that training changes."""
        return cls(
            parameters={name: t.detach().clone() for name, t in state.parameters.items()},
            adam=copied_moments(state.adam),
            mark=StepSnapshot.of(state),
        )

    def restore(self, state: TrainState, seed: int) -> None:
        """Restore `state` with new random streams, so that the same draws do not occur again."""
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

        `state` gets the tensors of the copy itself, because memory may be short. The copy cannot be
        used again.
        """
        state.late.forget()
        state.tensors = self._tensors(state, self.parameters)
        state.moments = self.adam
        self.mark.restore(state)

    @staticmethod
    def _tensors(state: TrainState, copies: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the copies with the same `requires_grad` as the tensors of the state."""
        learns = {name: tensor.requires_grad for name, tensor in state.tensors.items()}
        return {name: copied.requires_grad_(learns[name]) for name, copied in copies.items()}


def copied_moments(adam: AdamState) -> AdamState:
    """Return a deep copy."""
    return AdamState(
        exp_avg={name: tensor.clone() for name, tensor in adam.exp_avg.items()},
        exp_avg_sq={name: tensor.clone() for name, tensor in adam.exp_avg_sq.items()},
        steps=dict(adam.steps),
    )


class NonFiniteError(Exception):
    """A loss, gradient or parameter is NaN or infinite.

    Args:
        step: Step in which the value was found.
        views: Names of the views of that step, or of the single view if it is known.
        block: Description of the value that is not finite.
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
    """Training cannot continue; the results so far and the last checkpoint are kept."""


def are_parameters_finite(state: TrainState) -> bool:
    """Return True if no parameter is NaN or infinite."""
    state.late.finish()
    return all(is_finite(tensor) for tensor in state.tensors.values())


def check_parameters(state: TrainState) -> None:
    """Raise NonFiniteError if a parameter is NaN or infinite after a step."""
    state.late.finish()
    for name, tensor in state.tensors.items():
        if not is_finite(tensor):
            views = () if state.last is None else state.last.names
            raise NonFiniteError(state.step, views, f"block {name}")


def check_start(state: TrainState) -> None:
    """Check the state at the start of training, before which there is no state to restore.

    Raises:
        TrainingFailedError: A parameter or moment is NaN or infinite; the message names it.
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
    """Raise TrainingFailedError if too many non-finite gradients were dropped."""
    if state.counters.dropped >= setup.config.max_nonfinite_blocks:
        raise TrainingFailedError(
            f"{state.counters.dropped} blocks of single views were dropped because their gradient "
            f"was not finite, the last in step {state.step} (views {', '.join(record.names)})"
        )


class RollbackGuard:
    """The state before the present step, and a copy of an earlier good state.

    Most errors of a step (sampling, a photo, rendering, an operator, the memory) occur before
    parameters change. Then only the present step is lost. If an optimizer step or an edit was
    interrupted, the copy is restored. Only checked states are copied.

    Args:
        state: The state at the start of training, already checked.
    """

    def __init__(self, state: TrainState) -> None:
        self._snapshot = Snapshot.of(state)
        self._mark = self._snapshot.mark
        self._looked = state.step
        state.touched = False

    def commit(self, state: TrainState, *, look: bool = False) -> None:
        """Record that a step is complete.

        Raises:
            NonFiniteError: `look` is True, and a parameter is NaN or infinite.
        """
        if look:
            self.check(state)
        self._mark = StepSnapshot.of(state)
        state.touched = False

    def check(self, state: TrainState) -> None:
        """Check the parameters, unless they were already checked after this step.

        Raises:
            NonFiniteError: A parameter is NaN or infinite.
        """
        if self._looked != state.step:
            check_parameters(state)
            self._looked = state.step

    def copy(self, state: TrainState) -> None:
        """Copy this state as the state to restore after an error.

        Raises:
            NonFiniteError: A parameter is NaN or infinite.
        """
        self.check(state)
        self._snapshot = Snapshot.of(state)

    def rewind(self, state: TrainState, seed: int) -> None:
        """Restore `state` from the copy, with new random streams."""
        self._snapshot.restore(state, seed)
        self._looked = state.step
        self.commit(state)

    def restore(self, state: TrainState) -> None:
        """Restore `state` to the last complete step or, if this is impossible, to the copy.

        This method is for the end of training, because the copy cannot be used again.
        """
        for tensor in state.tensors.values():
            tensor.grad = None
        if not state.touched and is_whole(state):
            self._mark.restore(state)
        else:
            self._snapshot.hand_over(state)
            state.touched = False


def is_whole(state: TrainState) -> bool:
    """Return True if all parameters are finite; False if they are not or cannot be checked."""
    try:
        return are_parameters_finite(state)
    except Exception:
        # This fails if the last step failed, if the check needs more memory than available, or if
        # the GPU failed.
        return False
