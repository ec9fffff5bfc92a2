"""Parameters of a backbone, and the named blocks that operators and the optimizer work on."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from math import exp, inf, log, sqrt
from types import MappingProxyType
from typing import Any, Final, Literal, TypeAlias, get_args

import torch
from torch import Tensor

BlockKind = Literal["geometry", "appearance", "neutral"]
#: Tensor name -> leaf tensor. The first dimension of a per-primitive tensor is the number of
#: primitives.
Parameters: TypeAlias = dict[str, Tensor]


@dataclass(frozen=True)
class LearningRate:
    """A learning rate that changes log-linearly from `initial` to `final`; an initial 0 stays 0.

    Attributes:
        initial: Learning rate at the first step.
        final: Learning rate at the end of the schedule; None means `initial`.
        few_passes: Positive factor for this learning rate in a run with few passes over the photos
            (docs/schedules.md). Factors that apply to all learning rates of the backbone multiply
            this learning rate, too.

    Source: 3DGS; lr(t) = exp((1-u) ln a + u ln b) with u = clip(t / T, 0, 1). Here t is the count
    of the schedule, T the end of the decay, a `initial` and b `final`.
    """

    initial: float
    final: float | None = None
    few_passes: float = 1.0

    def __post_init__(self) -> None:
        """Check that the learning rates are valid for a schedule.

        Raises:
            ValueError: A learning rate is negative, is not finite or decays to 0, or `few_passes`
                is not positive.
        """
        rates = [rate for rate in (self.initial, self.final) if rate is not None]
        if not all(0.0 <= rate < inf for rate in rates):
            raise ValueError(f"learning rates must be finite and not negative; found {rates}")
        if self.initial > 0.0 and self.final == 0.0:
            raise ValueError(
                "a learning rate cannot decay log-linearly to 0; choose a small positive final rate"
            )
        if not 0.0 < self.few_passes < inf:
            raise ValueError(f"`few_passes` must be a positive number; found {self.few_passes}")

    @property
    def decays(self) -> bool:
        """True if the learning rate changes over the schedule."""
        return self.final is not None and self.initial not in {0.0, self.final}

    def at(self, progress: float) -> float:
        """Return the learning rate after the share `progress` of the decay, clipped to [0, 1]."""
        if self.final is None or not self.decays:
            return self.initial
        u = min(max(progress, 0.0), 1.0)
        return exp((1.0 - u) * log(self.initial) + u * log(self.final))


@dataclass(frozen=True)
class Block:
    """A group of tensors that is aggregated as one vector and shares one learning rate.

    Attributes:
        name: Name of the block.
        tensors: Names of the block's tensors in `Parameters`. A block with one tensor uses the
            tensor's name.
        per_primitive: True if the first dimension of every tensor is the number of primitives.
        kind: `geometry`, `appearance` or `neutral`. With granularity `kind`, all blocks of one kind
            share one Gramian. The operator `dispatch` can use another operator for each kind.
        lr: Learning rate of all tensors of the block. The rate 0 freezes the block: its tensors get
            no gradient and may have any type. Only topology edits and checkpoints use frozen
            tensors.
        rests: True if the block's tensors hold details of the colour, such as spherical harmonics
            of higher degrees, that need not be updated in every step.
    """

    name: str
    tensors: tuple[str, ...]
    per_primitive: bool
    kind: BlockKind
    lr: LearningRate
    rests: bool = False

    def __post_init__(self) -> None:
        """Check the fields, because otherwise an error would appear only during training.

        Raises:
            ValueError: The kind is not one of `BlockKind`.
            TypeError: The names of the tensors are not a tuple, or the learning rate is a plain
                number.
        """
        if self.kind not in get_args(BlockKind):
            kinds = get_args(BlockKind)
            raise ValueError(
                f"block {self.name}: the kind must be one of {kinds}; found {self.kind!r}"
            )
        if not isinstance(self.tensors, tuple) or not isinstance(self.lr, LearningRate):
            raise TypeError(
                f"block {self.name}: `tensors` must be a tuple of names, and `lr` a LearningRate"
            )

    @property
    def frozen(self) -> bool:
        """True if training leaves the block unchanged."""
        return self.lr.initial == 0.0


def primitives_of(blocks: tuple[Block, ...], parameters: Mapping[str, Tensor]) -> int:
    """Return the number of primitives, taken from the first per-primitive tensor."""
    for block in blocks:
        if block.per_primitive:
            return int(parameters[block.tensors[0]].shape[0])
    return 0


#: Names of the plugin states that belong to the components of slots.
SLOTS: Final = frozenset({"densifier", "operator", "resolution", "sampler"})
#: Names of plugin states that are reserved for slots and the core. No other plugin may use these
#: names.
TAKEN: Final = SLOTS | {"budget", "grouping", "photos", "thinned"}
Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"


@dataclass(frozen=True)
class PluginState:
    """The state of one plugin between steps.

    The size of the state must not depend on the number of steps, because every checkpoint contains
    the state. Store sums, or a window of at most 1,000 steps.

    Attributes:
        values: Plain numbers, strings, lists and dictionaries that JSON can store.
        tensors: Tensors of any shape.
        per_primitive: Tensors whose first dimension is the number of primitives. A topology edit
            gathers the rows of these tensors together with the parameters (rows of new primitives
            start at zero).
    """

    values: Mapping[str, Json] = field(default_factory=dict)
    tensors: Mapping[str, Tensor] = field(default_factory=dict)
    per_primitive: Mapping[str, Tensor] = field(default_factory=dict)

    def __deepcopy__(self, memo: dict[int, Any]) -> "PluginState":
        # Copy the fields one by one, because `deepcopy` fails for the read-only mappings of
        # `EMPTY_STATE`.
        values = deepcopy(dict(self.values), memo)
        tensors, rows = (
            deepcopy(dict(tensors_by_name), memo)
            for tensors_by_name in (self.tensors, self.per_primitive)
        )
        return PluginState(values, tensors, rows)

    def to(self, device: torch.device) -> "PluginState":
        """Return the state with its tensors on a device."""
        tensors, rows = (
            {name: tensor.to(device) for name, tensor in tensors_by_name.items()}
            for tensors_by_name in (self.tensors, self.per_primitive)
        )
        return PluginState(self.values, tensors, rows)

    def gathered(self, source: Tensor, fresh: Tensor) -> "PluginState":
        """Return the state after a topology edit.

        Args:
            source: [M] int64, index of the old primitive whose row each new primitive copies.
            fresh: [M] bool, True for new primitives whose rows start at zero.
        """
        rows = {name: carried(old, source, fresh) for name, old in self.per_primitive.items()}
        return PluginState(self.values, self.tensors, rows)


def carried(old: Tensor, source: Tensor, fresh: Tensor) -> Tensor:
    """Return the rows of `old` at `source` [M]; rows marked in `fresh` [M] are zero."""
    # Move the indices, because a plugin may store its tensors on another device than the run.
    source, fresh = source.to(old.device), fresh.to(old.device)
    # `index_select` copies whole rows; indexing with a tensor copies single elements.
    new = old.index_select(0, source)
    # On a GPU, index with the mask itself, because `nonzero` would wait for the GPU.
    marked = fresh.nonzero()[:, 0] if fresh.is_cpu else fresh
    new[marked] = torch.zeros((), dtype=old.dtype, device=old.device)
    return new


#: The empty state of a plugin that has not stored a state yet. The state is read-only, because all
#: runs of a process share this object.
EMPTY_STATE = PluginState(MappingProxyType({}), MappingProxyType({}), MappingProxyType({}))


@dataclass(frozen=True)
class Rows:
    """New values for some rows of a tensor.

    Attributes:
        rows: [R] int64 row indices *after* the edit; None means every row.
        values: [R, ...] values.
        keep_moments: True if the optimizer's moments of these rows are kept.
    """

    values: Tensor
    rows: Tensor | None = None
    keep_moments: bool = False


@dataclass(frozen=True)
class Edit:
    """A change of the set of primitives and of their values.

    New primitive j copies all per-primitive rows of old primitive `source[j]`: parameters,
    optimizer moments and statistics. This single gather can duplicate, split, relocate, remove and
    append primitives. `fresh` marks rows that start with zero moments and statistics.

    Attributes:
        source: [M] int64 old index of each new primitive; None if the set does not change.
        fresh: [M] bool; None means that no row is fresh.
        values: Tensor name -> rows to overwrite after the gather.
        counts: Numbers of events, for the log (`cloned`, `split`, `pruned`, `reset` ...).
    """

    source: Tensor | None = None
    fresh: Tensor | None = None
    values: Mapping[str, Rows] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)

    @property
    def is_empty(self) -> bool:
        """True if the edit changes no primitive and contains no counts."""
        return self.keeps_rows and not self.values and not self.counts

    @property
    def keeps_rows(self) -> bool:
        """True if the edit keeps all primitives in their rows and marks no row as fresh."""
        return self.source is None and self.fresh is None


#: The explicit result of a densifier that changes nothing in this step.
NO_EDIT = Edit()


def misfit_of(edit: Edit, blocks: tuple[Block, ...], parameters: Mapping[str, Tensor]) -> str:
    """Return the reason why an edit does not fit the parameters; empty if it fits."""
    before = primitives_of(blocks, parameters)
    if wrong := _no_set(edit, before):
        return wrong
    after = before if edit.source is None else len(edit.source)
    rows = {name for block in blocks if block.per_primitive for name in block.tensors}
    for name, new in edit.values.items():
        if name not in rows:
            return f"there is no tensor {name!r} with one row per Gaussian"
        if wrong := _no_values(new, after, parameters[name].shape[1:]):
            return f"values of {name}: {wrong}"
    return ""


def _no_set(edit: Edit, before: int) -> str:
    """Return why `source` or `fresh` does not fit `before` primitives; empty if both fit."""
    source, fresh = edit.source, edit.fresh
    if source is not None and (wrong := _no_list(source, torch.int64)):
        return f"source is {wrong}"
    after = before if source is None else len(source)
    if source is not None and after and not 0 <= int(source.min()) <= int(source.max()) < before:
        return f"source contains indices outside 0 to {before - 1}"
    if fresh is not None and (wrong := _no_list(fresh, torch.bool)):
        return f"fresh is {wrong}"
    if fresh is not None and len(fresh) != after:
        return f"fresh has {len(fresh)} rows, but there are {after} Gaussians"
    return ""


def _no_list(value: object, dtype: torch.dtype) -> str:
    """Return how an object differs from a 1-D tensor of a dtype; empty if it is such a tensor."""
    if not isinstance(value, Tensor):
        return f"of type {type(value).__module__}.{type(value).__name__}, not a tensor"
    good = value.ndim == 1 and value.dtype == dtype
    return "" if good else f"{list(value.shape)} of {value.dtype}, not [M] of {dtype}"


def _no_values(new: object, count: int, width: torch.Size) -> str:
    """Return why `new` cannot replace rows of a [count, *width] tensor; empty if it can."""
    if not isinstance(new, Rows) or not isinstance(new.values, Tensor):
        return f"{type(new).__name__}, not Rows of a tensor"
    if new.rows is not None:
        if wrong := _no_list(new.rows, torch.int64):
            return f"rows are {wrong}"
        # Check on the CPU only, because on a GPU the check would wait for the device.
        if new.rows.is_cpu and ((new.rows < 0) | (new.rows >= count)).any():
            return f"rows contain indices outside 0 to {count - 1}"
        count = len(new.rows)
    shape = (count, *width)
    return "" if _fits(new.values, shape) else f"{list(new.values.shape)}, not {list(shape)}"


def _fits(values: Tensor, shape: tuple[int, ...]) -> bool:
    """Return True if values can be written to a tensor of this shape."""
    pairs = zip(reversed(values.shape), reversed(shape), strict=False)
    return values.ndim <= len(shape) and all(length in (1, size) for length, size in pairs)


def gather_indices(edit: Edit, primitives: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return `source` [M] and `fresh` [M] of an edit, with defaults in place of None."""
    source = edit.source
    if source is None:
        source = torch.arange(primitives, device=device)
    fresh = edit.fresh
    if fresh is None:
        fresh = torch.zeros(source.shape[0], dtype=torch.bool, device=device)
    return source, fresh


def apply_to_parameters(
    edit: Edit, blocks: tuple[Block, ...], parameters: Mapping[str, Tensor]
) -> Parameters:
    """Return the parameters after an edit.

    Changed tensors are new leaf tensors that require gradients if the old tensors did. A tensor
    that the edit does not change is returned as the same object.
    """
    new = dict(parameters)
    for block in blocks:
        if block.per_primitive:
            for name in block.tensors:
                new[name] = _edited(edit, name, parameters[name])
    return new


def _edited(edit: Edit, name: str, old: Tensor) -> Tensor:
    overwrite = edit.values.get(name)
    if edit.source is None and overwrite is None:
        return old
    if edit.source is None:
        tensor = old.detach().clone()
    else:  # The rows that a plugin lists may be on another device than the parameters.
        tensor = old.detach().index_select(0, edit.source.to(old.device))
    if overwrite is not None:
        rows = slice(None) if overwrite.rows is None else overwrite.rows
        tensor[rows] = overwrite.values.to(tensor.dtype)
    return tensor.requires_grad_(old.requires_grad)


def apply_to_moment(edit: Edit, name: str, old: Tensor) -> Tensor:
    """Return an optimizer moment of the per-primitive tensor `name` after an edit.

    Rows that are fresh, and rows overwritten without `keep_moments`, start at zero.
    """
    source, fresh = gather_indices(edit, old.shape[0], old.device)
    new = old if edit.keeps_rows else carried(old, source, fresh)
    overwrite = edit.values.get(name)
    if overwrite is not None and not overwrite.keep_moments:
        new = new.clone()
        new[slice(None) if overwrite.rows is None else overwrite.rows] = 0.0
    return new


#: Epsilon that Adam adds to the square root of the second moment (value of 3DGS).
EPS: Final = 1e-15
#: Adam's decay rates of the first moment and of the second moment (values of 3DGS).
BETAS: Final = (0.9, 0.999)
#: Largest number of views per step for the batch rule (`AdamRule.for_views`). At this number, the
#: decay rate of the first moment reaches 0.
MOST_VIEWS: Final = 10


@dataclass(frozen=True)
class AdamState:
    """Adam's moments and step counts by tensor name; tensors without a gradient so far are missing.

    Attributes:
        exp_avg: First moments, each shaped like its parameter.
        exp_avg_sq: Second moments, each shaped like its parameter.
        steps: Number of gradients that each tensor has received.
    """

    exp_avg: dict[str, Tensor] = field(default_factory=dict)
    exp_avg_sq: dict[str, Tensor] = field(default_factory=dict)
    steps: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class AdamRule:
    """The hyperparameters of Adam's moments.

    Attributes:
        betas: Decay rates of the first and the second moment, each in [0, 1).
        eps: Number that is added to the square root of the second moment.
        age: Factor that multiplies a tensor's number of steps in the bias correction.
    """

    betas: tuple[float, float] = BETAS
    eps: float = EPS
    age: float = 1.0

    @classmethod
    def for_views(
        cls, views: int, age: float = 1.0, betas: tuple[float, float] = BETAS
    ) -> "AdamRule":
        """Return the rule for K views per step: 1 - beta of both moments is multiplied by K.

        The caller must also multiply the learning rates by sqrt(K).

        Args:
            views: Number of views per step, K; at most `MOST_VIEWS`.
            age: Number of steps that the run would need if every step had K views, divided by the
                run's actual number of steps. The quotient differs from 1 only if K changed during
                the run.
            betas: Decay factors of the moments for one view per step.

        Source: gsplat; Malladi et al. 2022 (square-root scaling). Here K counts views instead of
        batches.
        """
        first, second = (max(0.0, 1.0 - views * (1.0 - beta)) for beta in betas)
        return cls((first, second), EPS / sqrt(views), age)
