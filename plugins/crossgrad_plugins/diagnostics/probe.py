"""Gradients of chosen views at fixed parameters, as Gramians in two metrics."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.commands import gathered, view_gradients
from crossgrad_core.plugin import BlockKind, Model

#: Maximum number of bytes for the gradients of all views that are measured.
MEMORY = 512 * 2**20

_Gradients = dict[str, Tensor]


@dataclass(frozen=True, eq=False)
class Measurement:
    """The Gramians of V views at a step.

    Attributes:
        step: The last completed step.
        views: [V] indices in `scene.train_views`; views with a non-finite gradient are left out.
        blocks: [B] names of the parameter blocks, without frozen blocks.
        kinds: [B] kinds of the blocks.
        plain: [B, V, V] dot products of gradients.
        adam: [B, V, V] dot products of gradients divided by the root of Adam's second moment; None
            before the first step.
        overlap: [B, V, V] True if there is an element in which both gradients are non-zero.
        dropped: Names of the views with a non-finite gradient.
        share: Share of the primitives that were measured.
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
    """Measure the Gramians of the gradients of the given training views.

    The loss of each view is differentiated separately; the model is not changed. If the gradients
    of all views do not fit into `MEMORY` bytes, only a uniform random subset of the primitives is
    measured. For per-primitive blocks, the scaled dot products of the subset are unbiased
    estimates.

    Args:
        model: The model.
        views: Indices in `scene.train_views`.
        rng: Generator that chooses the subset.
    """
    blocks = model.backbone.trained_blocks()
    rows, share = _rows(model, len(views), rng)
    factors = _Subset(rows, {name for b in blocks if b.per_primitive for name in b.tensors}, share)
    names = [name for block in blocks for name in block.tensors]
    train_views = model.scene.train_views
    gradients = [factors.of(view_gradients(model, train_views[view], names)) for view in views]
    finite = [all(bool(torch.isfinite(g).all()) for g in tensors.values()) for tensors in gradients]
    kept = [tensors for tensors, good in zip(gradients, finite, strict=True) if good]
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
    """The gradients of a model in the form that groupings need (`GradientProbe`)."""

    model: Model
    rng: np.random.Generator

    @property
    def blocks(self) -> tuple[str, ...]:
        """[B] names of the blocks."""
        return tuple(block.name for block in self.model.backbone.trained_blocks())

    def gramians(self, views: Sequence[int]) -> NDArray[np.float64]:
        """Return [B, V, V] Gramians; a non-finite gradient counts as zero."""
        measurement = measure(self.model, views, self.rng)
        places = [list(views).index(view) for view in measurement.views]
        full = np.zeros((len(self.blocks), len(views), len(views)))
        full[:, np.array(places)[:, None], np.array(places)[None, :]] = measurement.plain
        return full


@dataclass(frozen=True, eq=False)
class _Subset:
    """The measured rows of per-primitive tensors.

    Attributes:
        rows: Indices of the rows; None for all rows.
        tensors: Names of the per-primitive tensors.
        share: Share of the rows that are measured.
    """

    rows: Tensor | None
    tensors: set[str]
    share: float

    def of(self, gradients: Mapping[str, Tensor]) -> _Gradients:
        """Return the gradients of the subset, scaled so that expected dot products stay equal."""
        if self.rows is None:
            return dict(gradients)
        length = 1.0 / sqrt(self.share)
        return {
            name: g[self.rows] * length if name in self.tensors else g
            for name, g in gradients.items()
        }

    def plain(self, name: str, tensor: Tensor) -> Tensor:
        """Return the chosen rows of a tensor, without scaling."""
        return tensor if self.rows is None or name not in self.tensors else tensor[self.rows]


def _rows(model: Model, views: int, rng: np.random.Generator) -> tuple[Tensor | None, float]:
    """Choose the rows to measure; return the rows and their share of all rows."""
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
    """Divide all gradients by the root of Adam's second moment in the next step.

    In training, the next step would first add the view's squared gradients to the moment. Here, the
    mean of the squared gradients over all measured views is added instead, so that all views have
    the same metric. The addition also limits elements that training has never changed, because
    their moment is zero.
    """
    beta2 = model.rule.betas[1]
    for name, moment in model.adam.exp_avg_sq.items():
        having = [tensors for tensors in gradients if name in tensors]
        if not having:
            continue
        mean = torch.zeros_like(having[0][name])
        for tensors in having:
            mean.addcmul_(tensors[name], tensors[name], value=1.0 / len(gradients))
        lengthened = 1.0 / subset.share if name in subset.tensors else 1.0
        second = beta2 * subset.plain(name, moment) + (1.0 - beta2) * mean / lengthened
        correction = 1.0 - beta2 ** ((model.adam.steps[name] + 1) * model.rule.age)
        root = (second / correction).sqrt_().add_(model.rule.eps)
        for tensors in having:
            tensors[name] = tensors[name] / root
