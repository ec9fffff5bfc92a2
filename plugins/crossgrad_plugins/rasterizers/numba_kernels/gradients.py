"""Gradients of the single steps of the projection, as numbers."""

from crossgrad_plugins.rasterizers.numba_kernels.analytic import SIGMA_FLOOR
from crossgrad_plugins.rasterizers.numba_kernels.ewa import LEAST_DET, Row, Triple, dot
from crossgrad_plugins.rasterizers.numba_kernels.jit import device


@device
def combined(a: Triple, p: float, b: Triple, q: float) -> Triple:
    """Returns a p + b q."""
    return a[0] * p + b[0] * q, a[1] * p + b[1] * q, a[2] * p + b[2] * q


@device
def covariance_gradient(
    b: float, c: float, det: float, sum_dd: float, sum_dy: float, sum_yy: float
) -> Triple:
    """Returns the gradients of A, B (as one number) and C of the dilated covariance."""
    inverse_c = 1.0 / c
    slope, inverse_variance = b * inverse_c, c / det
    v_variance = 0.5 * inverse_variance * inverse_variance * sum_dd
    v_slope = inverse_variance * inverse_c * sum_dy
    v_decay = 0.5 * inverse_c * inverse_c * sum_yy
    return (
        v_variance,
        v_slope - 2.0 * slope * v_variance,
        v_decay - slope * v_slope + slope * slope * v_variance,
    )


@device
def factor_gradient(
    m: Triple, n: Triple, dilation: float, det: float, factor: float, v_log_factor: float
) -> Triple:
    """Returns what the antialiasing factor adds to the gradients of A, B and C."""
    a, b, c = dot(m, m), dot(m, n), dot(n, n)
    raw_det = det - dilation * (a + c) - dilation * dilation
    # factor^2 = raw_det / (det + e) + e, so d(log factor) = d(factor^2) / (2 factor^2)
    v_square = 0.5 * v_log_factor / (factor * factor)
    v_raw_det = v_square / (det + LEAST_DET)
    v_det = -v_raw_det * raw_det / (det + LEAST_DET)
    return (
        v_raw_det * c + v_det * (c + dilation),
        -2.0 * b * (v_raw_det + v_det),
        v_raw_det * a + v_det * (a + dilation),
    )


@device
def axes_gradient(
    cosine: float,
    sine: float,
    variance_1: float,
    variance_2: float,
    sum_sigma_1: float,
    sum_sigma_2: float,
    v_angle: float,
) -> Triple:
    """Returns the gradients of A, B (as one number) and C of the analytic response.

    The sums are those of gradients by the logarithms of the standard deviations. A floored one has
    no gradient, and the axes of a round Gaussian do not turn.
    """
    floor = SIGMA_FLOOR * SIGMA_FLOOR
    v_1 = 0.5 * sum_sigma_1 / variance_1 if variance_1 > floor else 0.0
    v_2 = 0.5 * sum_sigma_2 / variance_2 if variance_2 > floor else 0.0
    gap = variance_1 - variance_2
    v_turn = v_angle / gap if gap > 0.0 else 0.0
    mixed = cosine * sine
    return (
        cosine * cosine * v_1 + sine * sine * v_2 - mixed * v_turn,
        2.0 * mixed * (v_1 - v_2) + (cosine * cosine - sine * sine) * v_turn,
        sine * sine * v_1 + cosine * cosine * v_2 + mixed * v_turn,
    )


@device
def turn_gradient(q: Row, inverse_norm: float, x: Triple, y: Triple, z: Triple) -> Row:
    """Returns the gradient of a quaternion, given those of its rotation matrix' columns."""
    w, a, b, c = q
    v_w = 2.0 * (a * (y[2] - z[1]) + b * (z[0] - x[2]) + c * (x[1] - y[0]))
    v_a = 2.0 * (w * (y[2] - z[1]) + b * (x[1] + y[0]) + c * (x[2] + z[0])) - 4.0 * a * (
        y[1] + z[2]
    )
    v_b = 2.0 * (w * (z[0] - x[2]) + a * (x[1] + y[0]) + c * (y[2] + z[1])) - 4.0 * b * (
        x[0] + z[2]
    )
    v_c = 2.0 * (w * (x[1] - y[0]) + a * (x[2] + z[0]) + b * (y[2] + z[1])) - 4.0 * c * (
        x[0] + y[1]
    )
    along = w * v_w + a * v_a + b * v_b + c * v_c
    return (
        (v_w - w * along) * inverse_norm,
        (v_a - a * along) * inverse_norm,
        (v_b - b * along) * inverse_norm,
        (v_c - c * along) * inverse_norm,
    )


@device
def weighted_sum(columns: tuple[Triple, Triple, Triple], weights: Triple) -> Triple:
    """Returns the sum of the three columns times their weights."""
    a, b, c = columns
    p, q, r = weights
    return (
        a[0] * p + b[0] * q + c[0] * r,
        a[1] * p + b[1] * q + c[1] * r,
        a[2] * p + b[2] * q + c[2] * r,
    )
