"""The choice of a rasterizer that supports the device and the requirements of a run."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass

from crossgrad_core.config import AUTO, ComponentChoice, RunConfig
from crossgrad_core.contract.gaussians import Response
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.errors import UserError
from crossgrad_core.recipe.table import is_complete, recipe_of
from crossgrad_core.registry.entries import entries, find, load, quick_answer
from crossgrad_core.wording import in_one_line, listed

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Wanted:
    """The requirements of a run on its rasterizer.

    Attributes:
        device: Torch device type.
        response: The value `response` of the backbone.
        outputs: Optional outputs that the densifier needs.
        options: Options that the user or the recipe sets.
    """

    device: str
    response: Response
    outputs: frozenset[str] = frozenset()
    options: frozenset[str] = frozenset()

    def lacking(self, rasterizer: type[Rasterizer]) -> tuple[str, ...]:
        """Return the requirements that a rasterizer does not meet."""
        return tuple(
            sorted(
                ({self.response} - rasterizer.responses)
                | (self.outputs - rasterizer.provides)
                | (self.options - rasterizer.model_fields.keys())
            )
        )


def demands(config: RunConfig, device: str, backbone: Backbone, densifier: Densifier) -> Wanted:
    """Return the requirements of a run on its rasterizer for a device type."""
    of_recipe = frozenset() if is_complete(config) else recipe_of(config).rasterizer_options
    return Wanted(
        device=device,
        response=backbone.response,
        outputs=densifier.needs,
        options=of_recipe | config.rasterizer.options.keys(),
    )


def choose_rasterizer(name: str, wanted: Wanted) -> tuple[str, tuple[str, ...]]:
    """Return the name of the rasterizer, and notes about the reason for the choice.

    Every installed rasterizer reports its speed on the device. The fastest rasterizer that meets
    the requirements is chosen. Among equally fast rasterizers, the first by name is chosen. If no
    rasterizer meets the requirements, the fastest rasterizer is chosen, and later checks report why
    this rasterizer cannot work. A rasterizer that cannot be imported is left out. Rasterizers
    slower than the chosen rasterizer are not imported.

    Args:
        name: The user's choice; `auto` if the user did not choose a rasterizer.
        wanted: The requirements of the run.

    Raises:
        UserError: The user named no rasterizer, and no installed rasterizer runs on the device.
    """
    if name != AUTO:
        return name, (f"rasterizer {name}: chosen by the user",)
    speeds, notes = speeds_on(wanted.device)
    if not speeds:
        raise UserError(
            f"no installed rasterizer runs on device {wanted.device}",
            where="--rasterizer",
            todo="install a rasterizer for this device, or use --device cpu",
        )
    chosen = fastest_able(speeds, wanted, notes) or _ranked(speeds)[0]
    why = (
        f"the fastest of {len(speeds)} usable rasterizers"
        if len(speeds) > 1
        else "the only usable rasterizer"
    )
    return chosen, (*notes, f"rasterizer {chosen}: {why} on {wanted.device}")


def fastest_able(speeds: Mapping[str, float], wanted: Wanted, notes: list[str]) -> str | None:
    """Return the fastest rasterizer that meets the requirements; None if no rasterizer does.

    Args:
        speeds: Name -> speed.
        wanted: The requirements of the run.
        notes: A line is added for each faster rasterizer that is left out.
    """
    for name in _ranked(speeds):
        try:
            lacks = wanted.lacking(load(Rasterizer, name))
        except UserError as error:
            notes.append(f"rasterizer {name} is not used: {error.what}")
            continue
        if not lacks:
            return name
        notes.append(f"rasterizer {name} is not used: this run needs {listed(lacks)}")
    return None


def drawn_elsewhere(config: RunConfig) -> RunConfig:
    """Return a run's configuration for another device, with a rasterizer that supports the device.

    The configuration keeps only options that all rasterizers for the device support.

    Raises:
        UserError: The run's own rasterizer is not installed.
    """
    name, device = config.rasterizer.name, config.device.partition(":")[0]
    if name == AUTO or device in load(Rasterizer, name).devices:
        return config
    others, _ = speeds_on(device)
    if not others:
        return config
    shared = set.intersection(
        *(set(load(Rasterizer, rasterizer).model_fields) for rasterizer in others)
    )
    kept = {key: value for key, value in config.rasterizer.options.items() if key in shared}
    _LOG.warning("rasterizer %s does not run on %s: another rasterizer is used", name, device)
    choice = ComponentChoice.model_validate({"name": AUTO, **kept})
    return config.model_copy(update={"rasterizer": choice})


def speeds_on(device: str) -> tuple[dict[str, float], list[str]]:
    """Return name -> speed of a device's rasterizers, and notes on broken rasterizers.

    A rasterizer whose package declares a separate speed function is not imported.
    """
    speeds: dict[str, float] = {}
    notes = []
    for name in entries("rasterizers"):
        try:
            quick = quick_answer(find("rasterizers", name))
            speed = float((load(Rasterizer, name).speed if quick is None else quick)(device))
        except Exception as error:
            why = getattr(error, "what", in_one_line(error))
            notes.append(f"rasterizer {name} is not used: {why}")
            continue
        if speed > 0.0:
            speeds[name] = speed
    return speeds, notes


def _ranked(speeds: Mapping[str, float]) -> list[str]:
    """Return the names in order of decreasing speed; ties are sorted by name."""
    return sorted(speeds, key=lambda name: (-speeds[name], name))
