"""From the outputs of the networks to Gaussians, in plain torch: the readable reference."""

from dataclasses import dataclass

import torch
from torch import Tensor

from crossgrad_backbones.anchors.heads import COVARIANCE, Raw
from crossgrad_core.numerics.elementwise import sigmoid
from crossgrad_core.plugin import Gaussians


@dataclass(frozen=True)
class Seen:
    """The anchors that a view decodes.

    Attributes:
        rows: [A] int64, their rows, each once.
        factor: [A] in [0, 1], what multiplies the opacities of each; None: 1.
    """

    rows: Tensor
    factor: Tensor | None = None


def activated(
    raw: Raw, positions: Tensor, offsets: Tensor, log_scales: Tensor, seen: Seen
) -> Gaussians:
    """The Gaussians whose opacity is positive, anchor by anchor, slot by slot.

    Gaussian j of anchor a has the mean x_a + offset_aj exp(l1_a), the opacity tanh(raw), the scales
    exp(l2_a) sigmoid(raw) and the colour sigmoid(raw). Quaternions keep their length, which no
    rasterizer depends on.

    Args:
        raw: Outputs for A anchors of k Gaussians.
        positions: [P, 3] of all anchors.
        offsets: [P, k, 3] of all anchors.
        log_scales: [P, 6] of all anchors: l1, then l2.
        seen: Which anchors the outputs are for.

    Returns:
        Gaussians with `colors`, `origin` and `slot`.

    Source: Scaffold-GS, section 3.2; methods of section 2.2.
    """
    opacities = torch.tanh(raw.opacities)  # [A, k]
    if seen.factor is not None:
        opacities = opacities * seen.factor[:, None]
    anchor, slot = (opacities.detach() > 0).nonzero().unbind(1)
    origin = seen.rows[anchor]
    stretch, size = torch.split(torch.exp(log_scales[origin]), 3, 1)
    slots = opacities.shape[1]
    covariances = raw.covariances.view(-1, slots, COVARIANCE)[anchor, slot]
    colors = raw.colors.view(-1, slots, 3)[anchor, slot]
    return Gaussians(
        means=positions[origin] + offsets[origin, slot] * stretch,
        quats=covariances[:, 3:],
        scales=size * sigmoid(covariances[:, :3]),
        opacities=opacities[anchor, slot],
        colors=sigmoid(colors),
        origin=origin,
        slot=slot,
    )
