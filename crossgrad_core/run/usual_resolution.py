"""The resolution of a run that names none."""

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.backbone import Backbone
from crossgrad_core.contract.pace import ViewPlan
from crossgrad_core.contract.schedule import REFERENCE
from crossgrad_core.defaults import RESOLUTION, SHORT_RESOLUTION


def usual_resolution(config: RunConfig, views: ViewPlan, backbone: Backbone) -> str:
    """Some of the pixels in short runs on a CPU, where pixels are most of a step; else all.

    Published schedules and runs as long as the published ones have all pixels, and so have
    backbones whose pixels are means over their area. A run within seconds counts as short: its
    length is not known yet.
    """
    published = config.preset == "inria" or (
        config.schedule == "absolute" and config.reference is None
    )
    steps = config.steps if config.max_views is None else views.steps_of(config.max_views)
    short = config.seconds is not None or (steps or REFERENCE) < REFERENCE
    suits = short and not published and backbone.response != "analytic"
    return SHORT_RESOLUTION if suits and config.device == "cpu" else RESOLUTION
