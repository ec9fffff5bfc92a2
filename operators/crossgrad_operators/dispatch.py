"""Use a different operator for each block (arXiv 2605.00052, appendix on operator variants)."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer
from typing_extensions import override

from crossgrad_core.plugin import (
    BlockKind,
    GramianOperator,
    MatrixOperator,
    OperatorContext,
    PluginState,
    Selection,
    hookimpl,
    plain_component,
    transformed,
)
from crossgrad_operators._nested import (
    OperatorField,
    first_grouping,
    inner_idle,
    inner_objections,
    inner_state,
    outer_state,
    reads_gramians,
)
from crossgrad_operators.confgate import ConfGate
from crossgrad_operators.projection import Symmetric
from crossgrad_operators.sum import Sum

_KINDS: Final[tuple[BlockKind, ...]] = ("geometry", "appearance", "neutral")
_OPACITY = frozenset({"opacity", "opacities"})


class Rule(BaseModel):
    """A rule: the name of a block or of a kind of blocks, and its operator."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    block: str
    operator: OperatorField


def _rules(value: object) -> object:
    if isinstance(value, Mapping):
        return tuple({"block": block, "operator": operator} for block, operator in value.items())
    return value


def _as_mapping(rules: tuple[Rule, ...]) -> dict[str, object]:
    return {rule.block: plain_component(rule.operator) for rule in rules}


class Dispatch(GramianOperator):
    """A different operator for each block.

    The operator of a block comes from a rule for the block, from a rule for its kind, or from the
    variant.

    The paper has two variants: `geometry-confgate` uses `confgate` for geometry and `sum` for
    appearance. `geometry-projection` uses `symmetric` for geometry and `confgate` for appearance.
    """

    variant: Literal["geometry-confgate", "geometry-projection"] = Field(
        "geometry-confgate", description="operator for blocks without a rule"
    )
    rules: Annotated[tuple[Rule, ...], BeforeValidator(_rules), PlainSerializer(_as_mapping)] = (
        Field((), description="block or kind (geometry, appearance, neutral) -> operator")
    )
    opacity: Literal["appearance", "geometry"] = Field(
        "appearance", description="kind of the opacity block"
    )
    neutral: Literal["appearance", "geometry"] = Field(
        "appearance", description="kind whose variant is used for neutral blocks"
    )

    @override
    def is_identity(self, views: int) -> bool:
        return all(operator.is_identity(views) for operator in self._operators().values())

    @override
    def needs_more_views(self, views: int) -> bool:
        return any(operator.needs_more_views(views) for operator in self._operators().values())

    @property
    @override
    def resolved_grouping(self) -> str | None:
        return first_grouping(self._operators().values())

    @override
    def reads_gramians(self) -> bool:
        return reads_gramians(self._operators().values())

    @override
    def reads_labels(self) -> bool:
        return any(operator.reads_labels() for operator in self._operators().values())

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect (see `HasUnusedOptions`)."""
        given = self._given(selection)
        ruled = {rule.block for rule in self.rules}
        keys = {self._key(name, kind, ruled) for name, kind in given}
        idle: dict[str, str] = {}
        if not keys - ruled:
            idle["variant"] = "the rules apply to every block; leave the option out"
        if not any(name in _OPACITY and name not in ruled for name, _ in given):
            idle["opacity"] = "no opacity block uses the operator of a kind; leave the option out"
        if "neutral" not in keys - ruled:
            idle["neutral"] = "the variant applies to no neutral block; leave the option out"
        if ruled - keys:
            names = ", ".join(sorted(ruled - keys))
            idle["rules"] = (
                f"the rule for {names} applies to no Gramian; with granularity "
                f"{self.granularity} the Gramians are {', '.join((name for name, _ in given))}"
            )
        return {**idle, **inner_idle(selection, "rules", [rule.operator for rule in self.rules])}

    def _given(self, selection: Selection) -> list[tuple[str, BlockKind]]:
        """Return the name and the kind of the blocks for which Gramians exist."""
        blocks = [(block.name, block.kind) for block in selection.backbone.trained_blocks()]
        if self.granularity != "kind":
            return blocks
        kinds = {kind for _, kind in blocks}
        return [(kind, kind) for kind in _KINDS if kind in kinds]

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        served = self._served(context)
        operators = self._operators()
        matrices = np.zeros(gramians.shape)
        states = {}
        for key in dict.fromkeys(served.tolist()):
            block_indices = np.flatnonzero(served == key)
            inner, of_part = inner_state(state, key), _part(context, block_indices)
            block_matrices, states[key] = transformed(
                operators[key], gramians[block_indices], of_part, inner, rng
            )
            # Only the sum of the rows matters, so this sum is stored in the first row.
            if block_matrices.shape[1] != gramians.shape[1]:
                block_matrices = _in_first_row(block_matrices, gramians.shape[1])
            matrices[block_indices] = block_matrices
        return matrices, outer_state(states)

    @hookimpl
    def crossgrad_validate_selection(self, selection: Selection) -> list[str]:
        """Return the objections of all operators.

        Rules for blocks that do not exist also cause objections.
        """
        reasons = [
            reason
            for operator in self._operators().values()
            for reason in inner_objections(selection, operator)
        ]
        if self.granularity == "global":
            reasons.append(
                "dispatch applies different operators to blocks, but granularity global "
                "makes one Gramian of all blocks"
            )
        blocks = [block.name for block in selection.backbone.trained_blocks()]
        for rule in self.rules:
            if rule.block not in (*_KINDS, *blocks):
                names = ", ".join((*_KINDS, *blocks))
                reasons.append(
                    f"dispatch has a rule for {rule.block!r}, but the blocks and kinds are {names}"
                )
        return reasons

    def _operators(self) -> dict[str, MatrixOperator]:
        """Return all operators by the key of their rule."""
        variants: dict[str, dict[str, MatrixOperator]] = {
            "geometry-confgate": {"geometry": ConfGate(), "appearance": Sum()},
            "geometry-projection": {"geometry": Symmetric(), "appearance": ConfGate()},
        }
        chosen = variants[self.variant]
        chosen["neutral"] = chosen[self.neutral]
        return chosen | {rule.block: rule.operator for rule in self.rules}

    def _served(self, context: OperatorContext) -> NDArray[np.str_]:
        """Return the key of the rule that applies to each Gramian."""
        ruled = {rule.block for rule in self.rules}
        kind_of = {
            name: self._key(name, kind, ruled)
            for name, kind in dict(zip(context.blocks, context.kinds, strict=True)).items()
        }
        return np.array([kind_of[name] for name in context.blocks])

    def _key(self, name: str, kind: BlockKind, ruled: set[str]) -> str:
        if name in ruled:
            return name
        return self.opacity if name in _OPACITY else kind


def _part(context: OperatorContext, block_indices: NDArray[np.int64]) -> OperatorContext:
    whole = context.rounding_residuals
    return replace(
        context,
        blocks=tuple(context.blocks[b] for b in block_indices),
        kinds=tuple(context.kinds[b] for b in block_indices),
        present=context.present[block_indices],
        rounding_residuals=None if whole is None else lambda: whole()[block_indices],
    )


def _in_first_row(matrices: NDArray[np.float64], views: int) -> NDArray[np.float64]:
    result = np.zeros((len(matrices), views, views))
    result[:, 0] = matrices.sum(axis=1)
    return result
