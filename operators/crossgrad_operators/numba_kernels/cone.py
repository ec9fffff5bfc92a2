"""Projection on the cone of directions that conflict with no gradient (UPGrad, DualProj).

The projection of b on {x: x.g_l >= 0 for all l} is b + sum_l y_l e_l with y >= 0 of smallest norm,
e_l = g_l / |g_l|: a non-negative least-squares problem in the cosines alone.
"""

import numpy as np
from numba import njit

from crossgrad_operators.numba_kernels.linear import solve
from crossgrad_operators.numba_kernels.normal import (
    OPPOSITE,
    Flags,
    Floats,
    Indices,
    form,
    normalised,
    times,
)

#: Up to this many gradients all active sets are tried; above, they are found one by one.
ENUMERATED = 4
#: A constraint counts as violated beyond this share of the largest coefficient.
TOLERANCE = 1e-14


@njit(cache=True)
def _residual(cosines: Floats, b: Floats) -> Floats:
    """-C b, the right-hand side of every active set."""
    right = np.empty(b.size)
    for k in range(b.size):
        right[k] = -times(cosines, k, b)
    return right


@njit(cache=True)
def _by_enumeration(cosines: Floats, members: Indices, count: int, b: Floats, z: Floats) -> None:
    """The best of all active sets whose multipliers are not negative."""
    right = _residual(cosines, b)
    best = form(b, cosines, b)
    z[:] = b
    chosen = np.empty(count, np.int64)
    y = np.empty(b.size)
    for code in range(1, 1 << count):
        size = 0
        for i in range(count):
            if code >> i & 1:
                chosen[size] = members[i]
                size += 1
        solve(cosines, chosen, size, right, y)
        trial = b.copy()
        feasible = True
        for i in range(size):
            feasible &= y[chosen[i]] >= 0.0
            trial[chosen[i]] += y[chosen[i]]
        if feasible:
            value = form(trial, cosines, trial)
            if value < best:
                best = value
                z[:] = trial


@njit(cache=True)
def _by_active_set(cosines: Floats, members: Indices, count: int, b: Floats, z: Floats) -> None:
    """Lawson and Hanson's algorithm on the normal equations; ends after finitely many sets."""
    views = b.size
    right = _residual(cosines, b)
    y = np.zeros(views)
    trial = np.zeros(views)
    active = np.zeros(views, np.bool_)
    chosen = np.empty(views, np.int64)
    z[:] = b
    for _ in range(10 * views):
        worst, entering = 0.0, -1
        size = 0.0
        for k in range(views):
            size = max(size, abs(z[k]))
        for i in range(count):
            k = members[i]
            if not active[k]:
                slack = times(cosines, k, z)
                if slack < worst:
                    worst, entering = slack, k
        if entering < 0 or worst >= -TOLERANCE * size:
            return
        active[entering] = True
        while True:
            size_of_set = 0
            for k in range(views):
                if active[k]:
                    chosen[size_of_set] = k
                    size_of_set += 1
            solve(cosines, chosen, size_of_set, right, trial)
            step, leaving = 1.0, -1
            for i in range(size_of_set):
                k = chosen[i]
                if trial[k] <= 0.0:
                    share = y[k] / (y[k] - trial[k]) if y[k] > 0.0 else 0.0
                    if share < step or leaving < 0:
                        step, leaving = share, k
            for i in range(size_of_set):
                k = chosen[i]
                y[k] += step * (trial[k] - y[k])
            if leaving < 0:
                break
            y[leaving] = 0.0
            active[leaving] = False
        for k in range(views):
            z[k] = b[k] + y[k]


@njit(cache=True)
def _projected(cosines: Floats, members: Indices, count: int, b: Floats, z: Floats) -> None:
    """Coefficients z of the projection of b; zero where only rounding noise is left of it."""
    if count <= ENUMERATED:
        _by_enumeration(cosines, members, count, b, z)
    else:
        _by_active_set(cosines, members, count, b, z)
    largest = 0.0
    for k in range(z.size):
        largest = max(largest, abs(z[k]))
    if form(z, cosines, z) <= 2.0 * OPPOSITE * largest * largest:
        z[:] = 0.0


@njit(cache=True)
def _members(present: Flags, members: Indices) -> int:
    count = 0
    for k in range(present.size):
        if present[k]:
            members[count] = k
            count += 1
    return count


@njit(cache=True)
def upgrad(gramians: Floats, present: Flags) -> Floats:
    """[B, K, K] rows: each gradient, over K, projected on the cone that conflicts with none."""
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views, views))
    norms, cosines = np.empty(views), np.empty((views, views))
    members = np.empty(views, np.int64)
    z = np.empty(views)
    for block in range(blocks):
        normalised(gramians[block], present[block], norms, cosines)
        count = _members(present[block], members)
        for i in range(count):
            k = members[i]
            b = np.zeros(views)
            b[k] = 1.0
            _projected(cosines, members, count, b, z)
            for j in range(count):
                other = members[j]
                result[block, k, other] = z[other] * (norms[k] / norms[other]) / views
    return result


@njit(cache=True)
def dualproj(gramians: Floats, present: Flags) -> Floats:
    """[B, K] weights of the mean gradient projected on the cone that conflicts with none."""
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views))
    norms, cosines = np.empty(views), np.empty((views, views))
    members = np.empty(views, np.int64)
    z = np.empty(views)
    for block in range(blocks):
        normalised(gramians[block], present[block], norms, cosines)
        count = _members(present[block], members)
        longest = norms.max()
        if count == 0:
            continue
        _projected(cosines, members, count, norms / longest, z)
        for i in range(count):
            k = members[i]
            result[block, k] = z[k] * (longest / norms[k]) / views
    return result
