"""Reading the screen statistics of a rendered view, whatever its scale, per primitive.

Everything is in units of the full photo: gradients per NDC unit, radii over the longer side, pixels
of the photo as trained. A loss is a mean over pixels, so its gradients need no other factor.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.contexts import DensifyContext, RenderedView


def half_size(record: RenderedView, like: Tensor) -> Tensor:
    """[2] pixels of the render per NDC unit: W/2, H/2 (3DGS)."""
    camera = record.camera
    return torch.tensor([camera.width / 2, camera.height / 2]).to(like, non_blocking=True)


def ndc_gradient(record: RenderedView, rows: Tensor | None = None) -> Tensor:
    """[N, 2] gradient of the view's loss by the projected mean, per NDC unit; [S, 2] of `rows`."""
    return _of_rows(record, record.screen.mean_gradient, rows)


def ndc_abs_gradient(record: RenderedView, rows: Tensor | None = None) -> Tensor:
    """[N, 2] the pixels' absolute gradients by the projected mean, summed, per NDC unit."""
    return _of_rows(record, record.screen.abs_gradient, rows)


def _of_rows(record: RenderedView, statistic: Tensor | None, rows: Tensor | None) -> Tensor:
    gradient = _present(statistic)
    gradient = gradient if rows is None else gradient.index_select(0, rows)
    return gradient * half_size(record, gradient)


def directions(record: RenderedView) -> Tensor:
    """[6, 5, N] `Screen.directions` with the absolute gradients per NDC unit; bins, then fields.

    With the Gaussians last, sums over bins are sums of whole rows: much faster on the CPU.
    """
    found = _present(record.screen.directions)
    bins = found.permute(1, 2, 0).clone(memory_format=torch.contiguous_format)
    bins[:, 2:4] *= half_size(record, bins)[:, None]
    return bins


def pixels(record: RenderedView) -> Tensor:
    """[N] pixels of the full photo in which the Gaussian was blended, floating point."""
    return of_photo(record, _present(record.screen.pixels))


def of_photo(record: RenderedView, counts: Tensor) -> Tensor:
    """[N] numbers of pixels of the full photo, floating point, from those of the render."""
    found = counts.to(record.gaussians.means)
    if record.scale == 1.0:
        return found
    full, drawn = record.view.camera, record.camera
    return found * (full.width * full.height / (drawn.width * drawn.height))


def radii(record: RenderedView) -> Tensor:
    """[N] radius on the screen over the image's longer side; 0 where it touches no pixel."""
    camera = record.camera
    return record.screen.radii.to(record.gaussians.means) / max(camera.width, camera.height)


def visible(record: RenderedView, rows: Tensor | None = None) -> Tensor:
    """[N] 1 where the Gaussian touched a pixel, else 0."""
    radii = record.screen.radii
    radii = radii if rows is None else radii.index_select(0, rows)
    return (radii > 0).to(record.gaussians.means)


def seen(record: RenderedView) -> Tensor | None:
    """[S] int64 rows of the Gaussians that touched a pixel: for sums over these alone.

    None, which means all, on a GPU, where their number would be waited for.
    """
    radii, rows = record.screen.radii, record.screen.rows
    if not radii.is_cpu:
        return None
    if rows is None:
        return radii.nonzero()[:, 0]
    drawn = radii.index_select(0, rows) > 0
    # As a rule all of them.
    return rows if bool(drawn.all()) else rows.masked_select(drawn)


def _present(statistic: Tensor | None) -> Tensor:
    if statistic is None:
        raise RuntimeError("densification statistics were read before the backward pass")
    return statistic


def sums(context: DensifyContext, state: PluginState, names: Sequence[str]) -> dict[str, Tensor]:
    """Copies of the running sums [P] of these names, zeros at first."""
    like = next(iter(state.per_primitive.values()), None)
    if like is None:
        backbone = context.backbone
        name = next(b.tensors[0] for b in backbone.blocks() if b.per_primitive)
        tensor = context.parameters[name]
        like = torch.zeros(tensor.shape[0], device=tensor.device)
    known = state.per_primitive
    return {n: known[n].clone() if n in known else torch.zeros_like(like) for n in names}


def add(record: RenderedView, total: Tensor, values: Tensor, rows: Tensor | None = None) -> None:
    """Adds a value of each Gaussian [N], or of those in `rows`, to its primitive's sum [P]."""
    origin = record.gaussians.origin
    if origin is not None:
        total.index_add_(0, origin if rows is None else origin.index_select(0, rows), values)
    elif rows is None:
        total += values
    else:
        total.index_add_(0, rows, values)


def mean(statistics: Mapping[str, Tensor], total: str, count: str) -> Tensor:
    """[P] quotient of two sums, 0 where the count is 0."""
    counts = statistics[count]
    means = statistics[total] / counts.clamp(min=torch.finfo(counts.dtype).tiny)
    return torch.where(counts > 0, means, torch.zeros_like(means))
