"""The harness finds what is there and nothing else: arms of known difference, many times over.

The noise is that of a pair's difference, except where it is said to be that of a run: then the
difference of a pair has the square root of 2 times as much.
"""

import numpy as np
import pytest

from crossgrad_plugins.compare.statistics import Verdict, estimate, verdicts

TRIALS = 200
NOISE, MARGIN = 0.1, 0.1
NORMAL = "normal"
HEAVY = "Student's t with 3 degrees of freedom"
SKEWED = "exponential"


def draws(law, rng, size):
    """Draws with a mean of 0 and a standard deviation of 1."""
    return {
        NORMAL: lambda: rng.standard_normal(size),
        HEAVY: lambda: rng.standard_t(3, size) / np.sqrt(3.0),
        SKEWED: lambda: rng.exponential(size=size) - 1.0,
    }[law]()


def share(verdict, shift, *, scenes=1, pairs=12, law=NORMAL, noise=NOISE):
    """Share of trials with this verdict on a method that is better by `shift`."""
    rng = np.random.default_rng(1)
    names = [f"scene {number}" for number in range(scenes) for _ in range(pairs // scenes)]
    found = 0
    for _ in range(TRIALS):
        differences = shift + noise * draws(law, rng, pairs)
        found += verdicts([estimate(differences, names, MARGIN)]) == [verdict]
    return found / TRIALS


def self_comparisons(*, noise=NOISE, diverged=0.0, **shape):
    """Number of 200 comparisons of a method with itself that are said to be different.

    `diverged` is how much one of its runs is worse than the others.
    """
    rng = np.random.default_rng(2)
    scenes, pairs, law = shape.get("scenes", 1), shape["pairs"], shape.get("law", NORMAL)
    names = [f"scene {number}" for number in range(scenes) for _ in range(pairs // scenes)]
    # Scenes differ in how much a method is worth there; over all of them it is worth nothing.
    effects = np.repeat(shape.get("effects", [0.0] * scenes), pairs // scenes)
    found = 0
    for _ in range(TRIALS):
        first, second = noise * draws(law, rng, (2, pairs))
        first[0] -= diverged
        found += verdicts([estimate(effects + first - second, names, MARGIN)]) == [
            Verdict.DIFFERENT
        ]
    return found


LAWS = (NORMAL, HEAVY, SKEWED)
SHAPES = ((1, 3), (4, 8), (5, 10), (1, 12), (4, 12))
#: Each shape has one law here, and all laws in `make slow`.
SELVES = [
    pytest.param(*shape, law, marks=() if (place + turn) % 3 == 0 else pytest.mark.slow)
    for place, shape in enumerate(SHAPES)
    for turn, law in enumerate(LAWS)
]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("scenes", "pairs", "law"), SELVES)
def test_a_method_is_seldom_reported_different_from_itself(scenes, pairs, law):
    assert self_comparisons(scenes=scenes, pairs=pairs, law=law) <= 16


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pairs", "effects"), [(10, (0.1, -0.1, 0.2, -0.2, 0.0)), (12, (0.1, -0.1, 0.2, -0.2))]
)
def test_a_method_is_seldom_reported_different_from_itself_on_different_scenes(pairs, effects):
    assert self_comparisons(scenes=len(effects), pairs=pairs, effects=effects) <= 16


@pytest.mark.sampled(1)
@pytest.mark.parametrize("scenes", [1, 4])
def test_one_diverged_run_does_not_make_two_equal_methods_different(scenes):
    assert self_comparisons(scenes=scenes, pairs=12, noise=0.03, diverged=15.0) <= 16


@pytest.mark.sampled(1)
@pytest.mark.parametrize("law", [NORMAL, HEAVY])
@pytest.mark.parametrize("scenes", [1, 4])
def test_a_real_difference_is_found(scenes, law):
    noise = NOISE * np.sqrt(2.0)  # 0.1 dB of each run, which is harder than 0.1 dB of a pair.
    assert share(Verdict.DIFFERENT, 0.3, scenes=scenes, law=law, noise=noise) >= 0.8


@pytest.mark.sampled(1)
@pytest.mark.parametrize("law", [NORMAL, HEAVY])
@pytest.mark.parametrize("scenes", [1, 4])
def test_equal_methods_are_called_equivalent(scenes, law):
    assert share(Verdict.EQUIVALENT, 0.0, scenes=scenes, law=law) >= 0.5


@pytest.mark.slow
def test_a_difference_as_large_as_the_margin_is_seldom_called_equivalent():
    assert share(Verdict.EQUIVALENT, MARGIN, scenes=4) <= 0.1


def test_three_seeds_of_one_scene_cannot_show_equivalence():
    assert share(Verdict.EQUIVALENT, 0.0, pairs=3, noise=NOISE * np.sqrt(2.0)) <= 0.05
