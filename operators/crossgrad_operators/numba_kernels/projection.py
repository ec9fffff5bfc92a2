"""Pairwise projections: each gradient is changed against the others, one after the other.

`exact_projection` has the same methods with twice the digits.
"""

import numpy as np

from crossgrad_core.numerics.jit import strict_device, strict_kernel
from crossgrad_operators.numba_kernels.normal import (
    CANCELLED,
    CAUTION,
    EPSILON,
    OPPOSITE,
    Flags,
    Floats,
    Indices,
    form,
    normalised,
    times,
)


@strict_device
def _as_row(factors: Floats, norms: Floats, i: int, row: Floats) -> None:
    """Coefficients of unit vectors, in units of |g_i|, as coefficients of the gradients."""
    for k in range(norms.size):
        row[k] = 0.0 if factors[k] == 0.0 else factors[k] * (norms[i] / norms[k])


@strict_device
def _remaining(v: Floats, cosines: Floats) -> float:
    """The length of a projected vector; it becomes zero where only rounding noise is left."""
    square = form(v, cosines, v)
    longest = np.abs(v).max()
    if square <= CANCELLED * longest * longest:
        v[:] = 0.0
        return 0.0
    return float(np.sqrt(square))


@strict_device
def _conflicts(along: float, size: float, threshold: float) -> bool:
    """Whether a cosine along / size is below -threshold, by more than rounding noise."""
    # Without a threshold the rule is continuous, and the sign of zero makes no difference.
    margin = 0.0 if threshold == 0.0 else OPPOSITE
    return along < 0.0 and along < -(threshold + margin) * size


@strict_kernel
def projected(
    gramians: Floats,
    present: Flags,
    order: Indices,
    gates: Flags,
    threshold: float,
    strength: float,
) -> Floats:
    """[B, K, K] rows v_i: g_i without (a share of) its components against the others.

    For i, for j in order[i]: if cos(v, g_j) < -threshold, v -= strength (v.g_j / |g_j|^2) g_j, with
    the original g_j. A v that is exactly opposite to g_j becomes exactly zero at full strength, and
    so does one of which less than 1.4e-6 of its longest summand is left.

    Args:
        gramians: [B, K, K].
        present: [B, K].
        order: [K, K] for each i the order of the partners (i itself is passed over).
        gates: [B, K, K] whether i may be projected along j at all.
        threshold: 0 or more.
        strength: From 0 to 1.
    """
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views, views))
    norms = np.empty(views)
    cosines = np.empty((views, views))
    for b in range(blocks):
        normalised(gramians[b], present[b], norms, cosines)
        for i in range(views):
            if not present[b, i]:
                continue
            v = np.zeros(views)
            v[i] = 1.0
            size = 1.0
            for j in order[i]:
                if j == i or not gates[b, i, j] or not present[b, j] or size == 0.0:
                    continue
                along = times(cosines, j, v)
                if _conflicts(along, size, threshold):
                    if strength == 1.0 and 1.0 + along / size <= OPPOSITE:
                        v[:] = 0.0
                        size = 0.0
                    else:
                        v[j] -= strength * along
                        size = _remaining(v, cosines)
            _as_row(v, norms, i, result[b, i])
    return result


@strict_device
def _blur(v: Floats, size: float, phi: float, t: float) -> float:
    """What errors of the cosines grow by on their way to a target, or through it to the result."""
    share = np.abs(v).max() / size
    steep = 1.0 + abs(t) / np.sqrt((1.0 - t) * (1.0 + t))
    across = max(np.sqrt((1.0 - phi) * (1.0 + phi)), 1e-6)
    return float(share * share * steep / across)


@strict_kernel
def aligned_to_targets(
    gramians: Floats, present: Flags, order: Indices, targets: Floats, beta: float, unit: float
) -> tuple[Floats, Flags]:
    """Rows v_i of GradVac; `targets` [B, K, K] are updated in place.

    For i, for j in order[i]: phi = cos(v, g_j); if phi < t_ij, v gets the multiple of g_j that
    raises the cosine to t_ij; then t_ij <- (1 - beta) t_ij + beta phi, kept within +-0.999. What
    leaves a v exactly zero is as in `projected`.

    Args:
        gramians: [B, K, K].
        present: [B, K].
        order: [K, K].
        targets: [B, K, K].
        beta: Weight of the newest cosine.
        unit: Relative error from which a result is doubtful.

    Returns:
        [B, K, K] rows, and [B] whether they, or the targets, are doubtful.
    """
    blocks, views, _ = gramians.shape
    result, ill_conditioned = np.zeros((blocks, views, views)), np.zeros(blocks, np.bool_)
    norms = np.empty(views)
    cosines = np.empty((views, views))
    for b in range(blocks):
        normalised(gramians[b], present[b], norms, cosines)
        least = unit / (CAUTION * views * EPSILON)
        for i in range(views):
            if not present[b, i]:
                continue
            v = np.zeros(views)
            v[i] = 1.0
            size = 1.0
            for j in order[i]:
                if j == i or not present[b, j] or size == 0.0:
                    continue
                along = times(cosines, j, v)
                phi = min(max(along / size, -1.0), 1.0)
                t = targets[b, i, j]
                ill_conditioned[b] |= _blur(v, size, phi, t) > least
                targets[b, i, j] = min(max((1.0 - beta) * t + beta * phi, -0.999), 0.999)
                if phi < t:
                    if 1.0 + phi <= OPPOSITE:
                        v[:] = 0.0
                        size = 0.0
                    else:
                        across = size * np.sqrt((1.0 - phi) * (1.0 + phi))
                        v[j] += across * t / np.sqrt((1.0 - t) * (1.0 + t)) - along
                        size = _remaining(v, cosines)
            _as_row(v, norms, i, result[b, i])
    return result, ill_conditioned
