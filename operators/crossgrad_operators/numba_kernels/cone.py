"""Kernels for the projection onto the cone of conflict-free directions (UPGrad, DualProj)."""

import numpy as np

from crossgrad_core.numerics.jit import strict_device, strict_kernel, strict_section
from crossgrad_operators.numba_kernels.digits import (
    Exact,
    Pair,
    Pairs,
    at,
    clear,
    longest_of,
    plus,
    product,
    put,
    quotient,
)
from crossgrad_operators.numba_kernels.directions import (
    Flags,
    Floats,
    Solved,
    directions,
    what_is_left,
)
from crossgrad_operators.numba_kernels.polyhedron import (
    Polyhedron,
    polyhedron,
    project,
)


@strict_device
def _pair(cosine: float, base: Pairs, z: Pairs) -> None:
    """Write the coefficients [2] of the projection of `base` [2] to z.

    At most one coefficient becomes larger than in `base`.
    """
    one, other = base[0, 0], base[1, 0]
    first, second = one + cosine * other, cosine * one + other
    z[0, 0], z[1, 0] = one, other
    if second < 0.0 and second <= first:
        z[1, 0] -= second
    elif first < 0.0:
        z[0, 0] -= first


@strict_section
def _projected(problem: Polyhedron, z: Pairs) -> None:
    """Write the coefficients of the projection to z, or zeros if only rounding noise remains."""
    exact = problem.rounding.exact
    if len(z) == 2 and exact is None:
        _pair(problem.cosines[0, 1, 0], problem.base, z)
    else:
        project(problem)
        for k in range(len(z)):
            put(z, k, plus(at(problem.base, k), at(problem.y, k), exact))
    share = what_is_left(problem, z)
    for k in range(len(z)):
        put(z, k, (share * z[k, 0], share * z[k, 1]))


@strict_device
def _weight(z: Pair, norm: Pair, other: Pair, exact: Exact) -> float:
    """Return the weight of a gradient, from the coefficient z of its unit vector.

    The unit of z is `norm`.
    """
    return product(z, quotient(norm, other, exact), exact)[0]


@strict_kernel
def upgrad(gramians: Floats, rounding_residuals: Floats, present: Flags, exact: Exact) -> Solved:
    """Return rows [B, K, K]: each gradient / K, projected onto the conflict-free cone."""
    blocks, views, _ = gramians.shape
    result, ill_conditioned = np.zeros((blocks, views, views)), np.zeros(blocks, np.bool_)
    problem = polyhedron(views, exact)
    norms, z = np.zeros((views, 2)), np.zeros((views, 2))
    for b in range(blocks):
        directions(gramians[b], rounding_residuals[b], present[b], norms, problem.cosines, exact)
        problem.ill_conditioned[0] = False
        for k in range(views):
            if present[b, k]:
                clear(problem.base)
                problem.base[k, 0] = 1.0
                _projected(problem, z)
                for j in range(views):
                    if present[b, j]:
                        weight = _weight(at(z, j), at(norms, k), at(norms, j), exact)
                        result[b, k, j] = weight / views
        ill_conditioned[b] = problem.ill_conditioned[0]
    return result, ill_conditioned


@strict_kernel
def dualproj(gramians: Floats, rounding_residuals: Floats, present: Flags, exact: Exact) -> Solved:
    """Return weights [B, K] of the mean gradient, projected onto the conflict-free cone."""
    blocks, views, _ = gramians.shape
    result, ill_conditioned = np.zeros((blocks, views)), np.zeros(blocks, np.bool_)
    problem = polyhedron(views, exact)
    norms, z = np.zeros((views, 2)), np.zeros((views, 2))
    for b in range(blocks):
        count = directions(
            gramians[b], rounding_residuals[b], present[b], norms, problem.cosines, exact
        )
        if count == 0:
            continue
        longest, _ = longest_of(norms)
        for k in range(views):
            put(problem.base, k, quotient(at(norms, k), longest, exact))
        problem.ill_conditioned[0] = False
        _projected(problem, z)
        for k in range(views):
            if present[b, k]:
                result[b, k] = _weight(at(z, k), longest, at(norms, k), exact) / views
        ill_conditioned[b] = problem.ill_conditioned[0]
    return result, ill_conditioned
