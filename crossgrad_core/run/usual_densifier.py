"""The densifier of a run that names none."""

from crossgrad_core.config import AUTO, RunConfig
from crossgrad_core.contract.backbone import Backbone
from crossgrad_core.contract.densifier import Densifier
from crossgrad_core.contract.pace import ViewPlan
from crossgrad_core.contract.rasterizer import Rasterizer
from crossgrad_core.defaults import DENSIFIER, SHORT_DENSIFIER
from crossgrad_core.registry.entries import load
from crossgrad_core.run.devices import choose_device
from crossgrad_core.run.usual_resolution import counts_as_short, is_plain
from crossgrad_core.training.schedules import growth_by


def usual_densifier(config: RunConfig, views: ViewPlan, backbone: Backbone) -> str:
    """The backbone's; in short runs on a CPU one that asks where pixels pull, whichever way.

    Where a budget leads growth, what counts is which Gaussians ask the most, not how many ask
    enough. Measured there, with plain Gaussians (docs/densifiers.md). Options without a name are
    those of the backbone's.

    Args:
        config: The configuration.
        views: K over the run.
        backbone: Its backbone.
    """
    usual = backbone.default_densifier
    suits = usual == DENSIFIER and config.densifier is None and is_plain(backbone)
    led = suits and growth_by(config, budgeted=True) == "curve" and counts_as_short(config, views)
    here = led and choose_device(config.device).type == "cpu" and _can_draw(config)
    return SHORT_DENSIFIER if here else usual


def _can_draw(config: RunConfig) -> bool:
    """Whether the rasterizer, where one is named, gives what that densifier needs."""
    name, needs = config.rasterizer.name, load(Densifier, SHORT_DENSIFIER).needs
    return name == AUTO or needs <= load(Rasterizer, name).provides
