"""Screen statistics of a rendered view at any scale, per Gaussian and per primitive.

All values are in units of the full photo. Gradients are with respect to NDC coordinates. Radii are
divided by the longer image side. Pixel counts refer to the photo at training resolution. Gradients
need no factor for the number of pixels, because a loss is a mean over pixels.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.contexts import DensifyContext, RenderedView


def half_size(record: RenderedView, like: Tensor) -> Tensor:
    """Return [2], half the width and height of the render: the pixels per NDC unit (3DGS)."""
    camera = record.camera
    return torch.tensor([camera.width / 2, camera.height / 2]).to(like, non_blocking=True)


def ndc_gradient(record: RenderedView, rows: Tensor | None = None) -> Tensor:
    """Return [N, 2], the gradient of the loss with respect to the projected means, in NDC.

    With `rows` [S], return [S, 2], the gradients of these Gaussians only.
    """
    return _of_rows(record, record.screen.mean_gradient, rows)


def ndc_abs_gradient(record: RenderedView, rows: Tensor | None = None) -> Tensor:
    """Return [N, 2], the absolute gradients with respect to the projected means, in NDC.

    The absolute values of the gradients of single pixels are summed over all pixels. With `rows`
    [S], return [S, 2], the sums of these Gaussians only.
    """
    return _of_rows(record, record.screen.abs_gradient, rows)


def _of_rows(record: RenderedView, statistic: Tensor | None, rows: Tensor | None) -> Tensor:
    gradient = _present(statistic)
    gradient = gradient if rows is None else gradient.index_select(0, rows)
    return gradient * half_size(record, gradient)


def directions(record: RenderedView) -> Tensor:
    """Return `Screen.directions` as [6, 5, N], with its absolute gradients converted to NDC.

    The dimensions are the 6 bins, the 5 numbers of each bin, and the Gaussians. With the Gaussians
    in the last dimension, sums over bins are sums of whole rows. Sums of whole rows are much faster
    on the CPU.
    """
    per_pixel = _present(record.screen.directions)
    bins = per_pixel.permute(1, 2, 0).clone(memory_format=torch.contiguous_format)
    bins[:, 2:4] *= half_size(record, bins)[:, None]
    return bins


def pixels(record: RenderedView) -> Tensor:
    """Return [N], the number of the full photo's pixels in which a Gaussian was blended (float)."""
    return of_photo(record, _present(record.screen.pixels))


def of_photo(record: RenderedView, counts: Tensor) -> Tensor:
    """Convert pixel counts [N] of the render to pixel counts of the full photo (float)."""
    counted = counts.to(record.gaussians.means)
    if record.scale == 1.0:
        return counted
    full, drawn = record.view.camera, record.camera
    return counted * (full.width * full.height / (drawn.width * drawn.height))


def radii(record: RenderedView) -> Tensor:
    """Return [N], the screen radius divided by the longer image side; 0 if no pixel is touched."""
    camera = record.camera
    return record.screen.radii.to(record.gaussians.means) / max(camera.width, camera.height)


def visible(record: RenderedView, rows: Tensor | None = None) -> Tensor:
    """Return [N], 1 if the Gaussian touched a pixel, else 0; with `rows`, only these rows."""
    radii = record.screen.radii
    radii = radii if rows is None else radii.index_select(0, rows)
    return (radii > 0).to(record.gaussians.means)


def seen(record: RenderedView) -> Tensor | None:
    """Return [S] int64 rows of the Gaussians that touched a pixel; sums need only these rows.

    On a GPU, return None, which means all rows, because a list of rows would make the host wait for
    the GPU.
    """
    radii, rows = record.screen.radii, record.screen.rows
    if not radii.is_cpu:
        return None
    if rows is None:
        return radii.nonzero()[:, 0]
    drawn = radii.index_select(0, rows) > 0
    # Avoid a copy if all listed Gaussians touch a pixel, which is the usual case.
    return rows if bool(drawn.all()) else rows.masked_select(drawn)


def _present(statistic: Tensor | None) -> Tensor:
    if statistic is None:
        raise RuntimeError("densification statistics are available only after the backward pass")
    return statistic


def sums(context: DensifyContext, state: PluginState, names: Sequence[str]) -> dict[str, Tensor]:
    """Return copies of the running sums [P] with these names; zeros before the first step."""
    like = next(iter(state.per_primitive.values()), None)
    if like is None:
        backbone = context.backbone
        name = next(b.tensors[0] for b in backbone.blocks() if b.per_primitive)
        tensor = context.parameters[name]
        like = torch.zeros(tensor.shape[0], device=tensor.device)
    stored = state.per_primitive
    return {n: stored[n].clone() if n in stored else torch.zeros_like(like) for n in names}


def add(record: RenderedView, total: Tensor, values: Tensor, rows: Tensor | None = None) -> None:
    """Add values [N] of Gaussians to the sums `total` [P] of their primitives.

    `rows` contains the rows of the Gaussians; None means all Gaussians.
    """
    origin = record.gaussians.origin
    if origin is not None:
        total.index_add_(0, origin if rows is None else origin.index_select(0, rows), values)
    elif rows is None:
        total += values
    else:
        total.index_add_(0, rows, values)


def mean(statistics: Mapping[str, Tensor], total: str, count: str) -> Tensor:
    """Return [P], the quotient of two sums; 0 if the count is 0."""
    counts = statistics[count]
    means = statistics[total] / counts.clamp(min=torch.finfo(counts.dtype).tiny)
    return torch.where(counts > 0, means, torch.zeros_like(means))
