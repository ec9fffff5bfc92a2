"""TrainState to checkpoint and back."""

from dataclasses import asdict
from typing import Any, Final, cast

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.adam_state import AdamState
from crossgrad_core.contract.contexts import StepRecord
from crossgrad_core.contract.state import Json
from crossgrad_core.errors import UserError
from crossgrad_core.run.checkpoint.contents import Checkpoint
from crossgrad_core.system.version import VERSION
from crossgrad_core.training import averaging
from crossgrad_core.training.clock import Clock
from crossgrad_core.training.per_image_params import check_photos_are
from crossgrad_core.training.rngs import restored_streams, stream_states
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import Counters, TrainState
from crossgrad_core.wording import in_one_line, listed

#: Settings that say nothing about what was trained, or that a run which goes on may have changed:
#: where things lie, when there is a look at them, how many faults are borne, and a length that
#: follows the clock.
_LOOSE: Final = frozenset(
    {
        "clock",
        "device",
        "eval_every",
        "decided",
        "eval_from",
        "exporter",
        "exposure_from",
        "max_nonfinite_blocks",
        "max_views",
        "metrics",
        "observers",
        "out",
        "plan",
        "planned_seconds",
        "planned_views",
        "data",
        "revised",
        "revisions",
        "save_every",
        "scene",
        "seconds",
        "stop_after",
        "threads",
    }
)
#: The component that another machine may not have.
_DRAWN: Final = "rasterizer"
#: Whether the length follows a clock.
_TIMED: Final = "follows the clock"


def settings_of(config: RunConfig) -> dict[str, Json]:
    """What trains a run, flat (`loss.ssim_weight`), and the version that does."""
    loose = set(_LOOSE)
    if config.planned_seconds is None:
        loose -= {"revisions"}
    else:
        loose |= {"steps"}  # The clock may have changed them.
    data = config.model_dump(mode="json", exclude=loose)
    del data[_DRAWN]["name"]  # What draws on this machine; how it does is another matter.
    # What `opening` reads where a run that began with the usual ones has written none.
    data |= {
        "sh_from": config.sh_from or 0,
    }
    flat: dict[str, Json] = {"crossgrad": VERSION}
    for key, value in data.items():
        inner = value.items() if isinstance(value, dict) else ()
        flat |= {f"{key}.{name}": each for name, each in inner} or {key: value}
    return {**flat, _TIMED: config.planned_seconds is not None}


def to_checkpoint(state: TrainState, config: RunConfig | None = None) -> Checkpoint:
    """The state as a checkpoint; tensors are shared, not copied.

    Args:
        state: The state.
        config: What trained it, where that is to be held against what it is read with.
    """
    scalars: dict[str, Any] = {
        "settings": {} if config is None else settings_of(config),
        "clock": asdict(state.clock),
        "counters": asdict(state.counters),
        "rewinds": state.rewinds,
        "last": None if state.last is None else asdict(state.last),
    }
    return Checkpoint(
        step=state.step,
        parameters={name: tensor.detach() for name, tensor in state.parameters.items()},
        exp_avg=state.adam.exp_avg,
        exp_avg_sq=state.adam.exp_avg_sq,
        adam_steps=state.adam.steps,
        plugins=state.states,
        generators=stream_states(state.rngs),
        scalars=cast("dict[str, Json]", scalars),
    )


def from_checkpoint(setup: Setup, checkpoint: Checkpoint) -> TrainState:
    """The state that continues bit for bit where the checkpoint was written.

    Raises:
        UserError: It is not a state of this run: of another backbone, of other photos, or damaged.
    """
    _check_tensors(setup, checkpoint)
    try:
        state = _restored(setup, checkpoint)
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise _misfit(checkpoint, "the state of a run", in_one_line(error)) from error
    check_photos_are(setup, state)
    average = state.states.get(averaging.STATE)
    if average is not None and not averaging.fits(average, state.parameters):
        raise _misfit(checkpoint, "sums in the shapes of the parameters", "another average")
    return state


def check_settings(config: RunConfig, checkpoint: Checkpoint) -> None:
    """Refuses a state that other settings have trained: its figures would be filed under these.

    Raises:
        UserError: Some that train are not those of the checkpoint.
    """
    stored = checkpoint.scalars.get("settings")
    if not isinstance(stored, dict) or stored.get("crossgrad") != VERSION:
        return  # Of a version that wrote none, or whose settings may have other names.
    ours = settings_of(config)
    # A setting that came later is none that was changed; an option of a component may be.
    known = {key.partition(".")[0] for key in stored}
    both = {key for key in ours.keys() | stored.keys() if key.partition(".")[0] in known}
    # Another rasterizer has other options, and a length that follows the clock is none of these.
    either = {_DRAWN, "steps", "revisions", "revised"}
    both -= {k for k in ours.keys() ^ stored.keys() if k.partition(".")[0] in either}
    changed = sorted(key for key in both if ours.get(key) != stored.get(key))
    if changed:
        raise UserError(
            "config.yaml was changed since this run began",
            where=f"settings {listed(changed)}; step {checkpoint.step}",
            expected=listed(f"{key}: {stored.get(key)}" for key in changed),
            found=listed(f"{key}: {ours.get(key)}" for key in changed),
            todo="put them back, or start a new run with the changed file (--config)",
        )


def _restored(setup: Setup, checkpoint: Checkpoint) -> TrainState:
    scalars = cast("dict[str, Any]", checkpoint.scalars)
    trained = {name for block in setup.trained_blocks for name in block.tensors}
    device = setup.device
    return TrainState(
        tensors={
            name: tensor.to(device).requires_grad_(name in trained)
            for name, tensor in checkpoint.parameters.items()
        },
        moments=AdamState(
            exp_avg={name: tensor.to(device) for name, tensor in checkpoint.exp_avg.items()},
            exp_avg_sq={name: tensor.to(device) for name, tensor in checkpoint.exp_avg_sq.items()},
            steps=dict(checkpoint.adam_steps),
        ),
        rngs=restored_streams(checkpoint.generators),
        states={name: state.to(device) for name, state in checkpoint.plugins.items()},
        step=checkpoint.step,
        last=_record(scalars["last"]),
        counters=Counters(**_figures(scalars["counters"])),
        clock=_clock(scalars["clock"]),
        rewinds=scalars["rewinds"],
    )


def _clock(plain: dict[str, Any]) -> Clock:
    phases = _figures(plain["phases"])
    rest = {name: value for name, value in plain.items() if name != "phases"}
    return Clock(**_figures(rest), phases=phases)


def _figures(plain: dict[str, Any]) -> dict[str, Any]:
    wrong = [name for name, value in plain.items() if not isinstance(value, int | float)]
    if wrong:
        raise TypeError(f"{listed(wrong)} is not a number")
    return plain


def _check_tensors(setup: Setup, checkpoint: Checkpoint) -> None:
    parameters = checkpoint.parameters
    wanted = [name for block in setup.blocks for name in block.tensors]
    missing = [name for name in wanted if name not in parameters]
    if missing:
        raise _misfit(checkpoint, f"parameters {listed(wanted)}", f"no {listed(missing)}")
    # Frozen ones may be whole numbers, such as the levels of an octree.
    trained = [name for block in setup.trained_blocks for name in block.tensors]
    whole = [name for name in trained if not parameters[name].is_floating_point()]
    if whole:
        raise _misfit(checkpoint, "floating-point numbers to train", listed(whole))
    rows = {
        parameters[name].shape[:1]
        for block in setup.blocks
        if block.per_primitive
        for name in block.tensors
    }
    if len(rows) > 1:
        raise _misfit(checkpoint, "as many rows of one parameter as of another", str(sorted(rows)))
    for moments in (checkpoint.exp_avg, checkpoint.exp_avg_sq):
        for name, tensor in moments.items():
            if name not in parameters or tensor.shape != parameters[name].shape:
                raise _misfit(checkpoint, "moments in the shapes of the parameters", name)


def _misfit(checkpoint: Checkpoint, expected: str, found: str) -> UserError:
    return UserError(
        "the checkpoint does not fit the run",
        where=f"the checkpoint of step {checkpoint.step}",
        expected=expected,
        found=found,
        todo="restore the config.yaml that the run wrote, continue from an earlier checkpoint, or "
        "start the run again",
    )


def _record(plain: dict[str, Any] | None) -> StepRecord | None:
    if plain is None:
        return None
    labels = plain["labels"]
    return StepRecord(
        **{
            **plain,
            "views": tuple(plain["views"]),
            "names": tuple(plain["names"]),
            "labels": None if labels is None else tuple(labels),
            "losses": tuple(plain["losses"]),
            "scales": tuple(plain.get("scales", ())),
        }
    )
