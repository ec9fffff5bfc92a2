"""Kernels for pairwise projection.

Each gradient is changed by its conflicts with the other gradients, in turn.

A vector v is stored as a sum of unit gradients. The coefficients of this sum have 16 or 32 digits.
"""

import numpy as np

from crossgrad_core.numerics.jit import strict_device, strict_kernel
from crossgrad_operators.numba_kernels.digits import (
    ONE,
    Exact,
    Pair,
    Pairs,
    at,
    clear,
    minus,
    plus,
    product,
    products,
    put,
    quotient,
    root,
)
from crossgrad_operators.numba_kernels.directions import Solved, directions, form, limited
from crossgrad_operators.numba_kernels.normal import (
    CANCELLED,
    CAUTION,
    EPSILON,
    OPPOSITE,
    Flags,
    Floats,
    Indices,
)


@strict_device
def _start(v: Pairs, i: int) -> None:
    """Set v to the unit gradient of view i."""
    clear(v)
    v[i, 0] = 1.0


@strict_device
def _as_row(v: Pairs, norms: Pairs, i: int, row: Floats, exact: Exact) -> None:
    """Convert coefficients of unit gradients, in units of |g_i|, to coefficients of the g_k."""
    for k in range(len(v)):
        if v[k, 0] != 0.0:
            ratio = quotient(at(norms, i), at(norms, k), exact)
            row[k] = product(at(v, k), ratio, exact)[0]


@strict_device
def _remaining(v: Pairs, cosines: Pairs, exact: Exact) -> Pair:
    """Return the length of a projected vector.

    A vector that is only rounding noise is set to zero.
    """
    square, longest = form(v, cosines, exact), np.abs(v[:, 0]).max()
    if square[0] <= CANCELLED * longest * longest:
        clear(v)
        return 0.0, 0.0
    return root(square, exact)


@strict_device
def _is_opposite(cosine: Pair, exact: Exact) -> bool:
    """Return True if 1 + cos is at most `OPPOSITE`."""
    return plus(ONE, cosine, exact)[0] <= OPPOSITE


@strict_device
def _conflicts(along: Pair, size: Pair, least: Pair, exact: Exact) -> bool:
    """Return True if the cosine `along` / `size` is below -`least`."""
    return along[0] < 0.0 and plus(along, product(least, size, exact), exact)[0] < 0.0


@strict_kernel
def projected(
    gramians: Floats,
    rounding_residuals: Floats,
    present: Flags,
    order: Indices,
    gates: Flags,
    rule: tuple[float, float],
    exact: Exact,
) -> Floats:
    """Return rows v_i [B, K, K]: the gradient g_i after projection against the other gradients.

    For each i and all j in order[i]: if cos(v, g_j) < -threshold, v -= strength (v.g_j / |g_j|^2)
    g_j. The original gradient g_j is used. With strength 1, a vector v that is exactly opposite to
    g_j becomes zero. A vector v also becomes zero if its length is below 1.4e-6 times the length of
    its longest summand.

    Args:
        gramians: [B, K, K] Gramians.
        rounding_residuals: [B, K, K] rounding residuals of the Gramians; unused with 16 digits.
        present: [B, K] True for views that have a gradient.
        order: [K, K] order of the other views for each view i. An entry equal to i is skipped.
        gates: [B, K, K] True if gradient i may be projected against gradient j.
        rule: Threshold (0 or more) and strength (0 to 1).
        exact: True for 32 digits, None for 16 digits.
    """
    threshold, strength = rule
    # With a threshold of 0, the rule is continuous. With a continuous rule, the sign of a cosine
    # near zero hardly matters, so that no margin is needed.
    margin = 0.0 if threshold == 0.0 else OPPOSITE
    least = plus((threshold, 0.0), (margin, 0.0), exact)
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views, views))
    norms, v = np.zeros((views, 2)), np.zeros((views, 2))
    cosines = np.zeros((views, views, 2))
    for b in range(blocks):
        directions(gramians[b], rounding_residuals[b], present[b], norms, cosines, exact)
        for i in range(views):
            if not present[b, i]:
                continue
            _start(v, i)
            size = ONE
            for j in order[i]:
                if j == i or not gates[b, i, j] or not present[b, j] or size[0] == 0.0:
                    continue
                along = products(cosines[j], v, 0, views, exact)
                if _conflicts(along, size, least, exact):
                    if strength == 1.0 and _is_opposite(quotient(along, size, exact), exact):
                        clear(v)
                        size = (0.0, 0.0)
                    else:
                        taken = product((strength, 0.0), along, exact)
                        put(v, j, minus(at(v, j), taken, exact))
                        size = _remaining(v, cosines, exact)
            _as_row(v, norms, i, result[b, i], exact)
    return result


@strict_device
def _blur(v: Pairs, size: float, phi: float, t: float) -> float:
    """Return the factor by which errors of the cosines grow in the targets or in the result."""
    share = np.abs(v[:, 0]).max() / size
    steep = 1.0 + abs(t) / np.sqrt((1.0 - t) * (1.0 + t))
    across = max(np.sqrt((1.0 - phi) * (1.0 + phi)), 1e-6)
    return float(share * share * steep / across)


@strict_device
def _sine(cosine: Pair, exact: Exact) -> Pair:
    """Return the sine of an angle between 0 and pi, from its cosine."""
    one, other = minus(ONE, cosine, exact), plus(ONE, cosine, exact)
    return root(product(one, other, exact), exact)


@strict_device
def _moved(target: float, phi: Pair, beta: float, exact: Exact) -> float:
    """Return (1 - beta) t + beta phi, clipped to +-0.999, for the target t."""
    kept = product(minus(ONE, (beta, 0.0), exact), (target, 0.0), exact)
    moved = plus(kept, product((beta, 0.0), phi, exact), exact)[0]
    return min(max(moved, -0.999), 0.999)


@strict_kernel
def aligned_to_targets(
    gramians: Floats,
    rounding_residuals: Floats,
    present: Flags,
    order: Indices,
    targets: Floats,
    beta: float,
    unit: float,
    exact: Exact,
) -> Solved:
    """Return the rows v_i [B, K, K] of GradVac, and update `targets`.

    For each i and all j in order[i]: phi = cos(v, g_j). If phi is below the target t_ij, a multiple
    of g_j is added to v, so that the cosine becomes t_ij. In any case, the target t_ij becomes (1 -
    beta) t_ij + beta phi, clipped to +-0.999. A vector v becomes exactly zero under the conditions
    that `projected` describes.

    Args:
        gramians: [B, K, K] Gramians.
        rounding_residuals: [B, K, K] rounding residuals of the Gramians; unused with 16 digits.
        present: [B, K] True for views that have a gradient.
        order: [K, K] order of the other views for each view.
        targets: [B, K, K] target cosines, changed in place.
        beta: Weight of the newest cosine in the target.
        unit: Largest relative error for which a result with 16 digits is accepted.
        exact: True for 32 digits, None for 16 digits.

    Returns:
        [B, K, K] rows, and [B] True if rows or targets are ill-conditioned.
    """
    blocks, views, _ = gramians.shape
    result, ill_conditioned = np.zeros((blocks, views, views)), np.zeros(blocks, np.bool_)
    norms, v = np.zeros((views, 2)), np.zeros((views, 2))
    cosines = np.zeros((views, views, 2))
    least = unit / (CAUTION * views * EPSILON)
    for b in range(blocks):
        directions(gramians[b], rounding_residuals[b], present[b], norms, cosines, exact)
        for i in range(views):
            if not present[b, i]:
                continue
            _start(v, i)
            size = ONE
            for j in order[i]:
                if j == i or not present[b, j] or size[0] == 0.0:
                    continue
                along = products(cosines[j], v, 0, views, exact)
                phi = limited(quotient(along, size, exact))
                target = targets[b, i, j]
                if exact is None:
                    ill_conditioned[b] |= _blur(v, size[0], phi[0], target) > least
                targets[b, i, j] = _moved(target, phi, beta, exact)
                if minus(phi, (target, 0.0), exact)[0] < 0.0:
                    if _is_opposite(phi, exact):
                        clear(v)
                        size = (0.0, 0.0)
                    else:
                        across = product(size, _sine(phi, exact), exact)
                        across = product(across, (target, 0.0), exact)
                        raised = quotient(across, _sine((target, 0.0), exact), exact)
                        put(v, j, plus(at(v, j), minus(raised, along, exact), exact))
                        size = _remaining(v, cosines, exact)
            _as_row(v, norms, i, result[b, i], exact)
    return result, ill_conditioned
