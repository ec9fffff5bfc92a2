"""Pairwise projections in 32 digits (PCGrad and its kin at the first step)."""

import numpy as np

from crossgrad_core.jit import strict_kernel, strict_part
from crossgrad_core.stress.search.numba_kernels.convex import NOISE, Solved
from crossgrad_core.stress.search.numba_kernels.doubled import (
    Flags,
    Floats,
    Indices,
    add,
    at,
    divide,
    minus,
    multiply,
    root,
)
from crossgrad_core.stress.search.numba_kernels.linear import dot, form, largest

#: 1 + cos up to which two directions are exactly opposite.
OPPOSITE = 1e-12


@strict_kernel
def projected(
    norms_of: Floats,
    cosines_of: Floats,
    present: Flags,
    order: Indices,
    limit: float,
    threshold: float,
    strength: float,
    divisor: float,
) -> Solved:
    """Weights [B, K, 2] of the sum of v_i: g_i without (a share of) its components against others.

    Args:
        norms_of: [B, K, 2].
        cosines_of: [B, K, K, 2].
        present: [B, K].
        order: [K, K] for each i the order of its partners.
        limit: Only pairs of gradients whose cosine is at most this are projected.
        threshold: Only cosines below minus this count as a conflict.
        strength: From 0 to 1.
        divisor: Of the sum.
    """
    blocks, views = present.shape
    weights = np.zeros((blocks, views, 2))
    v = np.empty((views, 2))
    for block in range(blocks):
        norms, cosines = norms_of[block], cosines_of[block]
        for i in range(views):
            if present[block, i]:
                _one(cosines, present[block], order[i], (limit, threshold, strength), i, v)
                for k in range(views):
                    if v[k, 0] != 0.0:
                        unit = multiply(at(norms, k), (divisor, 0.0))
                        length = divide(at(norms, i), unit)
                        value = add(at(weights[block], k), multiply(at(v, k), length))
                        weights[block, k, 0], weights[block, k, 1] = value
    return weights, np.ones(blocks)


@strict_part
def _one(
    cosines: Floats,
    present: Flags,
    order: Indices,
    rule: tuple[float, float, float],
    i: int,
    v: Floats,
) -> None:
    limit, threshold, strength = rule
    margin = 0.0 if threshold == 0.0 else OPPOSITE
    v[:] = 0.0
    v[i, 0] = 1.0
    for j in order:
        if j == i or not present[j] or cosines[i, j, 0] > limit:
            continue
        square = form(cosines, v)
        if square[0] <= NOISE * largest(v) ** 2:
            v[:] = 0.0
            return
        size = root(square)
        along = dot(cosines[j], v)
        cosine = divide(along, size)
        # A conflict at the threshold itself, where the rule jumps, is none.
        if not (cosine[0] < 0.0 and add(cosine, (threshold, 0.0))[0] < -margin):
            continue
        if strength == 1.0 and add((1.0, 0.0), cosine)[0] <= OPPOSITE:
            v[:] = 0.0
            return
        removed = multiply((strength, 0.0), along)
        v[j, 0], v[j, 1] = add(at(v, j), minus(removed))
    if form(cosines, v)[0] <= NOISE * largest(v) ** 2:
        v[:] = 0.0
