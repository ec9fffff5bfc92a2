"""The resolution of a run that names none."""

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.backbone import Backbone
from crossgrad_core.contract.densifier import Densifier
from crossgrad_core.contract.pace import ViewsPerStepSpec
from crossgrad_core.contract.schedule import REFERENCE, is_published
from crossgrad_core.defaults import RESOLUTION, SHORT_RESOLUTION
from crossgrad_core.training.schedules import growth_by


def usual_resolution(
    config: RunConfig,
    views: ViewsPerStepSpec,
    backbone: Backbone,
    densifier: Densifier,
    device: str,
) -> str:
    """Some of the pixels first in short runs on a CPU, where pixels are most of a step; else all.

    Published schedules, and runs as long as the published ones, have all pixels. So have anchors
    and filters, of which nothing is measured, and growth that no budget leads: of fewer pixels the
    norms of gradients are larger, which only growth reads.

    Args:
        config: The configuration.
        views: K over the run.
        backbone: Its backbone.
        densifier: Its densifier.
        device: The type of its device.
    """
    led = not densifier.edits or growth_by(config, budgeted=densifier.budgeted) == "curve"
    suits = led and is_plain(backbone) and device == "cpu"
    return SHORT_RESOLUTION if suits and counts_as_short(config, views) else RESOLUTION


def is_plain(backbone: Backbone) -> bool:
    """Whether a backbone has Gaussians with axes of their own, drawn as published."""
    return bool(backbone.axes) and backbone.response == "plain"


def counts_as_short(config: RunConfig, views: ViewsPerStepSpec) -> bool:
    """Whether a run is shorter than published ones, and has not their schedule or rules.

    A run within seconds counts as short: its length is not known.

    Args:
        config: The configuration.
        views: K over the run.
    """
    if config.preset == "inria" or is_published(config.schedule, config.reference):
        return False
    steps = config.steps if config.max_views is None else views.steps_of(config.max_views)
    return config.seconds is not None or (steps or REFERENCE) < REFERENCE
