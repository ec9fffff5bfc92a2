"""The learning rates of a step and how Adam averages in it."""

from collections.abc import Iterator
from math import sqrt
from typing import Final

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.adam_state import BETAS, AdamRule
from crossgrad_core.contract.blocks import LearningRate, Parameters
from crossgrad_core.contract.schedule import REFERENCE, SHORT, Schedule, shortness
from crossgrad_core.errors import UserError
from crossgrad_core.training.averaging import tail_lr_factor
from crossgrad_core.training.setup import Setup
from crossgrad_core.wording import listed

#: The published rates are for `REFERENCE` steps. A run of fewer has them times the ratio of the two
#: to this power: what its rates add up to falls with its length, but not as fast as the length.
SHORTNESS: Final = 0.45
#: ... and never more than this: what a run of some 1,000 steps has.
MOST: Final = 4.5

#: A run that shows a training photo fewer times than this, in the mean, is in a hurry.
HURRY: Final = 40
#: Its rates fall with this power of the length, and from here.
HURRIED_SHORTNESS: Final = 0.65
HURRIED_MOST: Final = 6.3
#: The second moment of Adam averages over the last steps, of such a run over this part of its
#: steps, though not over fewer than so many: gradients of the first steps are much larger than
#: later ones, which they would hold back for the 1,000 steps of the published average.
#: All measured by us (docs/schedules.md).
MEMORY, LEAST_MEMORY = 1 / 50, 50

#: The decay of the first moment in short runs, which then averages over 3 steps, not 10.
#: Measured by us (docs/schedules.md).
SHORT_BETA1: Final = 0.7

_RATES: Final = f"learning rates: those for {REFERENCE:,} steps (--rate-factor 1) times"

#: Columns of positions, of the logarithms of standard deviations, and of rotations.
_AXES: Final = (3, 3, 4)

#: Blocks that learn in one of n steps have n to this power times their rate then.
RESTED: Final = 0.5


def in_a_hurry(config: RunConfig, schedule: Schedule, photos: int) -> bool:
    """Whether a run was planned to end long before it has learnt its photos by heart.

    Then it has rules of its own, which stay if the clock makes it longer or shorter; not where the
    decay of the second moment is given.

    Args:
        config: The run's.
        schedule: Its schedule.
        photos: Number of its training photos.
    """
    return shows_few_times(config, schedule.pace.views(_planned(config, schedule)), photos)


def shows_few_times(config: RunConfig, views: int, photos: int) -> bool:
    """The same of a run that is planned to draw so many views."""
    usual = config.beta2 is None and config.preset != "inria"
    return usual and views < min(REFERENCE, HURRY * photos)


def factor_of(config: RunConfig, schedule: Schedule, photos: int) -> float:
    """What all rates of the backbone are multiplied by; arguments as of `in_a_hurry`."""
    if config.rate_factor is not None or config.preset == "inria":
        return config.rate_factor or 1.0
    hurried = in_a_hurry(config, schedule, photos)
    power, most = (HURRIED_SHORTNESS, HURRIED_MOST) if hurried else (SHORTNESS, MOST)
    return min(max(1.0, float((REFERENCE / _length(schedule)) ** power)), most)


def betas_of(setup: Setup) -> tuple[float, float]:
    """The decay of Adam's moments in a run; under the batch rule those for one view per step."""
    config, schedule = setup.config, setup.schedule
    first, second = _first_beta(setup), BETAS[1]
    if config.beta2 is not None:
        return first, config.beta2
    if not in_a_hurry(config, schedule, len(setup.train_views)):
        return first, second
    steps, memory = _planned(config, schedule), _memory(config, schedule)
    if config.batch_rule == "sqrt":
        # K times as fast with K views per step; the floor is one of steps all the same.
        memory *= schedule.pace.views(steps) / steps
    return first, min(second, 1.0 - 1.0 / memory)


def _first_beta(setup: Setup) -> float:
    """The decay of Adam's first moment."""
    config, schedule = setup.config, setup.schedule
    if config.beta1 is not None:
        return config.beta1
    if not _forgets(setup):
        return BETAS[0]
    views = schedule.pace.views(_planned(config, schedule))
    return BETAS[0] - (BETAS[0] - SHORT_BETA1) * shortness(views)


def _forgets(setup: Setup) -> bool:
    """Whether the first moment of a short run may average over fewer steps than as published.

    Not where the batch rule says over how many, nor with anchors, of which short runs ended lower.
    """
    config = setup.config
    usual = config.preset != "inria" and config.batch_rule == "none"
    return usual and config.beta1 is None and bool(setup.backbone.axes)


def _length(schedule: Schedule) -> int:
    """Steps of the run as its schedule has it now, which the clock may change."""
    return schedule.total if schedule.mode == "scaled" else schedule.step_of(schedule.length)


def _planned(config: RunConfig, schedule: Schedule) -> int:
    """Steps of the run as it was planned."""
    return (schedule.mode == "scaled" and config.steps) or _length(schedule)


def _memory(config: RunConfig, schedule: Schedule) -> float:
    """Steps that the second moment averages over in a hurried run."""
    return max(LEAST_MEMORY, MEMORY * _planned(config, schedule))


def notes_on(setup: Setup) -> tuple[str, ...]:
    """How rates and Adam differ from what is published, where the run asked for nothing."""
    config, schedule, photos = setup.config, setup.schedule, len(setup.train_views)
    if config.preset == "inria":
        return ()
    # The length of a run within a budget is not known yet.
    if config.seconds is not None and schedule.mode != "absolute":
        return tuple(_rules(setup))
    notes, factor = [], factor_of(config, schedule, photos)
    if config.rate_factor is None and factor != 1.0:
        notes.append(f"{_RATES} {factor:.3g}")
    first, published = _first_beta(setup), BETAS[0]
    if config.beta1 is None and first != published:
        notes.append(f"Adam's first moment: beta1 {first:.3g} (--set beta1={published}: published)")
    if in_a_hurry(config, schedule, photos):
        notes.append(_hurry_note(setup))
    return tuple(notes)


def _rules(setup: Setup) -> Iterator[str]:
    """How they are going to differ, by the length that a budget allows."""
    config = setup.config
    ratio = f"({REFERENCE:,} / steps)"
    if config.rate_factor is None:
        yield f"{_RATES} {ratio}^{SHORTNESS}, at most {MOST}"
    if _forgets(setup):
        yield (
            f"Adam's first moment: beta1 {SHORT_BETA1} where the steps draw up to {SHORT:,} "
            f"views, {BETAS[0]} as published from {REFERENCE:,} on"
        )
    if config.beta2 is None and setup.train_views:
        rates = f"{ratio}^{HURRIED_SHORTNESS}, at most {HURRIED_MOST}, {_own_rates(setup)}"
        memory = f"Adam's second moment averages over a {1 / MEMORY:.0f}th of the steps"
        yield (
            f"if these are fewer than {HURRY} views of each training photo: "
            f"{rates if config.rate_factor is None else ''}{memory}, {LEAST_MEMORY} at least"
        )


def _own_rates(setup: Setup) -> str:
    """The blocks whose rates a hurried run multiplies beside all others."""
    own = [each for each in setup.trained_blocks if each.lr.hurried != 1.0]
    return "".join(
        f"{each.name} at {each.lr.hurried:g} times the rate of the rest, " for each in own
    )


def note_on_plan(setup: Setup) -> tuple[str, ...]:
    """Which rules a run within a budget has, once its length is planned."""
    config, schedule = setup.config, setup.schedule
    hurried = in_a_hurry(config, schedule, len(setup.train_views))
    return (_hurry_note(setup),) if hurried else ()


def note_on_axes(setup: Setup) -> tuple[str, ...]:
    """How positions step, where that is not as published and the run did not ask for it."""
    if setup.config.position_lr is not None or axes_of(setup) is None:
        return ()
    return (
        "positions step along the axes of their Gaussians, by shares of their lengths "
        "(--position-lr extent: by the scene's extent, as published)",
    )


def _hurry_note(setup: Setup) -> str:
    config, schedule = setup.config, setup.schedule
    rates = _own_rates(setup) if config.rate_factor is None else ""
    return (
        f"fewer than {HURRY} views of each training photo: "
        f"{rates}Adam's second moment averages over {_memory(config, schedule):,.0f} steps "
        "(--set beta2=0.999 has what longer runs have)"
    )


def axes_of(setup: Setup) -> tuple[str, str, str] | None:
    """Tensors of positions, scales and rotations, where positions step along axes; else None.

    Runs as long as the published ones have the published steps.
    """
    config = setup.config
    by_size = is_short(config, setup.schedule)
    if config.position_lr is not None:
        by_size = config.position_lr == "per-axis"
    return gaussians_of(setup) if by_size else None


def is_short(config: RunConfig, schedule: Schedule) -> bool:
    """Whether a run is shorter than published ones, and has not their rules.

    Before the length of a run within a budget is planned it counts as short: its kernels are then
    there, whatever is planned.
    """
    waits = config.seconds is not None and config.steps is None and schedule.mode == "scaled"
    short = waits or _planned(config, schedule) < REFERENCE
    return short and config.preset != "inria"


def gaussians_of(setup: Setup) -> tuple[str, str, str] | None:
    """Tensors of positions, scales and rotations; None where primitives are no Gaussians of those.

    And where rows of these are not all up to date, as they may be stepped by rows.
    """
    names = setup.backbone.positions, *setup.backbone.axes
    late = not set(setup.backbone.passthrough.values()).isdisjoint(names)
    return names if all(names) and len(names) == len(_AXES) and not late else None


def check_axes(setup: Setup, parameters: Parameters) -> None:
    """Refuses tensors of other shapes than those that `Backbone.axes` promises.

    Raises:
        UserError: It names the backbone.
    """
    if (names := gaussians_of(setup)) is None:
        return
    rows = len(parameters[names[0]]) if names[0] in parameters else 0
    found = [tuple(parameters[each].shape) if each in parameters else None for each in names]
    if found != [(rows, columns) for columns in _AXES]:
        raise UserError(
            "the axes that the backbone names are none of Gaussians",
            where=f"backbone {setup.selection.names['backbone']}, axes {listed(names)}",
            expected=f"tensors {listed(f'[N, {columns}]' for columns in _AXES)}",
            found=listed(map(str, found)),
            todo="repair the plugin (docs/write-a-backbone.md), or --position-lr extent --set "
            "max_scale_ratio=0",
        )


def rates_at(setup: Setup, step: int) -> dict[str, float]:
    """Name of each trained tensor -> its learning rate in a step."""
    every = setup.schedule.sh_every
    return {
        name: rate_at(setup, block.lr, step) * (every**RESTED if block.rests else 1.0)
        for block in setup.trained_blocks
        for name in block.tensors
    }


def means_rate_at(setup: Setup, step: int) -> float:
    """The learning rate of the primitives' positions in a step; 0 where they do not move."""
    rates = {block.name: block.lr for block in setup.blocks}
    return rate_at(setup, rates.get("means", LearningRate(0.0)), step)


def rate_at(setup: Setup, rate: LearningRate, step: int) -> float:
    """A learning rate of the backbone in a step: of the schedule, times what the run asks for."""
    config, schedule, photos = setup.config, setup.schedule, len(setup.train_views)
    factor = factor_of(config, schedule, photos)
    if config.rate_factor is None and in_a_hurry(config, schedule, photos):
        factor *= rate.hurried
    factor *= tail_lr_factor(config, rate, step=step, total=schedule.total)
    if config.batch_rule == "sqrt":
        factor *= sqrt(schedule.pace.at(step))
    return rate.at(schedule.progress(step)) * factor


def rule_at(setup: Setup, step: int) -> AdamRule:
    """How Adam averages in a step."""
    betas = betas_of(setup)
    if setup.config.batch_rule == "none":
        return AdamRule(betas)
    pace = setup.schedule.pace
    views = pace.at(step)
    return AdamRule.for_views(views, pace.views(step) / (step * views), betas)
