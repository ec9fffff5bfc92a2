"""Contract checks for operators.

The Gramians belong to gradients that occur in training. Gradients may be zero, equal, opposite,
very long, very short, or of very different lengths. Gradients may also span fewer dimensions than
there are views.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.blocks import EMPTY_STATE, BlockKind, PluginState
from crossgrad_core.contract.contexts import OperatorContext
from crossgrad_core.contract.gramian_operator import GramianOperator, MatrixOperator
from crossgrad_core.contract.slots.operator import Operator
from crossgrad_core.testing.support.aggregation import AGGREGATION_CHECKS
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import (
    Check,
    Make,
    admitted,
    cannot_tell,
    global_randomness_untouched,
    require,
    revived,
    same_state,
)

Array = NDArray[np.float64]

_SIZE = 8
_KINDS: tuple[BlockKind, ...] = ("geometry", "appearance", "neutral")
#: Number of steps for which the operator's state is checked.
_STEPS = 4
#: A power of two, so that scaling gradients does not cause rounding errors in Gramians.
_SCALE = 64.0
_TOLERANCE = 1e-6
#: Largest relative difference between two results of an iterative solver for one problem.
_SOLVED = 1e-3


@dataclass(frozen=True, eq=False)
class OperatorCase:
    """Gradients of K views with the context of the operator.

    Each family of gradients forms a block.

    Attributes:
        families: [B] names of the families, which describe the gradients.
        gramians: [B, K, K] Gramians of the gradients.
        context: The context of the operator.
    """

    families: tuple[str, ...]
    gramians: Array
    context: OperatorContext


def operator_case(views: int, step: int = 1, scale: float = 1.0) -> OperatorCase:
    """Create gradients of all families for `views` views, times `scale`.

    Each step uses other random numbers.
    """
    rng = np.random.default_rng(step)
    families = dict(_families(rng.normal(size=(views, _SIZE))))
    gradients = scale * np.stack(list(families.values()))
    gramians = gradients @ gradients.transpose(0, 2, 1)
    context = OperatorContext(
        step=step,
        blocks=tuple(name.replace(" ", "_") for name in families),
        kinds=tuple(_KINDS[block % len(_KINDS)] for block in range(len(families))),
        losses=rng.uniform(0.05, 0.3, views),
        labels=tuple(("near", "far")[view % 2] for view in range(views)),
        distances=rng.uniform(0.2, 1.0, views),
        reference_distance=0.5,
        present=np.einsum("bkk->bk", gramians) > 0.0,
    )
    return OperatorCase(tuple(families), gramians, context)


def _families(draw: Array) -> Iterator[tuple[str, Array]]:
    """Yield the names and gradients [K, _SIZE] of all families, made from a random sample."""
    views = len(draw)
    ramp = np.arange(views)[:, None]
    yield "usual", draw
    yield "zero", np.zeros_like(draw)
    yield "one view without gradient", np.where(ramp == 0, 0.0, draw)
    yield "gradients in one view only", np.where(ramp == views - 1, draw, 0.0)
    yield "equal", np.repeat(draw[:1], views, axis=0)
    yield "opposite", draw[:1] * (-1.0) ** ramp
    yield "parallel gradients of different length", draw[:1] * (1.0 + ramp)
    yield "two dimensions", np.where(np.arange(_SIZE) < 2, draw, 0.0)  # noqa: PLR2004
    yield "length ratio 1e6", draw * 10.0 ** (6.0 * (ramp % 2))
    yield "very long", draw * 1e30
    yield "very short", draw * 1e-30


def transformed(
    operator: MatrixOperator, case: OperatorCase, state: PluginState = EMPTY_STATE, seed: int = 0
) -> tuple[Array, PluginState]:
    """Return the matrices and the state that the operator returns for a case."""
    rng = np.random.default_rng(seed)
    return operator.transform(case.gramians, case.context, state, rng)


def _matrix_operator(make: Make[Operator]) -> MatrixOperator:
    """Return the operator if it is a matrix operator.

    Raises:
        SkipTest: The operator needs the gradients themselves.
    """
    operator = make()
    if not isinstance(operator, MatrixOperator):
        raise cannot_tell("it needs the gradients themselves and returns no matrix")
    return operator


def matrices_have_the_shape(make: Make[Operator]) -> None:
    """`transform` returns matrices [B, R, K] in float64 for each supported number of views K."""
    operator = _matrix_operator(make)
    for views in admitted(operator.views):
        case = operator_case(views)
        matrices, _ = transformed(operator, case)
        blocks = len(case.families)
        expected = f"[{blocks}, R, {views}] for K = {views}"
        shape = np.shape(matrices)
        fits = len(shape) == 3 and (shape[0], shape[2]) == (blocks, views)  # noqa: PLR2004
        require(fits, f"the matrices have the shape {list(shape)}, expected {expected}")
        require(matrices.dtype == np.float64, f"the matrices are {matrices.dtype}, not float64")


def matrices_are_finite(make: Make[Operator]) -> None:
    """Finite gradients never lead to NaN or infinity in the matrices."""
    operator = _matrix_operator(make)
    for views in admitted(operator.views):
        case = operator_case(views)
        matrices, _ = transformed(operator, case)
        for family, matrix in zip(case.families, matrices, strict=True):
            require(
                np.isfinite(matrix).all(),
                f"K = {views}, gradients: {family}: the matrix is not finite: {matrix.tolist()}",
            )


def one_block_is_enough(make: Make[Operator]) -> None:
    """Each block is processed separately: other blocks do not change its matrix."""
    operator = _matrix_operator(make)
    for views in admitted(operator.views):
        case = operator_case(views)
        matrices, _ = transformed(operator, case)
        alone, _ = transformed(operator, _only(case, 0))
        require(
            np.shape(alone)[0] == 1 and np.allclose(alone[0], matrices[0], rtol=_TOLERANCE),
            f"K = {views}: the first block's matrix depends on other blocks",
        )


def _only(case: OperatorCase, block: int) -> OperatorCase:
    context = case.context
    one = slice(block, block + 1)
    alone = OperatorContext(
        context.step,
        context.blocks[one],
        context.kinds[one],
        context.losses,
        context.labels,
        context.distances,
        context.reference_distance,
        context.present[one],
    )
    return OperatorCase(case.families[one], case.gramians[one], alone)


def inputs_stay_untouched(make: Make[Operator]) -> None:
    """`transform` does not change the Gramians, the context or the previous state."""
    operator = _matrix_operator(make)
    for views in admitted(operator.views):
        _, state = transformed(operator, operator_case(views))
        before, kept = operator_case(views, 2), revived(state)
        case = operator_case(views, 2)
        transformed(operator, case, state)
        for name in ("losses", "distances", "present"):
            same = np.array_equal(getattr(case.context, name), getattr(before.context, name))
            require(same, f"transform changes context.{name}")
        require(np.array_equal(case.gramians, before.gramians), "transform changes the Gramians")
        require(same_state(state, kept), "transform changes the state that it received")


def same_seed_same_answer(make: Make[Operator]) -> None:
    """The result depends only on the arguments, and random numbers come from `rng`."""
    operator = _matrix_operator(make)
    for views in admitted(operator.views):
        with global_randomness_untouched():
            one, one_state = transformed(operator, operator_case(views))
            other, other_state = transformed(_matrix_operator(make), operator_case(views))
        require(
            np.array_equal(one, other),
            f"K = {views}: two calls with the same seed return different results",
        )
        require(
            same_state(one_state, other_state),
            f"K = {views}: two calls with the same seed return different states",
        )


def state_survives_a_checkpoint(make: Make[Operator]) -> None:
    """After each step, the state can be saved and loaded.

    A run that continues from the saved state gives a bit-identical next result.
    """
    operator = _matrix_operator(make)
    for views in admitted(operator.views):
        state, copy = PluginState(), PluginState()
        for step in range(1, _STEPS + 1):
            case = operator_case(views, step)
            matrices, state = transformed(operator, case, state, step)
            again, copy = transformed(operator, case, revived(copy), step)
            require(
                np.array_equal(matrices, again),
                f"K = {views}, step {step}: the result differs after a checkpoint; keep all "
                "state in the returned state",
            )


def one_view_keeps_its_direction(make: Make[Operator]) -> None:
    """With a single view, the result is a positive multiple of its gradient."""
    operator = _matrix_operator(make)
    if not operator.views.admits(1):
        raise cannot_tell(f"it needs {operator.views}")
    case = operator_case(1)
    weights = transformed(operator, case)[0].sum(axis=1)
    for family, weight, present in zip(case.families, weights, case.context.present, strict=True):
        require(
            weight[0] > 0.0 or not present[0],
            f"gradients: {family}: the only view has the weight {weight[0]}, which is not positive",
        )


def scales_with_the_gradients(make: Make[Operator]) -> None:
    """If all gradients are multiplied by c > 0, the result is multiplied by c.

    Thresholds must not depend on absolute lengths.
    """
    operator = _matrix_operator(make)
    for views in admitted(operator.views):
        case, scaled = operator_case(views), operator_case(views, scale=_SCALE)
        weights = transformed(operator, case)[0].sum(axis=1)
        again = transformed(operator, scaled)[0].sum(axis=1)
        lengths = np.sqrt(np.einsum("bkk->bk", case.gramians))
        for family, one, other, length in zip(case.families, weights, again, lengths, strict=True):
            # The error is compared with the longest summand, because rounding errors are
            # proportional to its length.
            error = np.abs((one - other) * length).max()
            size = np.abs(one * length).max()
            require(
                error <= _TOLERANCE * size,
                f"K = {views}, gradients: {family}: the weights {one.tolist()} become "
                f"{other.tolist()} if all gradients are {_SCALE:g} times as long; compare "
                "lengths with each other, never with a constant",
            )


def views_that_are_alike_count_alike(make: Make[Operator]) -> None:
    """The order of the views has no effect: views with equal properties get equal weights.

    All tested gradients have equal lengths and equal angles to each other. With more than two
    views, only right angles are tested. For conflicting gradients, an operator may process pairs
    one after another.
    """
    operator = _matrix_operator(make)
    for views in admitted(operator.views):
        for cosine in (0.0, -0.5, 0.5) if views == 2 else (0.0,):  # noqa: PLR2004
            gramians = np.full((1, views, views), cosine)
            gramians[0, range(views), range(views)] = 1.0
            case = _alike(_only(operator_case(views), 0), gramians)
            weights, others = (
                transformed(operator, case, seed=n)[0][0].sum(axis=0) for n in (0, 1)
            )
            if not np.array_equal(weights, others):
                raise cannot_tell("its weights depend on random numbers")
            require(
                np.ptp(weights) <= _SOLVED * np.abs(weights).max(),
                f"K = {views}, gradients of equal length with the cosine {cosine:g}, and "
                "equal labels, losses and distances: transform returns the weights "
                f"{weights.tolist()}; expected equal weights: distinguish views by labels, "
                "losses or Gramians, never by their position in the step",
            )


def _alike(case: OperatorCase, gramians: Array) -> OperatorCase:
    """Return the case with `gramians` for one block.

    Labels, losses and distances of all views are equal.
    """
    number = gramians.shape[1]
    context = replace(
        case.context,
        losses=np.full(number, 0.1),
        labels=("near",) * number,
        distances=np.full(number, 0.5),
        present=np.ones((1, number), dtype=np.bool_),
    )
    return OperatorCase(case.families, gramians, context)


def what_it_reads_is_declared(make: Make[Operator]) -> None:
    """`reads_labels` and `reads_gramians` are correct.

    The declarations matter: a run refuses a grouping if no component reads labels, and a
    granularity if no component reads Gramians.
    """
    operator = _matrix_operator(make)
    for views in admitted(operator.views):
        case = operator_case(views)
        matrices, _ = transformed(operator, case)
        if not operator.reads_labels():
            labels = tuple("far" for _ in range(views))
            other = OperatorCase(case.families, case.gramians, replace(case.context, labels=labels))
            require(
                np.array_equal(transformed(operator, other)[0], matrices),
                f"K = {views}: other labels change the matrices, although reads_labels() is False",
            )
        if isinstance(operator, GramianOperator) and not operator.reads_gramians():
            turned = OperatorCase(case.families, case.gramians[:, ::-1, ::-1], case.context)
            require(
                np.array_equal(transformed(operator, turned)[0], matrices),
                f"K = {views}: other Gramians change the matrices, although reads_gramians() "
                "is False",
            )


OPERATOR_CHECKS: tuple[Check[Operator], ...] = (
    *COMPONENT_CHECKS,
    *AGGREGATION_CHECKS,
    matrices_have_the_shape,
    matrices_are_finite,
    one_block_is_enough,
    inputs_stay_untouched,
    same_seed_same_answer,
    state_survives_a_checkpoint,
    one_view_keeps_its_direction,
    scales_with_the_gradients,
    views_that_are_alike_count_alike,
    what_it_reads_is_declared,
)
