"""Decoding anchors to the Gaussians that a camera sees."""

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from crossgrad_backbones.anchors.activation import Seen, activated
from crossgrad_backbones.anchors.heads import Heads
from crossgrad_core.gaussians import Gaussians
from crossgrad_core.scene.types import Camera


def decoded(
    heads: Heads,
    parameters: Mapping[str, Tensor],
    camera: Camera,
    seen: Seen,
    code: Tensor | None = None,
) -> Gaussians:
    """The Gaussians of the given anchors as a camera sees them, differentiable.

    Args:
        heads: The networks.
        parameters: `anchors` [P, 3], `offsets` [P, k, 3], `features` [P, F], `scales` [P, 6] (log)
            and the tensors of the networks.
        camera: The camera.
        seen: The anchors to decode, and what multiplies their opacities.
        code: [C] appearance code, or None.

    Returns:
        Gaussians with `colors`, `origin`, `slot` and `decoded`; those whose opacity is not positive
        are left out.
    """
    positions = parameters["anchors"]
    eye = camera.center.to(positions)
    raw = heads.raw(
        parameters,
        parameters["features"].index_select(0, seen.rows),
        positions.index_select(0, seen.rows) - eye,
        code,
    )
    gaussians = activated(raw, positions, parameters["offsets"], parameters["scales"], seen)
    mask = torch.zeros(positions.shape[0], dtype=torch.bool, device=positions.device)
    return replace(gaussians, decoded=mask.index_fill_(0, seen.rows, value=True))
