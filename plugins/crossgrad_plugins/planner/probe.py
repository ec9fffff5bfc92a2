"""A short training run that measures gradients, because cameras and photos do not show them."""

from dataclasses import dataclass
from math import nan, sqrt
from typing import Final, cast

from crossgrad_core.commands import (
    ComponentChoice,
    Progress,
    RunConfig,
    TrainingFailedError,
    UserError,
)
from crossgrad_plugins.diagnostics.app import Options, diagnose_scene
from crossgrad_plugins.diagnostics.table import ALL, Row, rows_of

#: Gradients are measured in Adam's metric, because the optimizer divides them in this way.
_METRIC: Final = "adam"
#: Half the width of a 95 % interval, in standard errors.
_WIDE: Final = 1.96


@dataclass(frozen=True)
class Probe:
    """Statistics of the gradients of single views after a short run.

    Gradients are measured in Adam's metric, over all blocks.

    Attributes:
        rho: sigma_b^2 / sigma_w^2, the gradient variance between near and far views divided by the
            variance within them.
        rho_low: Lower end of the 95 % interval of rho.
        rho_high: Upper end of the 95 % interval of rho.
        noise_scale: Number of views per step up to which further views reduce noise.
        conflict: Share of pairs of a near and a far view whose gradients conflict.
        conflict_low: Lower end of the 95 % interval of `conflict`, which assumes one independent
            sample per view of the smaller group.
        problem: Reason why there are no values, or an empty text.
    """

    rho: float = nan
    rho_low: float = nan
    rho_high: float = nan
    noise_scale: float = nan
    conflict: float = nan
    conflict_low: float = nan
    problem: str = ""


def probed(config: RunConfig, seconds: float, grouping: ComponentChoice) -> Probe:
    """Train a vanilla run (one view per step) for some seconds, and return its measurements.

    Args:
        config: The configuration with a scene; its components are replaced.
        seconds: Training time in seconds.
        grouping: The grouping into near and far views.
    """
    Progress().tell(f"training for {seconds:g} seconds to measure gradients")
    length = {"steps": None, "max_views": None, "seconds": seconds, "plan": "off"}
    options = Options(grouping=grouping, probes=1, seconds=seconds, seed=config.seed)
    try:
        report = diagnose_scene(config.model_copy(update=length), options)
    except (UserError, TrainingFailedError) as error:
        return Probe(problem=error.what if isinstance(error, UserError) else str(error))
    whole = [row for row in rows_of(report.probes, _METRIC) if row["block"] == ALL]
    return _of_row(whole[-1]) if whole else Probe(problem=report.failure or "no step was made")


def _of_row(row: Row) -> Probe:
    rate = cast("float", row["conflict_rate"])
    views = min(cast("int", row["near_views"]), cast("int", row["far_views"]))
    rho, low, high, noise = (
        cast("float", row[name]) for name in ("rho", "rho_low", "rho_high", "noise_scale")
    )
    lowest = rate - _WIDE * sqrt(0.25 / views)
    return Probe(rho, low, high, noise, rate, lowest)
