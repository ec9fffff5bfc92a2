"""Statistics for growing and pruning anchors: running sums per anchor and per offset."""

from collections.abc import Mapping

import torch
from torch import Tensor

from crossgrad_core.plugin import DensifyContext, PluginState, ViewRecord, screen_statistics

#: Sums per anchor [P]: of the opacities of its Gaussians, and of the views that decoded it.
OPACITY, VIEWS = "opacity", "views"
#: Sums per offset [P, k]: of the gradient norms of its Gaussian, and of the renders showing it.
GRADIENT, RENDERS = "gradient", "renders"


def observed(context: DensifyContext, state: PluginState) -> PluginState:
    """The sums with the views of this step added.

    Source: Scaffold-GS, section 3.3; methods of section 2.5.
    """
    totals = _copies(context, state)
    for record in context.views:
        _add(record, totals)
    return PluginState(per_primitive=totals)


def _copies(context: DensifyContext, state: PluginState) -> dict[str, Tensor]:
    offsets = context.parameters["offsets"]
    anchors, slots = offsets.shape[:2]
    shapes: dict[str, tuple[int, ...]] = {OPACITY: (anchors,), VIEWS: (anchors,)}
    shapes |= {GRADIENT: (anchors, slots), RENDERS: (anchors, slots)}
    have = state.per_primitive
    return {
        name: have[name].clone() if name in have else offsets.new_zeros(shape)
        for name, shape in shapes.items()
    }


def _add(record: ViewRecord, totals: Mapping[str, Tensor]) -> None:
    gaussians = record.gaussians
    origin, slot = gaussians.origin, gaussians.slot
    if origin is None or slot is None:
        raise RuntimeError("the backbone does not say which offset a Gaussian comes from")
    views = totals[VIEWS]
    views += 1.0 if gaussians.decoded is None else gaussians.decoded
    totals[OPACITY].index_add_(0, origin, gaussians.opacities.clamp(min=0.0))
    seen = screen_statistics.visible(record)
    place = origin * totals[RENDERS].shape[1] + slot
    norms = torch.linalg.vector_norm(screen_statistics.ndc_gradient(record), dim=1)
    totals[GRADIENT].view(-1).index_add_(0, place, norms * seen)
    totals[RENDERS].view(-1).index_add_(0, place, seen)
