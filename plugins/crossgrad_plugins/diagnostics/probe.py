"""Gradients of chosen views at frozen parameters, as Gramians in two metrics."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.commands import gathered, view_gradients
from crossgrad_core.plugin import BlockKind, Model

#: Bytes that the gradients of all probed views may take together.
MEMORY = 512 * 2**20

_Gradients = dict[str, Tensor]


@dataclass(frozen=True, eq=False)
class Measurement:
    """The Gramians of V views at one moment.

    Attributes:
        step: The last complete step.
        views: [V] positions in `scene.train_views`; views with a gradient that is not finite are
            left out.
        blocks: [B] names of the blocks, frozen ones left out.
        kinds: [B] their kinds.
        plain: [B, V, V] dot products of gradients.
        adam: [B, V, V] dot products of gradients over the root of Adam's second moment; None before
            the first step.
        overlap: [B, V, V] whether two views' gradients share a non-zero element.
        dropped: Names of the views that were left out.
        share: Share of the primitives whose gradients were looked at.
    """

    step: int
    views: tuple[int, ...]
    blocks: tuple[str, ...]
    kinds: tuple[BlockKind, ...]
    plain: NDArray[np.float64]
    adam: NDArray[np.float64] | None
    overlap: NDArray[np.bool_]
    dropped: tuple[str, ...]
    share: float


def measure(model: Model, views: Sequence[int], rng: np.random.Generator) -> Measurement:
    """The Gramians of the gradients of the given training views.

    Each view's own photometric loss is differentiated; the model is left as it is. Where the
    gradients of all views would not fit into `MEMORY`, a uniform random subset of the primitives is
    looked at: dot products of the per-primitive blocks are then unbiased estimates.

    Args:
        model: The model.
        views: Positions in `scene.train_views`.
        rng: Chooses the subset.
    """
    blocks = model.backbone.trained_blocks()
    rows, share = _rows(model, len(views), rng)
    factors = _Subset(rows, {name for b in blocks if b.per_primitive for name in b.tensors}, share)
    names = [name for block in blocks for name in block.tensors]
    train_views = model.scene.train_views
    gradients = [factors.of(view_gradients(model, train_views[view], names)) for view in views]
    finite = [all(bool(torch.isfinite(g).all()) for g in each.values()) for each in gradients]
    kept = [each for each, good in zip(gradients, finite, strict=True) if good]
    dense = gathered(kept, blocks)
    plain, overlap = dense.gramians("block"), dense.overlap("block")
    adam = None
    if model.adam.exp_avg_sq:
        _divide_by_adam(model, factors, kept)
        adam = gathered(kept, blocks).gramians("block")
    return Measurement(
        step=model.phase.step,
        views=tuple(view for view, good in zip(views, finite, strict=True) if good),
        blocks=tuple(block.name for block in blocks),
        kinds=tuple(block.kind for block in blocks),
        plain=plain,
        adam=adam,
        overlap=overlap,
        dropped=tuple(
            train_views[view].name for view, good in zip(views, finite, strict=True) if not good
        ),
        share=share,
    )


@dataclass(frozen=True, eq=False)
class ModelProbe:
    """The gradients of a model, as groupings ask for them (`GradientProbe`)."""

    model: Model
    rng: np.random.Generator

    @property
    def blocks(self) -> tuple[str, ...]:
        """[B] names of the blocks."""
        return tuple(block.name for block in self.model.backbone.trained_blocks())

    def gramians(self, views: Sequence[int]) -> NDArray[np.float64]:
        """[B, V, V] Gramians; a view whose gradient is not finite counts as zero."""
        measurement = measure(self.model, views, self.rng)
        places = [list(views).index(view) for view in measurement.views]
        full = np.zeros((len(self.blocks), len(views), len(views)))
        full[:, np.array(places)[:, None], np.array(places)[None, :]] = measurement.plain
        return full


@dataclass(frozen=True, eq=False)
class _Subset:
    """Which rows of per-primitive tensors are looked at.

    Attributes:
        rows: Their numbers, None for all.
        tensors: Names of the per-primitive tensors.
        share: Their share of all rows.
    """

    rows: Tensor | None
    tensors: set[str]
    share: float

    def of(self, gradients: Mapping[str, Tensor]) -> _Gradients:
        """The gradients of the subset, lengthened so that dot products keep their expectation."""
        if self.rows is None:
            return dict(gradients)
        length = 1.0 / sqrt(self.share)
        return {
            name: g[self.rows] * length if name in self.tensors else g
            for name, g in gradients.items()
        }

    def plain(self, name: str, tensor: Tensor) -> Tensor:
        """The rows of a tensor as they are."""
        return tensor if self.rows is None or name not in self.tensors else tensor[self.rows]


def _rows(model: Model, views: int, rng: np.random.Generator) -> tuple[Tensor | None, float]:
    """The rows to look at and their share of all."""
    per_primitive = [
        t for b in model.backbone.trained_blocks() if b.per_primitive for t in b.tensors
    ]
    if not per_primitive:
        return None, 1.0
    total = model.parameters[per_primitive[0]].shape[0]
    bytes_each = sum(model.parameters[name][:1].nbytes for name in per_primitive)
    fitting = MEMORY // max(1, bytes_each * views)
    if fitting >= total:
        return None, 1.0
    chosen = np.sort(rng.choice(total, size=max(1, fitting), replace=False))
    device = model.parameters[per_primitive[0]].device
    return torch.from_numpy(chosen).to(device), len(chosen) / total


def _divide_by_adam(model: Model, subset: _Subset, gradients: Sequence[_Gradients]) -> None:
    """Divides all gradients by the root of Adam's second moment as the next step will have it.

    The next step adds squared gradients to the moment first; here their mean over the probed views,
    so that all views share one metric. Elements that training never touched stay bounded by it.
    """
    beta2 = model.rule.betas[1]
    for name, moment in model.adam.exp_avg_sq.items():
        having = [each for each in gradients if name in each]
        if not having:
            continue
        mean = torch.zeros_like(having[0][name])
        for each in having:
            mean.addcmul_(each[name], each[name], value=1.0 / len(gradients))
        lengthened = 1.0 / subset.share if name in subset.tensors else 1.0
        second = beta2 * subset.plain(name, moment) + (1.0 - beta2) * mean / lengthened
        correction = 1.0 - beta2 ** ((model.adam.steps[name] + 1) * model.rule.age)
        root = (second / correction).sqrt_().add_(model.rule.eps)
        for each in having:
            each[name] = each[name] / root
