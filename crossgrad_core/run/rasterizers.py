"""Which rasterizer draws where the user names none, or where that of a run has no device."""

import logging
from dataclasses import dataclass

from crossgrad_core.config import AUTO, ComponentChoice, RunConfig
from crossgrad_core.contract.gaussians import Response
from crossgrad_core.contract.rasterizer import Rasterizer
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import entries, load
from crossgrad_core.wording import in_one_line, listed

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Wanted:
    """The demands of a run on its rasterizer.

    Attributes:
        device: Torch device type.
        response: The backbone's pixel response.
        outputs: Optional outputs that the densifier needs.
        options: Options that a preset sets.
    """

    device: str
    response: Response
    outputs: frozenset[str] = frozenset()
    options: frozenset[str] = frozenset()

    def lacking(self, rasterizer: type[Rasterizer]) -> tuple[str, ...]:
        """What of it a rasterizer cannot do."""
        return tuple(
            sorted(
                ({self.response} - rasterizer.responses)
                | (self.outputs - rasterizer.provides)
                | (self.options - rasterizer.model_fields.keys())
            )
        )


def choose_rasterizer(name: str, wanted: Wanted) -> tuple[str, tuple[str, ...]]:
    """The name of the rasterizer, and notes on why it was chosen.

    Every installed one says how fast it is on the device; the fastest that can do what is wanted is
    taken, of equally fast ones the first by name. One that cannot be imported is left out.

    Args:
        name: What the user asked for; `auto` leaves it open.
        wanted: What the run asks of it.

    Raises:
        UserError: It is left open, and no installed rasterizer runs on the device.
    """
    if name != AUTO:
        return name, (f"rasterizer {name}: asked for",)
    speeds, notes = _speeds(wanted)
    if not speeds:
        raise UserError(
            f"no installed rasterizer runs on device {wanted.device}",
            where="--rasterizer",
            todo="install one, or use --device cpu",
        )
    chosen = min(speeds, key=lambda each: (-speeds[each], each))
    others = [each for each in speeds if each != chosen]
    why = f"the fastest of {len(speeds)} here" if others else "the only one here that runs"
    return chosen, (*notes, f"rasterizer {chosen}: {why} on {wanted.device}")


def drawn_elsewhere(config: RunConfig) -> RunConfig:
    """A run's configuration for another device, with a rasterizer that runs there.

    It keeps the options that every one which might be chosen has.

    Raises:
        UserError: The run's own rasterizer is not installed.
    """
    name, device = config.rasterizer.name, config.device.partition(":")[0]
    if name == AUTO or device in load(Rasterizer, name).devices:
        return config
    others, _ = _speeds(Wanted(device, "plain"))
    if not others:
        return config
    shared = set.intersection(*(set(load(Rasterizer, each).model_fields) for each in others))
    kept = {key: value for key, value in config.rasterizer.options.items() if key in shared}
    _LOG.warning("rasterizer %s does not run on %s: another one draws", name, device)
    choice = ComponentChoice.model_validate({"name": AUTO, **kept})
    return config.model_copy(update={"rasterizer": choice})


def _speeds(wanted: Wanted) -> tuple[dict[str, float], tuple[str, ...]]:
    """Name -> speed of those that do all that is wanted, or else of all; notes on the others."""
    able: dict[str, float] = {}
    running: dict[str, float] = {}
    notes = []
    for name in entries("rasterizers"):
        try:
            rasterizer = load(Rasterizer, name)
            speed = rasterizer.speed(wanted.device)
        except Exception as error:
            why = getattr(error, "what", in_one_line(error))
            notes.append(f"rasterizer {name} left out: {why}")
            continue
        if speed > 0.0:
            running[name] = speed
            if lacks := wanted.lacking(rasterizer):
                notes.append(f"rasterizer {name} left out: this run needs {listed(lacks)}")
            else:
                able[name] = speed
    return able or running, tuple(notes)
