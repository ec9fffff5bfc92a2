"""Pairwise projections: each gradient is changed against the others, one after the other."""

import numpy as np
from numba import njit

from crossgrad_operators.numba_kernels.normal import (
    OPPOSITE,
    Flags,
    Floats,
    Indices,
    form,
    normalised,
    times,
)


@njit(cache=True)
def _as_row(factors: Floats, norms: Floats, i: int, row: Floats) -> None:
    """Coefficients of unit vectors, in units of |g_i|, as coefficients of the gradients."""
    for k in range(norms.size):
        row[k] = 0.0 if factors[k] == 0.0 else factors[k] * (norms[i] / norms[k])


@njit(cache=True)
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
    the original g_j. A v that is exactly opposite to g_j becomes exactly zero at full strength.

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
                if along < 0.0 and along < -threshold * size:
                    if strength == 1.0 and 1.0 + along / size <= OPPOSITE:
                        v[:] = 0.0
                        size = 0.0
                    else:
                        v[j] -= strength * along
                        size = np.sqrt(max(form(v, cosines, v), 0.0))
            _as_row(v, norms, i, result[b, i])
    return result


@njit(cache=True)
def aligned_to_targets(
    gramians: Floats, present: Flags, order: Indices, targets: Floats, beta: float
) -> Floats:
    """[B, K, K] rows v_i of GradVac; `targets` [B, K, K] are updated in place.

    For i, for j in order[i]: phi = cos(v, g_j); if phi < t_ij, v gets the multiple of g_j that
    raises the cosine to t_ij; then t_ij <- (1 - beta) t_ij + beta phi, kept within +-0.999.
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
            for j in order[i]:
                if j == i or not present[b, j]:
                    continue
                size = np.sqrt(max(form(v, cosines, v), 0.0))
                if size == 0.0:
                    break
                along = times(cosines, j, v)
                phi = min(max(along / size, -1.0), 1.0)
                t = targets[b, i, j]
                if phi < t:
                    if 1.0 + phi <= OPPOSITE:
                        v[:] = 0.0
                    else:
                        across = size * np.sqrt((1.0 - phi) * (1.0 + phi))
                        v[j] += across * t / np.sqrt((1.0 - t) * (1.0 + t)) - along
                targets[b, i, j] = min(max((1.0 - beta) * t + beta * phi, -0.999), 0.999)
            _as_row(v, norms, i, result[b, i])
    return result
