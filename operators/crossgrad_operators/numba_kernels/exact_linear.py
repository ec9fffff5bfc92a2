"""Cosines and eigenvalues with twice the digits of float64, for Gramians with known remainders.

A matrix of such numbers is two arrays of float64, high and low (see `double_double`).
"""

import numpy as np

from crossgrad_core.numerics.double_double import (
    add,
    divide,
    multiply,
    square_root,
)
from crossgrad_core.numerics.jit import strict_device, strict_kernel, strict_part
from crossgrad_operators.numba_kernels.normal import Floats, Indices

#: Off-diagonal elements up to this share of the diagonal ones count as zero.
NEGLIGIBLE = 1e-31
#: So does this share of the largest element, whose inverse can still be squared.
VANISHING = 1e-140
#: Sweeps of Jacobi's method; eight are enough for twenty rows.
SWEEPS = 40


@strict_kernel
def exact_cosines(gramian: Floats, remainder: Floats, places: Indices) -> tuple[Floats, Floats]:
    """Norms [2, n] and cosines [2, n, n], high and low, of the views at `places` [n]."""
    n = places.size
    norms, cosines = np.empty((2, n)), np.empty((2, n, n))
    for i in range(n):
        p = places[i]
        norms[0, i], norms[1, i] = square_root(gramian[p, p], remainder[p, p])
        cosines[0, i, i], cosines[1, i, i] = 1.0, 0.0
        for j in range(i):
            q = places[j]
            high, low = divide(gramian[p, q], remainder[p, q], norms[0, i], norms[1, i])
            high, low = divide(high, low, norms[0, j], norms[1, j])
            cosines[0, i, j], cosines[1, i, j] = high, low
            cosines[0, j, i], cosines[1, j, i] = high, low
    return norms, cosines


@strict_device
def inner(a: Floats, a_low: Floats, b: Floats, b_low: Floats) -> tuple[float, float]:
    """The dot product of two vectors."""
    high, low = 0.0, 0.0
    for k in range(a.size):
        x, x_low = multiply(a[k], a_low[k], b[k], b_low[k])
        high, low = add(high, low, x, x_low)
    return high, low


@strict_device
def exact_form(cosines: Floats, v: Floats) -> tuple[float, float]:
    """v^T C v for cosines [2, n, n] and v [2, n]."""
    high, low = 0.0, 0.0
    for i in range(v.shape[1]):
        if v[0, i] != 0.0:
            x, x_low = inner(cosines[0, i], cosines[1, i], v[0], v[1])
            x, x_low = multiply(x, x_low, v[0, i], v[1, i])
            high, low = add(high, low, x, x_low)
    return high, low


@strict_device
def _turn(
    a: float, a_low: float, b: float, b_low: float, rotation: Floats
) -> tuple[float, float, float, float]:
    """The pair (a, b) turned: c a - s b and s a + c b."""
    c, c_low, s, s_low = rotation[0, 0], rotation[1, 0], rotation[0, 1], rotation[1, 1]
    x, x_low = multiply(c, c_low, a, a_low)
    y, y_low = multiply(s, s_low, b, b_low)
    one, one_low = add(x, x_low, -y, -y_low)
    x, x_low = multiply(s, s_low, a, a_low)
    y, y_low = multiply(c, c_low, b, b_low)
    other, other_low = add(x, x_low, y, y_low)
    return one, one_low, other, other_low


@strict_part
def _rotation(matrix: Floats, p: int, q: int, rotation: Floats) -> None:
    """Cosine and sine [2, 2] of the rotation that clears the element (p, q), and both diagonals."""
    x, x_low = matrix[0, p, q], matrix[1, p, q]
    gap, gap_low = add(matrix[0, q, q], matrix[1, q, q], -matrix[0, p, p], -matrix[1, p, p])
    theta, theta_low = divide(gap, gap_low, 2.0 * x, 2.0 * x_low)
    if abs(theta) > 1e17:
        t, t_low = divide(0.5, 0.0, theta, theta_low)
    else:
        sign = 1.0 if theta >= 0.0 else -1.0
        square, square_low = multiply(theta, theta_low, theta, theta_low)
        square, square_low = add(square, square_low, 1.0, 0.0)
        root, root_low = square_root(square, square_low)
        root, root_low = add(sign * theta, sign * theta_low, root, root_low)
        t, t_low = divide(sign, 0.0, root, root_low)
    square, square_low = multiply(t, t_low, t, t_low)
    square, square_low = add(square, square_low, 1.0, 0.0)
    root, root_low = square_root(square, square_low)
    c, c_low = divide(1.0, 0.0, root, root_low)
    rotation[0, 0], rotation[1, 0] = c, c_low
    rotation[0, 1], rotation[1, 1] = multiply(t, t_low, c, c_low)
    moved, moved_low = multiply(t, t_low, x, x_low)
    d = add(matrix[0, p, p], matrix[1, p, p], -moved, -moved_low)
    matrix[0, p, p], matrix[1, p, p] = d
    d = add(matrix[0, q, q], matrix[1, q, q], moved, moved_low)
    matrix[0, q, q], matrix[1, q, q] = d
    matrix[:, p, q] = 0.0
    matrix[:, q, p] = 0.0


@strict_part
def _rotate(matrix: Floats, vectors: Floats, p: int, q: int, rotation: Floats) -> None:
    """One Jacobi rotation of the rest of a matrix and of its eigenvectors."""
    for k in range(matrix.shape[1]):
        if k not in (p, q):
            a, a_low, b, b_low = _turn(
                matrix[0, k, p], matrix[1, k, p], matrix[0, k, q], matrix[1, k, q], rotation
            )
            matrix[0, k, p], matrix[1, k, p] = a, a_low
            matrix[0, p, k], matrix[1, p, k] = a, a_low
            matrix[0, k, q], matrix[1, k, q] = b, b_low
            matrix[0, q, k], matrix[1, q, k] = b, b_low
        a, a_low, b, b_low = _turn(
            vectors[0, k, p], vectors[1, k, p], vectors[0, k, q], vectors[1, k, q], rotation
        )
        vectors[0, k, p], vectors[1, k, p] = a, a_low
        vectors[0, k, q], vectors[1, k, q] = b, b_low


@strict_kernel
def exact_eigen(matrix: Floats, vectors: Floats) -> None:
    """Eigenvalues of a positive semi-definite matrix [2, n, n], left on its diagonal.

    Jacobi's method as in `linear.eigen`.

    Args:
        matrix: [2, n, n], overwritten.
        vectors: [2, n, n] the eigenvectors as columns.
    """
    n = matrix.shape[1]
    vectors[:] = 0.0
    for i in range(n):
        vectors[0, i, i] = 1.0
    rotation = np.empty((2, 2))
    least = VANISHING * np.abs(np.diag(matrix[0])).max()
    for _ in range(SWEEPS):
        rotated = False
        for p in range(n - 1):
            for q in range(p + 1, n):
                # Rounding may leave a zero of the diagonal on either side.
                scale = np.sqrt(abs(matrix[0, p, p])) * np.sqrt(abs(matrix[0, q, q]))
                if abs(matrix[0, p, q]) > max(NEGLIGIBLE * scale, least):
                    rotated = True
                    _rotation(matrix, p, q, rotation)
                    _rotate(matrix, vectors, p, q, rotation)
        if not rotated:
            return


@strict_kernel
def graded(cosines: Floats, norms: Floats, out: Floats) -> None:
    """D C D [2, n, n] with D the norms [2, n] over the longest one."""
    n = norms.shape[1]
    longest = np.argmax(norms[0])
    shares = np.empty((2, n))
    for i in range(n):
        share = divide(norms[0, i], norms[1, i], norms[0, longest], norms[1, longest])
        shares[0, i], shares[1, i] = share
    for i in range(n):
        for j in range(i + 1):
            x, x_low = multiply(shares[0, i], shares[1, i], shares[0, j], shares[1, j])
            x, x_low = multiply(x, x_low, cosines[0, i, j], cosines[1, i, j])
            out[0, i, j], out[1, i, j] = x, x_low
            out[0, j, i], out[1, j, i] = x, x_low


@strict_kernel
def lost_between(
    matrices: Floats, gramians: Floats, rounding_residuals: Floats, rounded: Floats
) -> Floats:
    """[B, R, R] what rounding took from M Gram M^T: its exact value minus `rounded`.

    Args:
        matrices: [B, R, K] M.
        gramians: [B, K, K].
        rounding_residuals: [B, K, K] what rounding took from them.
        rounded: [B, R, R].
    """
    blocks, rows, views = matrices.shape
    result, zeros = np.empty(rounded.shape), np.zeros(views)
    half = np.empty((2, views))
    for b in range(blocks):
        for i in range(rows):
            for k in range(views):
                x, x_low = inner(gramians[b, k], rounding_residuals[b, k], matrices[b, i], zeros)
                half[0, k], half[1, k] = x, x_low
            for j in range(rows):
                x, x_low = inner(half[0], half[1], matrices[b, j], zeros)
                result[b, i, j] = add(x, x_low, -rounded[b, i, j], 0.0)[0]
    return result
