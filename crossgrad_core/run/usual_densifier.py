"""The densifier of a run that names none."""

from typing import Final

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.backbone import Backbone
from crossgrad_core.contract.densifier import Densifier
from crossgrad_core.contract.pace import ViewsPerStepSpec
from crossgrad_core.contract.rasterizer import Rasterizer
from crossgrad_core.contract.schedule import REFERENCE
from crossgrad_core.defaults import DENSIFIER, SHORT_DENSIFIER
from crossgrad_core.registry.entries import load
from crossgrad_core.run.rasterizers import Wanted, choose_rasterizer
from crossgrad_core.run.usual_device import with_device
from crossgrad_core.run.usual_resolution import counts_as_short, is_plain
from crossgrad_core.training.schedules import growth_by

#: Training photos from which on it pays in a short run to grow wherever pixels pull; with fewer it
#: learns these few by heart. Measured by us (docs/schedules.md).
MANY_PHOTOS: Final = 100


def usual_densifier(
    config: RunConfig, views: ViewsPerStepSpec, backbone: Backbone, photos: int
) -> str:
    """The backbone's; in short runs of many photos one that asks where pixels pull, whichever way.

    Where a budget leads growth, what counts is which Gaussians ask the most, not how many ask
    enough. Measured there, on a CPU, with plain Gaussians.

    Args:
        config: The configuration.
        views: K over the run.
        backbone: Its backbone.
        photos: Training photos.
    """
    usual = backbone.default_densifier
    suits = usual == DENSIFIER and is_plain(backbone) and photos >= MANY_PHOTOS
    led = suits and _is_led(config, views)
    here = led and with_device(config)[0].device.partition(":")[0] == "cpu"
    return SHORT_DENSIFIER if here and _is_heard(config, backbone) else usual


def _is_led(config: RunConfig, views: ViewsPerStepSpec) -> bool:
    """Whether a budget leads growth, which the published length has none of; `is_led` by views."""
    if growth_by(config, budgeted=True) != "curve" or not counts_as_short(config, views):
        return False
    # That of a run within seconds is not known.
    steps = config.steps or 1
    length = config.max_views or views.paced(steps).views(steps)
    return max(length, config.reference or 0) < REFERENCE


def _is_heard(config: RunConfig, backbone: Backbone) -> bool:
    """Whether the rasterizer that would draw says what that densifier asks for.

    None is left out for a densifier that nobody asked for.
    """
    name, _ = choose_rasterizer(config.rasterizer.name, Wanted("cpu", backbone.response))
    return load(Densifier, SHORT_DENSIFIER).needs <= load(Rasterizer, name).provides
