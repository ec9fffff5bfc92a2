"""Parameters and Gaussians for contexts, of the kinds that hooks get in a training run.

A run brings rows of some tensors up to date only when a hook reads them, so its objects are no
plain dictionaries and Gaussians.
"""

from collections.abc import Mapping
from dataclasses import replace

from torch import Tensor

from crossgrad_core.contract.backbone import Backbone
from crossgrad_core.contract.blocks import AdamState
from crossgrad_core.contract.gaussians import Gaussians, OnDemand
from crossgrad_core.training.state import TrainState


def parameters_in_a_run(parameters: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """The same tensors in the mapping that a context of a run holds."""
    return TrainState(tensors=dict(parameters), moments=AdamState(), rngs={}).current


def gaussians_in_a_run(gaussians: Gaussians, backbone: Backbone) -> Gaussians:
    """The same Gaussians, whose tensors that the backbone passes on are brought when they are read.

    Nothing is late here, so bringing rows does nothing.
    """
    fields = frozenset(f for f in backbone.passthrough if getattr(gaussians, f) is not None)
    return replace(gaussians, on_demand=OnDemand(fields, lambda _: None)).whole()
