"""Kernels for operators that use statistics of earlier steps."""

import numpy as np

from crossgrad_core.numerics.jit import strict_device, strict_kernel
from crossgrad_operators.numba_kernels.directions import directions
from crossgrad_operators.numba_kernels.normal import (
    CANCELLED,
    UNRELATED,
    Flags,
    Floats,
    Indices,
)

#: A gradient norm has reached its target if the difference is at most this share of the mean norm.
MET = 1e-9


@strict_kernel
def confident(
    moments: Floats, gramians: Floats, present: Flags, beta: float, score: float, warmup: int
) -> Flags:
    """Return True for pairs [B, K, K] that have probably conflicted for some time.

    Update `moments`.

    Args:
        moments: [B, 3, K, K] exponential averages of the cosine and of its square, without bias
            correction, and number of updates. Changed in place. Pairs whose dot product is zero are
            not updated.
        gramians: [B, K, K] Gramians.
        present: [B, K] True for views that have a gradient.
        beta: Decay rate of the averages.
        score: A pair conflicts if -mean / sqrt(variance / n_eff + 1e-12) is at least this value.
        warmup: Number of updates after which a pair may be projected.
    """
    blocks, views, _ = gramians.shape
    gates = np.zeros((blocks, views, views), np.bool_)
    norms, cosines = np.zeros((views, 2)), np.zeros((views, views, 2))
    nothing = np.zeros((views, views))
    effective = (1.0 + beta) / (1.0 - beta)
    for b in range(blocks):
        directions(gramians[b], nothing, present[b], norms, cosines, None)
        for i in range(views):
            for j in range(views):
                c = cosines[i, j, 0]
                if i == j or abs(c) <= UNRELATED:
                    continue
                moments[b, 0, i, j] = beta * moments[b, 0, i, j] + (1.0 - beta) * c
                moments[b, 1, i, j] = beta * moments[b, 1, i, j] + (1.0 - beta) * c * c
                moments[b, 2, i, j] += 1.0
                missing = 1.0 - beta ** moments[b, 2, i, j]
                mean = moments[b, 0, i, j] / missing
                variance = max(moments[b, 1, i, j] / missing - mean * mean, 0.0)
                believed = -mean / np.sqrt(variance / effective + 1e-12) >= score
                gates[b, i, j] = believed and moments[b, 2, i, j] > warmup
    return gates


@strict_device
def _scale(logs: Floats, active: Flags) -> None:
    """Shift log weights such that the active weights add up to the number of active groups."""
    largest = -np.inf
    count = 0
    for s in range(logs.size):
        logs[s] = min(max(logs[s], -230.0), 230.0)
        if active[s]:
            largest = max(largest, logs[s])
            count += 1
    if count == 0:
        return
    total = 0.0
    for s in range(logs.size):
        if active[s]:
            total += np.exp(logs[s] - largest)
    logs -= largest + np.log(total / count)


@strict_device
def _group_lengths(gramian: Floats, group: Indices, lengths: Floats) -> None:
    """Write the length of each group's summed gradient to `lengths` [S].

    A length that is only rounding noise becomes 0.
    """
    views = group.size
    longest = np.zeros(lengths.size)
    lengths[:] = 0.0
    for i in range(views):
        longest[group[i]] = max(longest[group[i]], gramian[i, i])
        for j in range(views):
            if group[i] == group[j]:
                lengths[group[i]] += gramian[i, j]
    for s in range(lengths.size):
        lengths[s] = np.sqrt(lengths[s]) if lengths[s] > CANCELLED * longest[s] else 0.0


@strict_kernel
def follow_losses(
    logs: Floats, gramians: Floats, group: Indices, rates: Floats, alpha: float, lr: float
) -> Floats:
    """Return the GradNorm weights [B, K] of this step, and update `logs` for the next step.

    Args:
        logs: [B, S] logarithms of the weights, changed in place.
        gramians: [B, K, K] Gramians.
        group: [K] number of the group of each view, below S.
        rates: [S] relative loss of each group.
        alpha: Exponent of the relative losses.
        lr: Amount by which a logarithm changes in each step.
    """
    blocks, views, _ = gramians.shape
    groups = rates.size
    weights = np.zeros((blocks, views))
    lengths = np.empty(groups)
    active = np.empty(groups, np.bool_)
    for b in range(blocks):
        _group_lengths(gramians[b], group, lengths)
        count = 0
        rate = 0.0
        for s in range(groups):
            active[s] = lengths[s] > 0.0
            if active[s]:
                count += 1
                rate += rates[s]
        if count == 0:
            continue
        _scale(logs[b], active)
        for k in range(views):
            weights[b, k] = np.exp(logs[b, group[k]])
        if count == 1:
            continue
        mean = 0.0
        for s in range(groups):
            if active[s]:
                lengths[s] *= np.exp(logs[b, s])
                mean += lengths[s] / count
        for s in range(groups):
            if active[s]:
                target = mean * (rates[s] * count / rate) ** alpha if rate > 0.0 else mean
                if abs(lengths[s] - target) > MET * mean:
                    logs[b, s] -= lr * np.sign(lengths[s] - target)
        _scale(logs[b], active)
    return weights
