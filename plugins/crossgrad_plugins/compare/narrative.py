"""The results as sentences: the best arm, its difference, the certainty and the cost."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf, isinf, isnan

from crossgrad_core.commands import count
from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.contrasts import Contrast
from crossgrad_plugins.compare.quantity import COSTS
from crossgrad_plugins.compare.statistics import Verdict

_TITLES = {cost.name: cost.title for cost in COSTS}
#: Maximum number of arms that a sentence names.
_MOST_NAMED = 6
_ONE_PAIR = "one pair does not show the noise: run more seeds"
_NONE_BEATEN = "but it is not significantly better than any other arm"


@dataclass(frozen=True)
class Sentence:
    """A statement and its evidence."""

    claim: str
    support: str


def headline(comparison: Comparison) -> tuple[Sentence, ...]:
    """Return the main statements of a comparison."""
    if not comparison.ends:
        return (_alone(comparison),)
    if len(comparison.ends) == 1:
        only = comparison.ends[0]
        sentences = [Sentence(claim(only), support(only))]
    elif comparison.baseline is not None:
        sentences = [Sentence(claim(contrast), support(contrast)) for contrast in comparison.ends]
    else:
        sentences = _of_the_best(comparison)
    return (*sentences, *_lengths(comparison), *_equal_costs(comparison))


def claim(contrast: Contrast) -> str:
    """Return the sentence about two arms."""
    estimate = contrast.estimate
    if estimate is None:
        return f"{contrast.first} and {contrast.second} have no scene with the same seed in common"
    better = contrast.favours
    worse = contrast.second if better == contrast.first else contrast.first
    size = _size(contrast)
    if contrast.verdict is Verdict.DIFFERENT:
        small = f", by less than the margin of {_margin(contrast)}" if contrast.is_small else ""
        return f"{better} is better than {worse} by {size}{small}{_except(contrast)}"
    if contrast.verdict is Verdict.EQUIVALENT:
        both = f"{contrast.first} and {contrast.second}"
        return f"{both} are equivalent within {_margin(contrast)}{_except(contrast)}"
    if estimate.center == 0.0:
        return f"Inconclusive: no difference between {contrast.first} and {contrast.second}"
    return f"Inconclusive: {better} is {size} better than {worse}, which may be noise"


def _except(contrast: Contrast) -> str:
    return f", but {opposed_text(contrast)}" if contrast.opposed else ""


def opposed_text(contrast: Contrast) -> str:
    """Return the scenes whose own intervals contradict the verdict, with their differences."""
    shown = [
        f"{estimate.scene} ({contrast.quantity.difference(estimate.center)})"
        for estimate in contrast.opposed
    ]
    return f"significantly the opposite on {', '.join(shown)}" if shown else ""


def where_text(contrast: Contrast) -> str:
    """Return the point or the views of a contrast.

    A star marks runs that were compared at a point before their ends.
    """
    title = _TITLES.get(contrast.where)
    text = contrast.where if title is None else f"equal {title}"
    return f"{text} *" if contrast.inside else text


def verdict_text(contrast: Contrast) -> str:
    """Return the verdict, and the scenes whose own intervals contradict this verdict."""
    opposed = opposed_text(contrast)
    return f"{contrast.verdict}, {opposed}" if opposed else str(contrast.verdict)


def support(contrast: Contrast) -> str:
    """Return the evidence for a statement: interval, pairs and scenes."""
    estimate = contrast.estimate
    if estimate is None:
        return ""
    equivalent = contrast.verdict is Verdict.EQUIVALENT
    interval = estimate.narrow if equivalent else estimate.wide
    level = "90 %" if equivalent else "95 %"
    parts = [f"{level} interval {interval_text(contrast, interval)}"] if estimate.pairs > 1 else []
    pairs = count(estimate.pairs, "pair")
    parts.append(f"{contrast.ahead} of {pairs} in favour of {contrast.first}")
    parts.append(count(estimate.scenes, "scene"))
    if contrast.verdict is Verdict.INCONCLUSIVE:
        parts.append(needed_text(contrast))
    return ", ".join(parts)


def needed_text(contrast: Contrast) -> str:
    """Return how many pairs would be enough for a verdict."""
    estimate = contrast.estimate
    if estimate is None or estimate.pairs == 1:
        return _ONE_PAIR
    margin = _margin(contrast)
    if estimate.needed is None:
        return f"the noise is much larger than the margin of {margin}"
    if estimate.needed <= estimate.pairs:
        if contrast.is_small or contrast.differs:
            return (
                "significant alone, but not after the correction for the other comparisons "
                "of the table"
            )
        return f"the difference is too close to the margin of {margin} for {estimate.pairs} pairs"
    return f"n ≥ {estimate.needed} pairs are needed to detect {margin} at this noise"


def interval_text(contrast: Contrast, interval: tuple[float, float]) -> str:
    """Return an interval with its signs and unit."""
    if isinf(interval[0]):
        return "unknown"
    digits, unit = contrast.quantity.decimals, contrast.quantity.unit
    return f"{interval[0]:+.{digits}f} to {interval[1]:+.{digits}f} {unit}".rstrip()


def noise_sentence(comparison: Comparison) -> str:
    """Return the noise floor of each scene."""
    quantity = comparison.quantity
    lacking = [scene for scene in comparison.scenes if scene not in comparison.noise]
    spreads = [
        f"{scene} {spread:.{quantity.decimals + 1}f}"
        for scene, (spread, _) in comparison.noise.items()
    ]
    unit = f" {quantity.unit}" if quantity.unit else ""
    parts = [f"{', '.join(spreads)}{unit}"] if spreads else []
    if lacking:
        parts.append(f"unknown on {', '.join(lacking)}: only one seed")
    return "; ".join(parts)


def _alone(comparison: Comparison) -> Sentence:
    if len(comparison.arms) > 1:
        return _unpaired(comparison)
    quantity = comparison.quantity
    by = comparison.standing[comparison.arms[0].name]
    finals = ", ".join(
        f"{scene} {quantity.shown(standing.mean)} {quantity.unit}".rstrip()
        + ("" if isnan(standing.spread) else f" \u00b1 {standing.spread:.{quantity.decimals}f}")
        for scene, standing in by.items()
    )
    return Sentence("There is only one arm, so nothing can be compared", finals)


def _unpaired(comparison: Comparison) -> Sentence:
    """Return the reason why several arms have no pair of runs."""
    failed = [arm.name for arm in comparison.arms if arm.failed and not arm.runs]
    if failed:
        return Sentence(
            f"No pairs: every run of {', '.join(failed)} failed", "see the list of left-out runs"
        )
    problems = [set(by) for by in comparison.main.values() if by]
    if len(problems) > 1 and set.intersection(*problems):
        return Sentence(
            f"No pairs: no scene and seed has {comparison.quantity.label} at the ends of two arms",
            "see the notes",
        )
    return Sentence(
        "No pairs: the arms have no scene with the same seed in common",
        "run the arms on the same scenes with the same seeds",
    )


def _of_the_best(comparison: Comparison) -> list[Sentence]:
    """Compare the best arm with the other arms.

    The best arm is the arm with the best mean over its runs. The estimate from pairs of runs can
    differ from the difference of these means.
    """
    leader = comparison.ranking[0]
    with_leader = [
        contrast for contrast in comparison.ends if leader in {contrast.first, contrast.second}
    ]
    groups = {v: [c for c in with_leader if c.verdict is v] for v in Verdict}
    ahead = [c for c in groups[Verdict.DIFFERENT] if c.favours == leader]
    behind = [c for c in groups[Verdict.DIFFERENT] if c.favours != leader]
    support = f"better than {_against(ahead)}" if ahead else _NONE_BEATEN
    sentences = [
        Sentence(f"{leader} {'has the best mean' if behind else 'is best at the end'}", support)
    ]
    if behind:
        sentences.append(Sentence(f"It is worse than {_against(behind)}", "pair by pair"))
    for verdict, words in (
        (Verdict.EQUIVALENT, "equivalent to"),
        (Verdict.INCONCLUSIVE, "not distinguishable from"),
    ):
        if groups[verdict]:
            sentences.append(
                Sentence(
                    f"It is {words} {_named(contrast.second for contrast in groups[verdict])}",
                    _why(groups[verdict]),
                )
            )
    return sentences


def _against(contrasts: Sequence[Contrast]) -> str:
    return _named(
        f"{contrast.second} by {_size(contrast)} "
        f"({interval_text(contrast, contrast.estimate.wide)})"
        for contrast in contrasts
        if contrast.estimate is not None
    )


def _named(texts: Iterable[str], separator: str = ", ") -> str:
    """Return the first texts, and how many more there are."""
    every = list(texts)
    more = len(every) - _MOST_NAMED
    shown = separator.join(every[:_MOST_NAMED])
    return f"{shown} and {more} more" if more > 0 else shown


def _why(contrasts: Sequence[Contrast]) -> str:
    """Return why arms are equivalent, or how many pairs the closest arm would need."""
    if contrasts[0].verdict is Verdict.EQUIVALENT:
        return f"within {_margin(contrasts[0])}"
    return needed_text(max(contrasts, key=lambda c: (c.estimate and c.estimate.needed) or inf))


def _lengths(comparison: Comparison) -> list[Sentence]:
    """Return a sentence if two arms have runs of different lengths for a scene and seed."""
    lengths: dict[str, dict[str, None]] = {}
    for problem in {problem for by in comparison.main.values() for problem in by}:
        by_arm = {n: by[problem].length_text for n, by in comparison.main.items() if problem in by}
        if len(set(by_arm.values())) > 1:
            for name, length in by_arm.items():
                lengths.setdefault(name, {})[length] = None
    if not lengths:
        return []
    shown = (
        f"{name} {', '.join(sorted(lengths[name]))}"
        for name in comparison.ranking
        if name in lengths
    )
    return [Sentence("The arms had different lengths", _named(shown, "; "))]


def _equal_costs(comparison: Comparison) -> list[Sentence]:
    """Return sentences that compare the two arms of the headline at equal costs."""
    if not comparison.ends:
        return []
    couple = comparison.ends[0].first, comparison.ends[0].second
    return [
        Sentence(
            f"At equal {_TITLES[contrast.where]}: {_lowered(claim(contrast))}", support(contrast)
        )
        for contrast in comparison.equal
        if (contrast.first, contrast.second) == couple
    ]


def _lowered(text: str) -> str:
    return text.replace("Inconclusive", "inconclusive", 1)


def _size(contrast: Contrast) -> str:
    center = 0.0 if contrast.estimate is None else contrast.estimate.center
    quantity = contrast.quantity
    return f"{abs(center):.{quantity.decimals}f} {quantity.unit}".rstrip()


def _margin(contrast: Contrast) -> str:
    return f"{contrast.quantity.margin:g} {contrast.quantity.unit}".rstrip()
