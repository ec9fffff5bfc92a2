"""Kernels that prepare the inputs of the networks and convert their outputs to Gaussians.

All arrays are in C order. A is the number of visible anchors, and P is the number of all anchors.
Each anchor has k slots. G is the number of Gaussians with positive opacity. A kernel processes a
stretch of n anchors from number `first` on. Raw outputs exist only for this stretch. The anchors
are divided into jobs of a fixed number of anchors. Every job writes its own rows. The bits do not
depend on the number of threads, because every job writes its own rows.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_backbones.anchors.heads import COVARIANCE
from crossgrad_core.numerics.jit import kernel
from crossgrad_core.numerics.jobs import Jobs, next_job

_Floats: TypeAlias = NDArray[np.float32]
_Ints: TypeAlias = NDArray[np.int64]
#: Number of anchors in one job of the work queue.
SHARE = 256


@kernel
def join(jobs: Jobs, features: _Floats, rows: _Ints, views: _Floats, out: _Floats) -> None:
    """Write the inputs of the networks [A, F + V].

    The inputs of an anchor are its row of the features [Q, F], followed by its row of the views [A,
    V].
    """
    anchors, feature, view = len(rows), features.shape[1], views.shape[1]
    chunks = (anchors + SHARE - 1) // SHARE
    chunk = next_job(jobs, chunks)
    while chunk < chunks:
        for a in range(chunk * SHARE, min(anchors, (chunk + 1) * SHARE)):
            row = rows[a]
            for c in range(feature):
                out[a, c] = features[row, c]
            for c in range(view):
                out[a, feature + c] = views[a, c]
        chunk = next_job(jobs, chunks)


_ZERO, _ONE = np.float32(0), np.float32(1)


@kernel
def rectify_back(
    jobs: Jobs, first: int, anchors: int, column: int, hidden: _Floats, gradient: _Floats
) -> None:
    """Set the gradient to 0, in place, where the hidden value is 0.

    Args:
        jobs: Job counters, passed by `parallel` or `serial`.
        first: Number of the first anchor.
        anchors: Number of anchors n.
        column: Column of `hidden` that belongs to the first column of the gradient.
        hidden: [A, 3 H] hidden values after the ReLU.
        gradient: [n or more, H or 3 H] gradients, changed in place.
    """
    width = gradient.shape[1]
    chunks = (anchors + SHARE - 1) // SHARE
    chunk = next_job(jobs, chunks)
    while chunk < chunks:
        for n in range(chunk * SHARE, min(anchors, (chunk + 1) * SHARE)):
            mine = gradient[n]
            theirs = hidden[first + n, column : column + width]
            for c in range(width):
                mine[c] = mine[c] if theirs[c] > _ZERO else _ZERO
        chunk = next_job(jobs, chunks)


@kernel
def count(opacities: _Floats, starts: _Ints) -> None:
    """Write `starts` [A + 1], the index of the first Gaussian of each anchor.

    The array of opacities has the shape [A, k].
    """
    anchors, slots = opacities.shape
    total = 0
    for a in range(anchors):
        starts[a] = total
        for j in range(slots):
            total += opacities[a, j] > _ZERO
    starts[anchors] = total


@kernel
def gather(
    jobs: Jobs,
    first: int,
    covariances: _Floats,
    colors: _Floats,
    opacities: _Floats,
    positions: _Floats,
    offsets: _Floats,
    spreads: _Floats,
    rows: _Ints,
    starts: _Ints,
    origin: _Ints,
    slot: _Ints,
    out_means: _Floats,
    out_quats: _Floats,
    out_shares: _Floats,
    out_sizes: _Floats,
    out_opacities: _Floats,
    out_colors: _Floats,
) -> None:
    """Write the values of all Gaussians with positive opacity.

    Args:
        jobs: Job counters, passed by `parallel` or `serial`.
        first: Number of the first anchor.
        covariances: [n, 7 k] raw outputs.
        colors: [n, 3 k] raw outputs.
        opacities: [A, k] opacities for rendering.
        positions: [P, 3] positions of all anchors.
        offsets: [P, k, 3] offsets of all anchors.
        spreads: [A, 6] factors of the offsets, then sizes of the Gaussians.
        rows: [A] row of each visible anchor.
        starts: [A + 1] index of the first Gaussian of each anchor, from `count`.
        origin: [G] output, row of the anchor.
        slot: [G] output, slot of the anchor.
        out_means: [G, 3] output.
        out_quats: [G, 4] output, raw.
        out_shares: [G, 3] output, raw scales.
        out_sizes: [G, 3] output, size of the anchor.
        out_opacities: [G] output.
        out_colors: [G, 3] output, raw.
    """
    anchors, slots = len(covariances), opacities.shape[1]
    chunks = (anchors + SHARE - 1) // SHARE
    chunk = next_job(jobs, chunks)
    while chunk < chunks:
        for n in range(chunk * SHARE, min(anchors, (chunk + 1) * SHARE)):
            a = first + n
            g, p = starts[a], rows[a]
            for j in range(slots):
                if opacities[a, j] > _ZERO:
                    origin[g], slot[g] = p, j
                    out_opacities[g] = opacities[a, j]
                    for c in range(3):
                        out_means[g, c] = positions[p, c] + offsets[p, j, c] * spreads[a, c]
                        out_shares[g, c] = covariances[n, COVARIANCE * j + c]
                        out_sizes[g, c] = spreads[a, 3 + c]
                        out_colors[g, c] = colors[n, 3 * j + c]
                    for c in range(4):
                        out_quats[g, c] = covariances[n, COVARIANCE * j + 3 + c]
                    g += 1
        chunk = next_job(jobs, chunks)


@kernel
def scatter(
    jobs: Jobs,
    first: int,
    anchors: int,
    rows: _Ints,
    starts: _Ints,
    slot: _Ints,
    spreads: _Floats,
    shares: _Floats,
    v_scales: _Floats,
    out_log_scales: _Floats,
    raw: _Floats,
    tanhs: _Floats,
    factors: _Floats,
    offsets: _Floats,
    colors: _Floats,
    v_means: _Floats,
    v_quats: _Floats,
    v_opacities: _Floats,
    v_colors: _Floats,
    out_offsets: _Floats,
) -> None:
    """Compute the gradients with respect to all inputs, given the gradients of all outputs.

    Args:
        jobs: Job counters, passed by `parallel` or `serial`.
        first: Number of the first anchor.
        anchors: Number of anchors n.
        rows: [A] row of each visible anchor.
        starts: [A + 1] index of the first Gaussian of each anchor.
        slot: [G] slot of each Gaussian.
        spreads: [A, 6] exponentials of the log scales.
        shares: [G, 3] scales divided by the size of the anchor.
        v_scales: [G, 3] gradient with respect to the scales.
        out_log_scales: [P, 6] output, zero before the call, written at `rows`.
        raw: [n or more, 11 k] output: gradients with respect to raw opacities, covariances and
            colours.
        tanhs: [A, k] opacities before multiplication by the factor.
        factors: [A] factors of the opacities.
        offsets: [P, k, 3] offsets of all anchors.
        colors: [G, 3] colours for rendering.
        v_means: [G, 3] gradient with respect to the means.
        v_quats: [G, 4] gradient with respect to the quaternions.
        v_opacities: [G] gradient with respect to the opacities.
        v_colors: [G, 3] gradient with respect to the colours.
        out_offsets: [P, k, 3] output, zero before the call, written at the rendered slots of
            `rows`.
    """
    slots = tanhs.shape[1]
    to_colors = (1 + COVARIANCE) * slots
    chunks = (anchors + SHARE - 1) // SHARE
    chunk = next_job(jobs, chunks)
    while chunk < chunks:
        for n in range(chunk * SHARE, min(anchors, (chunk + 1) * SHARE)):
            a = first + n
            p = rows[a]
            raw[n] = _ZERO
            for g in range(starts[a], starts[a + 1]):
                j = slot[g]
                cov, rgb = slots + COVARIANCE * j, to_colors + 3 * j
                tanh = tanhs[a, j]
                raw[n, j] = v_opacities[g] * factors[a] * (_ONE - tanh * tanh)
                for c in range(3):
                    moved = v_means[g, c] * spreads[a, c]
                    out_offsets[p, j, c] = moved
                    out_log_scales[p, c] += moved * offsets[p, j, c]
                    share, color = shares[g, c], colors[g, c]
                    by_log = v_scales[g, c] * share * spreads[a, 3 + c]
                    out_log_scales[p, 3 + c] += by_log
                    raw[n, cov + c] = by_log * (_ONE - share)
                    raw[n, rgb + c] = v_colors[g, c] * color * (_ONE - color)
                for c in range(4):
                    raw[n, cov + 3 + c] = v_quats[g, c]
        chunk = next_job(jobs, chunks)


@kernel
def scatter_scales(
    jobs: Jobs,
    first: int,
    anchors: int,
    rows: _Ints,
    starts: _Ints,
    slot: _Ints,
    spreads: _Floats,
    shares: _Floats,
    v_scales: _Floats,
    out_log_scales: _Floats,
    raw: _Floats,
) -> None:
    """Like `scatter`, but only the scales have a gradient.

    `raw` [n, 7 k] is the gradient with respect to raw covariances.
    """
    chunks = (anchors + SHARE - 1) // SHARE
    chunk = next_job(jobs, chunks)
    while chunk < chunks:
        for n in range(chunk * SHARE, min(anchors, (chunk + 1) * SHARE)):
            a = first + n
            p = rows[a]
            raw[n] = _ZERO
            for g in range(starts[a], starts[a + 1]):
                cov = COVARIANCE * slot[g]
                for c in range(3):
                    by_log = v_scales[g, c] * shares[g, c] * spreads[a, 3 + c]
                    out_log_scales[p, 3 + c] += by_log
                    raw[n, cov + c] = by_log * (_ONE - shares[g, c])
        chunk = next_job(jobs, chunks)
