"""The methods of `projection` from Gramians with twice the digits."""

import numpy as np

from crossgrad_core.numerics.double_double import add, divide, multiply, square_root
from crossgrad_core.numerics.jit import strict_device, strict_kernel
from crossgrad_operators.numba_kernels.exact_linear import exact_cosines, exact_form, inner
from crossgrad_operators.numba_kernels.normal import CANCELLED, OPPOSITE, Flags, Floats, Indices


@strict_kernel
def _partners(order: Indices, places: Indices) -> Indices:
    """[n, n - 1] partners of the views at `places`, as positions there, in their order [K, K]."""
    n = places.size
    position = np.full(order.shape[0], -1)
    for i in range(n):
        position[places[i]] = i
    partners = np.empty((n, max(n - 1, 0)), np.int64)
    for i in range(n):
        count = 0
        for j in order[places[i]]:
            if position[j] >= 0 and position[j] != i:
                partners[i, count] = position[j]
                count += 1
    return partners


@strict_kernel
def _remaining(v: Floats, cosines: Floats) -> tuple[float, float]:
    """The length of a projected vector; it becomes zero where only rounding noise is left."""
    square, square_low = exact_form(cosines, v)
    longest = np.abs(v[0]).max()
    if square <= CANCELLED * longest * longest:
        v[:] = 0.0
        return 0.0, 0.0
    return square_root(square, square_low)


@strict_device
def _start(v: Floats, i: int) -> None:
    v[:] = 0.0
    v[0, i] = 1.0


@strict_device
def _shift(v: Floats, j: int, x: float, x_low: float) -> None:
    """Adds x to the j-th coefficient."""
    v[0, j], v[1, j] = add(v[0, j], v[1, j], x, x_low)


@strict_kernel
def _as_row(v: Floats, norms: Floats, places: Indices, i: int, row: Floats) -> None:
    """Coefficients of unit vectors, in units of |g_i|, as coefficients of the gradients."""
    for k in range(places.size):
        if v[0, k] != 0.0:
            ratio, ratio_low = divide(norms[0, i], norms[1, i], norms[0, k], norms[1, k])
            row[places[k]] = multiply(v[0, k], v[1, k], ratio, ratio_low)[0]


@strict_kernel
def _project(
    cosines: Floats, i: int, partners: Indices, gates: Flags, rule: tuple[float, float], v: Floats
) -> None:
    """One row of `exact_projected`; the rule is threshold and strength."""
    threshold, strength = rule
    margin = 0.0 if threshold == 0.0 else OPPOSITE
    _start(v, i)
    size, size_low = 1.0, 0.0
    for place in range(partners.size):
        j = partners[place]
        if not gates[place]:
            continue
        along, along_low = inner(cosines[0, j], cosines[1, j], v[0], v[1])
        phi, phi_low = divide(along, along_low, size, size_low)
        if not (phi < 0.0 and add(phi, phi_low, threshold, 0.0)[0] < -margin):
            continue
        if strength == 1.0 and add(1.0, 0.0, phi, phi_low)[0] <= OPPOSITE:
            v[:] = 0.0
            return
        along, along_low = multiply(along, along_low, -strength, 0.0)
        _shift(v, j, along, along_low)
        size, size_low = _remaining(v, cosines)
        if size == 0.0:
            return


@strict_kernel
def exact_projected(
    gramians: Floats,
    rounding_residuals: Floats,
    present: Flags,
    order: Indices,
    gates: Flags,
    rule: tuple[float, float],
) -> Floats:
    """[B, K, K] rows of `projection.projected`; the rule is threshold and strength."""
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views, views))
    for b in range(blocks):
        places = np.flatnonzero(present[b])
        n = places.size
        norms, cosines = exact_cosines(gramians[b], rounding_residuals[b], places)
        partners = _partners(order, places)
        v, open_gates = np.empty((2, n)), np.empty(max(n - 1, 0), np.bool_)
        for i in range(n):
            for place in range(n - 1):
                open_gates[place] = gates[b, places[i], places[partners[i, place]]]
            _project(cosines, i, partners[i], open_gates, rule, v)
            _as_row(v, norms, places, i, result[b, places[i]])
    return result


@strict_kernel
def _raised(
    phi: float, phi_low: float, t: float, size: float, size_low: float
) -> tuple[float, float]:
    """What v of the given size needs of e_j so that their cosine phi becomes t."""
    one, one_low = add(1.0, 0.0, -phi, -phi_low)
    other, other_low = add(1.0, 0.0, phi, phi_low)
    one, one_low = multiply(one, one_low, other, other_low)
    across, across_low = square_root(one, one_low)
    one, one_low = add(1.0, 0.0, -t, 0.0)
    other, other_low = add(1.0, 0.0, t, 0.0)
    one, one_low = multiply(one, one_low, other, other_low)
    root, root_low = square_root(one, one_low)
    x, x_low = multiply(across, across_low, t, 0.0)
    x, x_low = divide(x, x_low, root, root_low)
    x, x_low = add(x, x_low, -phi, -phi_low)
    return multiply(x, x_low, size, size_low)


@strict_kernel
def _vaccinate(
    cosines: Floats, i: int, partners: Indices, targets: Floats, beta: float, v: Floats
) -> None:
    """One row of `exact_aligned_to_targets`; `targets` [n - 1] are those of the partners."""
    _start(v, i)
    size, size_low = 1.0, 0.0
    for place in range(partners.size):
        j, t = partners[place], targets[place]
        along, along_low = inner(cosines[0, j], cosines[1, j], v[0], v[1])
        phi, phi_low = divide(along, along_low, size, size_low)
        moved, moved_low = add(phi, phi_low, -t, 0.0)
        below = moved < 0.0
        moved, moved_low = multiply(moved, moved_low, beta, 0.0)
        targets[place] = min(max(add(moved, moved_low, t, 0.0)[0], -0.999), 0.999)
        if not below:
            continue
        if add(1.0, 0.0, phi, phi_low)[0] <= OPPOSITE:
            v[:] = 0.0
            return
        x, x_low = _raised(phi, phi_low, t, size, size_low)
        _shift(v, j, x, x_low)
        size, size_low = _remaining(v, cosines)
        if size == 0.0:
            return


@strict_kernel
def exact_aligned_to_targets(
    gramians: Floats,
    rounding_residuals: Floats,
    present: Flags,
    order: Indices,
    targets: Floats,
    beta: float,
) -> Floats:
    """[B, K, K] rows of `projection.aligned_to_targets`; `targets` are updated in place."""
    blocks, views, _ = gramians.shape
    result = np.zeros((blocks, views, views))
    for b in range(blocks):
        places = np.flatnonzero(present[b])
        n = places.size
        norms, cosines = exact_cosines(gramians[b], rounding_residuals[b], places)
        partners = _partners(order, places)
        v, own = np.empty((2, n)), np.empty(max(n - 1, 0))
        for i in range(n):
            for place in range(n - 1):
                own[place] = targets[b, places[i], places[partners[i, place]]]
            _vaccinate(cosines, i, partners[i], own, beta, v)
            for place in range(n - 1):
                targets[b, places[i], places[partners[i, place]]] = own[place]
            _as_row(v, norms, places, i, result[b, places[i]])
    return result
