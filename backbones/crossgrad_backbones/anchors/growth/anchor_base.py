"""Base class of the anchor densifiers: statistics, pruning, and the edit that adds anchors."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import (
    NO_EDIT,
    Densifier,
    DensifyContext,
    Edit,
    Parameters,
    PluginState,
    Rows,
    ViewRecord,
    screen_statistics,
)

#: Sums for each anchor [P]: opacities of its Gaussians, and number of views that decoded it.
OPACITY, VIEWS = "opacity", "views"
#: Sums for each offset [P, k]: gradient norms of its Gaussian, and number of renders in which this
#: Gaussian is visible.
GRADIENT, RENDERS = "gradient", "renders"


def observed(context: DensifyContext, state: PluginState) -> PluginState:
    """Add the statistics of the views of this step to the sums.

    Source: Scaffold-GS, section 3.3.
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
        raise RuntimeError(
            "the backbone returned Gaussians without the offsets that they come from"
        )
    views = totals[VIEWS]
    views += 1.0 if gaussians.decoded is None else gaussians.decoded
    totals[OPACITY].index_add_(0, origin, gaussians.opacities.clamp(min=0.0))
    seen = screen_statistics.visible(record)
    flat_index = origin * totals[RENDERS].shape[1] + slot
    norms = torch.linalg.vector_norm(screen_statistics.ndc_gradient(record), dim=1)
    totals[GRADIENT].view(-1).index_add_(0, flat_index, norms * seen)
    totals[RENDERS].view(-1).index_add_(0, flat_index, seen)


@dataclass(frozen=True)
class GrowthRequest:
    """A request for new anchors at the Gaussians of present anchors.

    Attributes:
        gradient: [P, k] mean gradient norm of each offset, in NDC units.
        eligible: [P, k] bool, True for offsets that were visible often enough for a decision.
    """

    gradient: Tensor
    eligible: Tensor

    def among(self, may_grow: Tensor | None) -> "GrowthRequest":
        """Restrict the request to anchors for which `may_grow` [P] is True.

        If `may_grow` is None, all anchors may grow.
        """
        if may_grow is None:
            return self
        return replace(self, eligible=self.eligible & may_grow[:, None])


@dataclass(frozen=True)
class NewAnchors:
    """M new anchors that an edit adds.

    Attributes:
        positions: [M, 3] positions in local units.
        cells: [M] edge of each anchor's cell in local units.
        features: [M, F] feature vectors.
        parents: [M] int64, the anchor that requested each new anchor.
        strength: [M] largest gradient of all requests for each new anchor.
        further: Other tensors [M, ...], by name, that are not copied from the parents.
    """

    positions: Tensor
    cells: Tensor
    features: Tensor
    parents: Tensor
    strength: Tensor
    further: Mapping[str, Tensor] = field(default_factory=dict)

    def __len__(self) -> int:
        return int(self.positions.shape[0])

    def limited(self, room: int) -> tuple["NewAnchors", int]:
        """Return at most `room` anchors, and the number of dropped anchors.

        Anchors with large gradients are preferred, and the order does not change.
        """
        left_out = max(0, len(self) - room)
        if left_out == 0:
            return self, 0
        ranked = torch.argsort(self.strength, descending=True, stable=True)
        return self.at(ranked[:room].sort().values), left_out

    def and_more(self, more: "NewAnchors") -> "NewAnchors":
        """Append anchors.

        The present and the appended anchors must have the same names in `further`.
        """
        return NewAnchors(
            torch.cat([self.positions, more.positions]),
            torch.cat([self.cells, more.cells]),
            torch.cat([self.features, more.features]),
            torch.cat([self.parents, more.parents]),
            torch.cat([self.strength, more.strength]),
            {
                name: torch.cat([tensor, more.further[name]])
                for name, tensor in self.further.items()
            },
        )

    def at(self, rows: Tensor) -> "NewAnchors":
        """Return the anchors at `rows` [R]."""
        return NewAnchors(
            self.positions[rows],
            self.cells[rows],
            self.features[rows],
            self.parents[rows],
            self.strength[rows],
            {name: tensor[rows] for name, tensor in self.further.items()},
        )


class AnchorDensifier(Densifier):
    """A densifier that adds anchors where gradients are large, and removes transparent anchors.

    A subclass decides where anchors are added. All other rules are the rules of Scaffold-GS. After
    a decision about an offset or an anchor, its sums are reset to zero. An anchor that is rarely
    visible keeps its sums, until they suffice for a decision.
    """

    tensors: ClassVar[frozenset[str]] = frozenset({"anchors", "offsets", "features", "scales"})
    resets: ClassVar[bool] = False

    grad_threshold: float = Field(
        2e-4, gt=0, description="mean NDC gradient norm above which anchors grow"
    )
    success_threshold: float = Field(
        0.8,
        ge=0,
        description="an anchor is judged if it was rendered in more than this share of the "
        "interval's views, an offset if it was rendered in more than half of this "
        "share",
    )
    prune_opacity: float = Field(
        0.005,
        ge=0,
        description="anchors with a lower sum of opacities over their offsets are pruned",
    )
    largest_log_scale: float = Field(
        0.05, description="upper limit of the log size of Gaussians, extents"
    )

    @abstractmethod
    def grown(
        self, context: DensifyContext, parameters: Parameters, request: GrowthRequest
    ) -> NewAnchors:
        """Return the anchors that are added for the requests.

        Args:
            context: The context of the step.
            parameters: The parameters, detached from autograd.
            request: The requests for new anchors.
        """

    def changed(self, parameters: Parameters, request: GrowthRequest) -> Mapping[str, Tensor]:
        """Return new values [P, ...] for tensors of the present anchors.

        By default, the log scales of Gaussians are limited.
        """
        scales = parameters["scales"]
        capped = scales[:, 3:].clamp(max=self.largest_log_scale)
        return {"scales": torch.cat([scales[:, :3], capped], 1)}

    @override
    def densify(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        if not context.schedule.collects(context.step):
            return NO_EDIT, PluginState()
        # In the published schedule, statistics are collected from step 500 on, and edits begin at
        # step 1500.
        if context.schedule.counted(context.step) > context.schedule.densify_from // 3:
            state = observed(context, state)
        if not (state.per_primitive and context.schedule.densifies(context.step)):
            return NO_EDIT, state
        return self._edited(context, state)

    def _edited(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        sums = state.per_primitive
        parameters = {name: tensor.detach() for name, tensor in context.parameters.items()}
        enough = self.success_threshold * context.schedule.densify_every * context.share
        judged = sums[VIEWS] > enough
        transparent = sums[OPACITY] < self.prune_opacity * sums[VIEWS]
        request = GrowthRequest(
            screen_statistics.mean(sums, GRADIENT, RENDERS), sums[RENDERS] > enough / 2
        )
        allowed = request.among(context.may_grow)
        new, held_back = self.grown(context, parameters, allowed).limited(context.room)
        changed = self.changed(parameters, request)
        edit = edit_of(parameters, changed, judged & transparent, new)
        if held_back > 0:
            edit = replace(edit, counts={**edit.counts, "held_back": held_back})
        return edit, PluginState(per_primitive=_cleared(state, request.eligible, judged))


def edit_of(
    parameters: Parameters, changed: Mapping[str, Tensor], pruned: Tensor, new: NewAnchors
) -> Edit:
    """Create the edit that changes present anchors, removes `pruned` [P] and adds `new` anchors."""
    really = {n: rows for n, rows in changed.items() if not torch.equal(rows, parameters[n])}
    if len(new) == 0 and not bool(pruned.any()):
        return Edit(values={name: Rows(rows, keep_moments=True) for name, rows in really.items()})
    stay = (~pruned).nonzero().squeeze(1)
    source = torch.cat([stay, new.parents])
    added = torch.arange(len(source), device=source.device) >= len(stay)
    first = _first_values(parameters, new)
    rows = added.nonzero().squeeze(1)
    values = {name: Rows(tensor, rows) for name, tensor in first.items()}
    for name, tensor in really.items():
        beginning = first.get(name, tensor[new.parents])
        values[name] = Rows(torch.cat([tensor[stay], beginning]), keep_moments=True)
    return Edit(source, added, values, {"grown": len(new), "pruned": int(pruned.sum())})


def _first_values(parameters: Parameters, new: NewAnchors) -> dict[str, Tensor]:
    """Return the initial values of new anchors.

    Tensors that are not included are copied from the parents.
    """
    scales, offsets = parameters["scales"], parameters["offsets"]
    return {
        "anchors": new.positions,
        "offsets": offsets.new_zeros(len(new), *offsets.shape[1:]),
        "features": new.features,
        "scales": new.cells.log().to(scales)[:, None].repeat(1, scales.shape[1]),
        **new.further,
    }


def _cleared(state: PluginState, eligible: Tensor, judged: Tensor) -> dict[str, Tensor]:
    """Return the sums after a reset for eligible offsets and for anchors with a decision."""
    done = {GRADIENT: eligible, RENDERS: eligible, OPACITY: judged, VIEWS: judged}
    return {name: state.per_primitive[name].masked_fill(done[name], 0.0) for name in done}


def offset_means(parameters: Mapping[str, Tensor], anchor: Tensor, slot: Tensor) -> Tensor:
    """Return the means [N, 3] of the Gaussians in slots `slot` [N] of anchors `anchor` [N]."""
    stretch = torch.exp(parameters["scales"][anchor, :3])
    return parameters["anchors"][anchor] + parameters["offsets"][anchor, slot] * stretch


def largest(rows: Tensor, group: Tensor, groups: int) -> Tensor:
    """Return the elementwise maximum [groups, F] over the rows [N, F] of each group.

    Empty groups get -inf.
    """
    largest = rows.new_full((groups, rows.shape[1]), -torch.inf)
    return largest.scatter_reduce_(0, group[:, None].expand_as(rows), rows, "amax")
