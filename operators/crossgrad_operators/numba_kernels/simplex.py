"""Minima over convex combinations of the gradients (MGDA, CAGrad).

Weights w on the simplex are held as x_k = w_k |g_k| / s, s the smallest norm, so that whatever the
ratio of the norms the combination is sum x_k e_k with cosines alone, and the constraint reads
sum_k r_k x_k = 1 with r_k = s / |g_k|. Both problems are

    minimise  q.x + rho sqrt(x^T C x)   (CAGrad)      or      x^T C x   (MGDA: q = 0)

and on the face of a support S their minimum is known in closed form from C_SS^-1 r and C_SS^-1 q.
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

#: Up to this many gradients all supports are tried; above, they are found one by one.
ENUMERATED = 4
#: A multiplier counts as negative beyond this share of the objective's gradient.
TOLERANCE = 1e-14


@njit(cache=True)
def _value(cosines: Floats, q: Floats, rho: float, x: Floats) -> float:
    square: float = max(form(x, cosines, x), 0.0)
    if rho < 0.0:
        return square
    total: float = rho * np.sqrt(square)
    for k in range(x.size):
        total += q[k] * x[k]
    return total


@njit(cache=True)
def _face(
    cosines: Floats, r: Floats, q: Floats, rho: float, chosen: Indices, count: int, x: Floats
) -> bool:
    """Minimum on the affine hull of a support; False where there is none (rho < 0 is MGDA).

    Stationarity q + rho C x / |x| = lambda r gives x = t (lambda a - p) with a = C^-1 r and
    p = C^-1 q; |x| = rho t and r.x = 1 then fix lambda and t.
    """
    views = r.size
    a = np.zeros(views)
    p = np.zeros(views)
    solve(cosines, chosen, count, r, a)
    ra = 0.0
    for i in range(count):
        ra += r[chosen[i]] * a[chosen[i]]
    x[:] = 0.0
    if not ra > 0.0:
        return False
    if rho < 0.0:
        for i in range(count):
            x[chosen[i]] = a[chosen[i]] / ra
        return True
    solve(cosines, chosen, count, q, p)
    rp = 0.0
    qp = 0.0
    for i in range(count):
        rp += r[chosen[i]] * p[chosen[i]]
        qp += q[chosen[i]] * p[chosen[i]]
    root = rp * rp - ra * (qp - rho * rho)
    if not root > 0.0:
        return False
    root = np.sqrt(root)
    for i in range(count):
        k = chosen[i]
        x[k] = ((rp + root) / ra * a[k] - p[k]) / root
    return True


@njit(cache=True)
def _by_enumeration(
    cosines: Floats, r: Floats, q: Floats, rho: float, members: Indices, count: int
) -> Floats:
    """The best of all supports whose weights are not negative."""
    chosen = np.empty(count, np.int64)
    x = np.zeros(r.size)
    found = np.zeros(r.size)
    best = np.inf
    for code in range(1, 1 << count):
        size = 0
        for i in range(count):
            if code >> i & 1:
                chosen[size] = members[i]
                size += 1
        if size == 1:
            x[:] = 0.0
            x[chosen[0]] = 1.0 / r[chosen[0]]
        elif not _face(cosines, r, q, rho, chosen, size, x):
            continue
        feasible = True
        for i in range(size):
            feasible &= x[chosen[i]] >= 0.0
        if feasible:
            value = _value(cosines, q, rho, x)
            if value < best:
                best = value
                found[:] = x
    return found


@njit(cache=True)
def _entering(
    cosines: Floats, r: Floats, q: Floats, rho: float, active: Flags, present: Flags, x: Floats
) -> int:
    """The view whose weight should grow most, -1 at the minimum."""
    views = r.size
    length = np.sqrt(max(form(x, cosines, x), 0.0))
    if length == 0.0:
        return -1
    factor = 1.0 if rho < 0.0 else rho / length
    slope = np.zeros(views)
    level = 0.0
    scale = 0.0
    for k in range(views):
        slope[k] = factor * times(cosines, k, x) + (0.0 if rho < 0.0 else q[k])
        level += slope[k] * x[k]
        scale = max(scale, abs(slope[k]))
    worst, entering = -TOLERANCE * scale, -1
    for k in range(views):
        if present[k] and not active[k] and slope[k] - level * r[k] < worst:
            worst, entering = slope[k] - level * r[k], k
    return entering


@njit(cache=True)
def _by_active_set(cosines: Floats, r: Floats, q: Floats, rho: float, present: Flags) -> Floats:
    """Wolfe's method: supports grow by the best view and shrink where a weight meets zero.

    The objective falls with every support, so that none comes twice; the optimality conditions hold
    to `TOLERANCE` at the end.
    """
    views = r.size
    active = np.zeros(views, np.bool_)
    chosen = np.empty(views, np.int64)
    x = np.zeros(views)
    trial = np.zeros(views)
    best = np.inf
    start = -1
    for k in range(views):
        if present[k]:
            trial[:] = 0.0
            trial[k] = 1.0 / r[k]
            value = _value(cosines, q, rho, trial)
            if value < best:
                best, start = value, k
    x[start] = 1.0 / r[start]
    active[start] = True
    for _ in range(10 * views):
        entering = _entering(cosines, r, q, rho, active, present, x)
        if entering < 0:
            break
        before = _value(cosines, q, rho, x)
        kept, kept_active = x.copy(), active.copy()
        active[entering] = True
        _settle(cosines, r, q, rho, active, chosen, x, trial)
        if not _value(cosines, q, rho, x) < before:
            # Rounding has the last word: no further progress is possible.
            x[:] = kept
            active[:] = kept_active
            break
    return x


@njit(cache=True)
def _settle(
    cosines: Floats,
    r: Floats,
    q: Floats,
    rho: float,
    active: Flags,
    chosen: Indices,
    x: Floats,
    trial: Floats,
) -> None:
    """Goes to the minimum of the active face, dropping views whose weight meets zero."""
    views = r.size
    while True:
        count = 0
        for k in range(views):
            if active[k]:
                chosen[count] = k
                count += 1
        if count == 1:
            trial[:] = 0.0
            trial[chosen[0]] = 1.0 / r[chosen[0]]
        elif not _face(cosines, r, q, rho, chosen, count, trial):
            return
        step, leaving = 1.0, -1
        for i in range(count):
            k = chosen[i]
            if trial[k] <= 0.0 and x[k] - trial[k] > 0.0:
                share = x[k] / (x[k] - trial[k])
                if share < step:
                    step, leaving = share, k
        for k in range(views):
            x[k] += step * (trial[k] - x[k])
        if leaving < 0:
            return
        x[leaving] = 0.0
        active[leaving] = False


@njit(cache=True)
def _minimum(
    cosines: Floats,
    r: Floats,
    q: Floats,
    rho: float,
    members: Indices,
    count: int,
    present: Flags,
) -> Floats:
    if count <= ENUMERATED:
        return _by_enumeration(cosines, r, q, rho, members, count)
    return _by_active_set(cosines, r, q, rho, present)


@njit(cache=True)
def _is_noise(cosines: Floats, x: Floats) -> bool:
    largest = np.abs(x).max()
    return bool(form(x, cosines, x) <= 2.0 * OPPOSITE * largest * largest)


@njit(cache=True)
def mgda(gramians: Floats, present: Flags) -> Floats:
    """[B, K] weights of the shortest convex combination; zero where that is zero to rounding."""
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views))
    norms, cosines = np.empty(views), np.empty((views, views))
    members = np.empty(views, np.int64)
    r, q = np.zeros(views), np.zeros(views)
    for b in range(blocks):
        normalised(gramians[b], present[b], norms, cosines)
        count = _reciprocals(norms, present[b], members, r)
        if count == 0:
            continue
        x = _minimum(cosines, r, q, -1.0, members, count, present[b])
        if not _is_noise(cosines, x):
            for k in range(views):
                result[b, k] = x[k] * r[k]
    return result


@njit(cache=True)
def _reciprocals(norms: Floats, present: Flags, members: Indices, r: Floats) -> int:
    """Fills r_k = s / |g_k| and the members; returns their number."""
    count = 0
    shortest = np.inf
    for k in range(present.size):
        r[k] = 0.0
        if present[k]:
            members[count] = k
            count += 1
            shortest = min(shortest, norms[k])
    for i in range(count):
        r[members[i]] = shortest / norms[members[i]]
    return count


@njit(cache=True)
def _cagrad_pair(n1: float, n2: float, cosine: float, c: float) -> tuple[float, float, float]:
    """Weight of g_1 in g_w, |g_w| and |g_0| (g_0 the mean of the two), for 1 = n1 >= n2.

    The objective (a - b) x / 2 + c |g_0| sqrt(D (x - x_0)^2 + h^2) is convex in x. Sums of squares
    are arranged so that nothing cancels but the cosine itself, and the weight that may be tiny is
    that of the longer gradient.
    """
    product = n1 * n2
    gap = (n1 - n2) * (n1 - n2)
    between = gap + 2.0 * product * (1.0 - cosine)
    mean = 0.5 * np.sqrt(gap + 2.0 * product * (1.0 + cosine))
    if between <= 0.0:
        return 0.5, mean, mean
    x0 = n2 * (n2 - cosine * n1) / between
    slope = (n1 - n2) * (n1 + n2)
    steep = 2.0 * c * mean * np.sqrt(between)
    x = 0.0
    if slope < steep:
        h = product * np.sqrt((1.0 - cosine) * (1.0 + cosine) / between)
        ratio = slope / steep
        x = x0 - h * ratio / np.sqrt((1.0 - ratio) * (1.0 + ratio)) / np.sqrt(between)
        x = min(max(x, 0.0), 1.0)
    one, other = x * n1, (1.0 - x) * n2
    length = np.sqrt((one - other) * (one - other) + 2.0 * one * other * (1.0 + cosine))
    return x, length, mean


@njit(cache=True)
def cagrad(gramians: Floats, present: Flags, c: float) -> Floats:
    """[B, K] weights 1/K + c |g_0| w_k / |g_w| of CAGrad's direction, without rescaling."""
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views))
    norms, cosines = np.empty(views), np.empty((views, views))
    members = np.empty(views, np.int64)
    r, q = np.zeros(views), np.zeros(views)
    for b in range(blocks):
        normalised(gramians[b], present[b], norms, cosines)
        count = _reciprocals(norms, present[b], members, r)
        if count == 0:
            continue
        if count == 1 or c == 0.0:
            for i in range(count):
                result[b, members[i]] = 1.0 / views
            continue
        longest = norms.max()
        if count == 2:
            i, j = members[0], members[1]
            if norms[i] < norms[j]:
                i, j = j, i
            if 1.0 + cosines[i, j] <= OPPOSITE:
                result[b, i] = result[b, j] = max(1.0 - c, 0.0) / views
                continue
            n1, n2 = norms[i] / longest, norms[j] / longest
            share, length, mean = _cagrad_pair(n1, n2, cosines[i, j], c)
            if length > 0.0:
                # The mean is over K views; that over the two present ones is K / 2 times longer.
                factor = c * mean / length
                result[b, i] = (0.5 + factor * share) * 2.0 / views
                result[b, j] = (0.5 + factor * (1.0 - share)) * 2.0 / views
            continue
        lengths = norms / longest / count
        for k in range(views):
            q[k] = times(cosines, k, lengths)
        mean = np.sqrt(max(form(lengths, cosines, lengths), 0.0))
        x = _minimum(cosines, r, q, c * mean, members, count, present[b])
        length = np.sqrt(max(form(x, cosines, x), 0.0))
        # Where a convex combination vanishes the direction is undefined, and zero by convention.
        if _is_noise(cosines, x):
            continue
        for i in range(count):
            k = members[i]
            added = c * mean * x[k] / length if mean > 0.0 else 0.0
            total = lengths[k] + added
            result[b, k] = total * (longest / norms[k]) * count / views
    return result
