"""Sharing a Gaussian among copies, against the published alternating sums in many digits."""

import mpmath as mp
import numpy as np
import pytest
import torch

from crossgrad_plugins.densifiers.mcmc import Pool, shared_opacity, shared_scale

OPACITIES = (1e-300, 1e-12, 1e-4, 0.005, 0.1, 0.5, 0.9, 0.999, 1 - 1e-9, 1 - 2**-53, 1.0)
COPIES = (1, 2, 3, 7, 20, 51)
ROUNDING = 2.0**-52


def published(opacity, copies):
    """Shared opacity and factor of the scales as the paper writes them."""
    with mp.workdps(400):
        o = mp.mpf(opacity)
        each = 1 - (1 - o) ** (mp.mpf(1) / copies)
        covered = mp.fsum(
            mp.binomial(i - 1, q) * (-1) ** q * each ** (q + 1) / mp.sqrt(q + 1)
            for i in range(1, copies + 1)
            for q in range(i)
        )
        return float(each), float(o / covered)


def numbers(*values):
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("copies", COPIES)
def test_shared_opacities_and_scales_agree_with_the_published_sums(copies):
    # In float64 these sums lose all digits from about 40 opaque copies on.
    expected = np.array([published(o, copies) for o in OPACITIES])
    opacity, n = numbers(*OPACITIES), torch.full((len(OPACITIES),), copies)
    assert shared_opacity(opacity, n).numpy() == pytest.approx(expected[:, 0], rel=8 * ROUNDING)
    assert shared_scale(opacity, n).numpy() == pytest.approx(expected[:, 1], rel=8 * ROUNDING)


@pytest.mark.parametrize("opacity", [0.0, 5e-324, 1e-310])
def test_vanishing_opacities_keep_their_scales(opacity):
    n = torch.tensor(COPIES)
    opacities = torch.full((len(COPIES),), opacity, dtype=torch.float64)
    assert shared_scale(opacities, n).tolist() == [1.0] * len(COPIES)
    assert (shared_opacity(opacities, n) < 1e-300).all()


@pytest.mark.parametrize("copies", [2, 5, 51])
@pytest.mark.parametrize("opacity", [0.05, 0.6, 0.99])
def test_relocated_copies_together_have_the_opacity_of_the_original(opacity, copies):
    # The scales are chosen so that the opacity along a line through the centre keeps its integral.
    n = torch.tensor([copies])
    each, scale = (f(numbers(opacity), n).item() for f in (shared_opacity, shared_scale))
    x = np.linspace(-40, 40, 400_001)
    together = 1 - (1 - each * np.exp(-((x / scale) ** 2) / 2)) ** copies
    alone = opacity * np.exp(-(x**2) / 2)
    assert together.sum() == pytest.approx(alone.sum(), rel=1e-9)


def test_rows_that_occur_once_are_unchanged_and_shares_depend_on_the_number_of_copies():
    pool = Pool.of(numbers(0.9, 0.5, 0.3)).copied(torch.tensor([0, 1, 0, 0]), 0.005)
    assert pool.source.tolist() == [0, 1, 0, 0]
    assert pool.touched.tolist() == [True, False, True, True]
    each, scale = published(0.9, 3)
    assert pool.opacity.tolist() == pytest.approx([each, 0.5, each, each])
    assert pool.scale.tolist() == pytest.approx([scale, 1.0, scale, scale])


def test_copies_of_copies_share_the_opacity_twice():
    once = Pool.of(numbers(0.9, 0.5)).copied(torch.tensor([0, 0]), 0.005)
    twice = once.copied(torch.tensor([0, 1, 1]), 0.005)
    first, first_scale = published(0.9, 2)
    second, second_scale = published(first, 2)
    assert twice.source.tolist() == [0, 0, 0]
    assert twice.opacity.tolist() == pytest.approx([first, second, second])
    factor = first_scale * second_scale
    assert twice.scale.tolist() == pytest.approx([first_scale, factor, factor])


def test_opacity_shares_are_clipped_and_more_than_51_copies_count_as_51():
    index = torch.cat([torch.zeros(200, dtype=torch.int64), torch.tensor([1, 1, 2, 2])])
    pool = Pool.of(numbers(0.9, 0.001, 1.0)).copied(index, 0.005)
    assert pool.opacity[0].item() == pytest.approx(published(0.9, 51)[0])
    assert pool.opacity[-3].item() == 0.005
    assert pool.opacity[-1].item() == 1 - 2.0**-23
    assert torch.logit(pool.opacity.float()).isfinite().all()
    # Scales follow the shared opacity before it is clipped.
    assert pool.scale[-3].item() == pytest.approx(published(0.001, 2)[1])
