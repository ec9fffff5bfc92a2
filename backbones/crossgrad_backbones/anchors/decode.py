"""Decoding anchors to the Gaussians that a camera sees."""

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from crossgrad_backbones.anchors.activation import Seen, activated
from crossgrad_backbones.anchors.fused_decode.data import View
from crossgrad_backbones.anchors.fused_decode.function import gaussians_of
from crossgrad_backbones.anchors.heads import Heads
from crossgrad_core.plugin import Camera, Gaussians


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
    eye = camera.center.to(positions, non_blocking=True)
    views = heads.views(positions.index_select(0, seen.rows) - eye)
    decode = _fused if _fusible(parameters) else _plain
    gaussians = decode(heads, parameters, seen, views, code)
    mask = torch.zeros(positions.shape[0], dtype=torch.bool, device=positions.device)
    return replace(gaussians, decoded=mask.index_fill_(0, seen.rows, value=True))


def _fusible(parameters: Mapping[str, Tensor]) -> bool:
    """Whether the fused decoding can be used: float32 on the CPU, and anchors that stay."""
    names = ("anchors", "offsets", "features", "scales")
    tensors = [parameters[name] for name in names]
    plain = all(each.device.type == "cpu" and each.dtype == torch.float32 for each in tensors)
    return plain and not parameters["anchors"].requires_grad


def _plain(
    heads: Heads,
    parameters: Mapping[str, Tensor],
    seen: Seen,
    views: Tensor,
    code: Tensor | None,
) -> Gaussians:
    features = parameters["features"].index_select(0, seen.rows)
    raw = heads.raw(parameters, features, views, code)
    positions, offsets, scales = (parameters[name] for name in ("anchors", "offsets", "scales"))
    return activated(raw, positions, offsets, scales, seen)


def _fused(
    heads: Heads,
    parameters: Mapping[str, Tensor],
    seen: Seen,
    views: Tensor,
    code: Tensor | None,
) -> Gaussians:
    features, rows = parameters["features"], seen.rows
    if heads.banked:
        features = heads.mixed(parameters, features.index_select(0, rows), views)
        rows = torch.arange(len(rows))
    view = View(parameters["anchors"], seen.rows, seen.factor, heads.inputs(views), rows)
    layers = [heads.first_layers(parameters, code), *heads.second_layers(parameters)]
    tensors = (features, parameters["offsets"], parameters["scales"])
    return gaussians_of(view, *tensors, *(each for layer in layers for each in layer))
