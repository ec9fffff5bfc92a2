"""Resamples of a grouped Gramian: cameras are redrawn, and never paired with their own copies."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.diagnostics.grouped import GroupedGramian, Groups

#: Minimum number of different cameras of a group in a resample. With fewer cameras, a resample has
#: no variance and is drawn again.
_FEWEST_CAMERAS = 3

_Array = NDArray[np.float64]


def multiplicities(size: int, resamples: int, rng: np.random.Generator) -> _Array:
    """Draw how often each camera occurs, [R + 1, size].

    Row 0 is the sample itself.
    """
    share = np.full(size, 1.0 / size)
    drawn = rng.multinomial(size, share, size=resamples)
    fewest = min(_FEWEST_CAMERAS, size)
    while (poor := np.count_nonzero(drawn, axis=1) < fewest).any():
        drawn[poor] = rng.multinomial(size, share, size=int(poor.sum()))
    return np.concatenate([np.ones((1, size)), drawn.astype(np.float64)])


@dataclass(frozen=True, eq=False)
class GroupResamples:
    """The values of one group in each of R + 1 resamples.

    Attributes:
        counts: [R + 1, n] number of times that each camera occurs.
        spread: [R + 1] half the squared distance of two different cameras, mean over pairs.
        self_share: [R + 1] sum of squared counts over n^2; this is 1/n in the sample itself.
        along: [R + 1] mean deviation along (near mean - far mean).
        own: [R + 1] squared length of the mean deviation.
        linear: [R + 1] variance of the mean deviation along the gap.
        quadratic: [R + 1] variance of `spread`.
        mixed: [R + 1] covariance of `spread` with the mean deviation along the gap.
    """

    counts: _Array
    spread: _Array
    self_share: _Array
    along: _Array
    own: _Array
    linear: _Array
    quadratic: _Array
    mixed: _Array

    @classmethod
    def of(cls, deviations: _Array, along: _Array, counts: _Array) -> Self:
        """Resample dot products of deviations [n, n] and their products with the gap [n]."""
        n = len(along)
        squared = np.diag(deviations)
        halves = (squared[:, None] + squared[None, :] - 2.0 * deviations) / 2.0
        to_others = counts @ halves
        self_share = (counts * counts).sum(axis=1) / n**2
        # Mean of the pair values for each camera. Pairs of two copies of a camera are left out.
        conditional = 2.0 * to_others / (n - counts)
        mean_along = counts @ along / n
        about_along = along[None, :] - mean_along[:, None]
        about = conditional - ((counts * conditional).sum(axis=1) / n)[:, None]
        weights = counts / (n * (n - 1.0))
        return cls(
            counts=counts,
            spread=(counts * to_others).sum(axis=1) / (n**2 * (1.0 - self_share)),
            self_share=self_share,
            along=mean_along,
            own=(counts * (counts @ deviations)).sum(axis=1) / n**2,
            linear=(weights * about_along**2).sum(axis=1),
            quadratic=(weights * about**2).sum(axis=1),
            mixed=(weights * about_along * about).sum(axis=1),
        )


@dataclass(frozen=True, eq=False)
class Resamples:
    """All resampled values that the intervals need.

    Row 0 is the sample itself, and values are in units of the scale. Let theta be the true ||near
    mean - far mean||^2. The estimate of theta in a resample is theta + 2 sqrt(theta) `shift` +
    `noise`, minus the mean of the noise.

    Attributes:
        within: [R + 1] estimate of sigma_w^2.
        within_variance: [R + 1] variance of `within`.
        shift: [R + 1] mean deviation along the direction of the gap; each view is left out of the
            gap for its own deviation.
        noise: [R + 1] squared mean deviation, minus the contribution of single cameras.
        shift_variance: [R + 1] variance of `shift`.
        covariance: [R + 1] covariance of `within` with `shift`.
        spread: [R + 1] variance of the difference of the means, summed over all dimensions.
    """

    within: _Array
    within_variance: _Array
    shift: _Array
    noise: _Array
    shift_variance: _Array
    covariance: _Array
    spread: _Array

    def along_gap(self, factor: float) -> "Resamples":
        """Return a copy with the variance of the shift multiplied by a factor."""
        return replace(
            self,
            shift=self.shift * factor**0.5,
            shift_variance=self.shift_variance * factor,
            covariance=self.covariance * factor**0.5,
        )

    @classmethod
    def of(
        cls, parts: GroupedGramian, groups: Groups, resamples: int, rng: np.random.Generator
    ) -> Self:
        """Draw the resamples."""
        n, m = groups.sizes
        near = GroupResamples.of(parts.near, parts.near_along, multiplicities(n, resamples, rng))
        far = GroupResamples.of(parts.far, parts.far_along, multiplicities(m, resamples, rng))
        (f, g), (p, q) = groups.unseen, groups.shares
        p, q = p * groups.divisors[0], q * groups.divisors[1]
        # A group has a finite number of views. The variance of the noise is therefore multiplied by
        # the share of views that were not measured.
        root_f, root_g = f**0.5, g**0.5
        near_spread = near.spread[0] + root_f * (near.spread - near.spread[0])
        far_spread = far.spread[0] + root_g * (far.spread - far.spread[0])
        meeting = (near.counts @ parts.cross * far.counts).sum(axis=1) / (n * m)
        unit = parts.gap**0.5 if parts.gap > 0.0 else 1.0
        own_noise = f * near.spread * near.self_share + g * far.spread * far.self_share
        return cls(
            within=p * near_spread + q * far_spread,
            within_variance=p**2 * f * near.quadratic + q**2 * g * far.quadratic,
            shift=(root_f * near.along - root_g * far.along) / unit,
            noise=f * near.own + g * far.own - 2.0 * root_f * root_g * meeting - own_noise,
            shift_variance=(f * near.linear + g * far.linear) / unit**2,
            covariance=(p * f * near.mixed - q * g * far.mixed) / unit,
            spread=f * near.spread / n + g * far.spread / m,
        )
