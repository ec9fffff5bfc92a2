"""Verdicts on the paper's claims, from pairs of runs with the statistics of `crossgrad compare`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from math import isinf

from _paper_data import Arithmetic, Check, Expected, Pairing, Probe, Tables, values
from _paper_runs import Results, probed

from crossgrad_plugins.compare.contrasts import Contrast, Pair, contrast
from crossgrad_plugins.compare.narrative import interval_text, needed_text, opposed_text
from crossgrad_plugins.compare.quantity import Quantity
from crossgrad_plugins.compare.run import Run
from crossgrad_plugins.compare.statistics import Estimate, Verdict, corrected, estimate, verdicts

#: `_SURE`: a p-value below this number is significant. `_LOST`: a claim stays open if at least
#: this share of the pairs is missing.
_SURE, _LOST = 0.05, 0.25
#: The metric on which verdicts are based. If the exposure of held-out photos is predicted wrongly,
#: plain PSNR depends more on this prediction than on the scene. Different arms would then have
#: similar values.
PSNR = Quantity.of("psnr_cc")
PLAIN = Quantity.of("psnr")


class Outcome(StrEnum):
    """The verdict on a claim."""

    HOLDS = "holds"
    FAILS = "does not hold"
    OPEN = "inconclusive"
    NOT_RUN = "not run"
    UNTESTABLE = "not testable"


@dataclass(frozen=True)
class Answer:
    """The answer to a claim.

    Attributes:
        outcome: The verdict.
        figure: Our result with its interval, or an empty text.
        detail: Remarks on the verdict, or an empty text.
    """

    outcome: Outcome
    figure: str = ""
    detail: str = ""


@dataclass(frozen=True)
class _Measured:
    """A test with the contrast of its arms; the contrast is None without runs."""

    check: Check
    contrast: Contrast | None
    figure: str
    wanted: int
    missing: int


@dataclass(frozen=True)
class Judgement:
    """The verdict on a comparison, corrected for the other comparisons of its table.

    Attributes:
        verdict: Verdict of `crossgrad compare`.
        is_small: True if the interval of the difference is within the margin.
        is_not_above: True if the interval of the difference is below the margin.
    """

    verdict: Verdict = Verdict.INCONCLUSIVE
    is_small: bool = False
    is_not_above: bool = False


def answers(checks: Sequence[Check], results: Results, tables: Tables) -> list[Answer]:
    """Return the answers to the checks of a table; their p-values are corrected together."""
    measured = [_measured(check, results) for check in checks]
    # Two statements about the same two arms count as one comparison.
    family = {_key(each): _estimate(each) for each in measured if _is_judged(each)}
    found = dict(zip(family, judgements(list(family.values())), strict=True))
    return [_answer(each, found.get(_key(each)), tables) for each in measured]


def judgements(family: Sequence[Estimate]) -> list[Judgement]:
    """Return the verdicts on comparisons that are shown together."""
    small = corrected([each.p_equivalent for each in family])
    above = corrected([each.p_above for each in family])
    return [
        Judgement(verdict, p_small < _SURE, p_above < _SURE)
        for verdict, p_small, p_above in zip(verdicts(family), small, above, strict=True)
    ]


def _key(each: _Measured) -> tuple[Pairing | None, Probe | None]:
    return each.check.test, each.check.probe


def _answer(each: _Measured, judgement: Judgement | None, tables: Tables) -> Answer:
    if not _is_whole(each):
        return _unjudged(each, tables)
    if each.check.within is not None:
        return Answer(_located(each.check.within, _estimate(each).wide), each.figure)
    return _judged(each, judgement or Judgement())


def _is_judged(each: _Measured) -> bool:
    return _is_whole(each) and each.check.within is None


def _is_whole(each: _Measured) -> bool:
    return each.contrast is not None and each.contrast.estimate is not None and not each.missing


def _estimate(each: _Measured) -> Estimate:
    if each.contrast is None or each.contrast.estimate is None:
        raise ValueError("a check without an estimate cannot be judged")
    return each.contrast.estimate


def _measured(check: Check, results: Results) -> _Measured:
    if check.test is not None:
        found = paired(check.test, results)
        scenes, figure = check.test.scenes, with_plain(check.test, results, found)
    elif check.probe is not None:
        found = _of_gradients(check.probe, results, check.margin or 0.1)
        scenes, figure = check.probe.scenes, figure_of(found, signed=check.within is None)
    else:
        return _Measured(check, None, "", 0, 0)
    wanted, missing = results.missing(check.arms, scenes)
    return _Measured(check, found, figure, wanted, missing)


def paired(
    pairing: Pairing, results: Results, quantity: Quantity = PSNR, regime: str | None = None
) -> Contrast:
    """Return the contrast of two arms at the end of their runs."""

    def reading(run: Run) -> float | None:
        hidden = pairing.scenes and run.scene not in pairing.scenes
        return None if hidden else run.final(quantity.name, regime)

    names = pairing.first, pairing.second
    runs = results.runs.get(names[0], {}), results.runs.get(names[1], {})
    return contrast(names, runs, quantity, reading, regime or "at the end")


def _of_gradients(probe: Probe, results: Results, margin: float) -> Contrast:
    """Return a statistic of the gradients by run, or its difference from another statistic."""
    pairs = []
    for (scene, seed), run in sorted(results.runs.get(probe.arm, {}).items()):
        if probe.scenes and scene not in probe.scenes:
            continue
        first = probed(run, probe.first)
        second = 0.0 if probe.second is None else probed(run, probe.second)
        if first is not None and second is not None:
            pairs.append(Pair(scene, seed, first, second))
    quantity = Quantity(probe.first.column, probe.first.column, "", 3, margin)
    second_name = "0" if probe.second is None else probe.second.block
    found = None
    if pairs:
        differences = [pair.difference for pair in pairs]
        found = estimate(differences, [pair.scene for pair in pairs], margin)
    return Contrast(probe.first.block, second_name, "probes", quantity, tuple(pairs), found)


def figure_of(found: Contrast, *, signed: bool = True) -> str:
    """Return an estimate with its 95 % interval and number of pairs; "" without pairs."""
    if found.estimate is None:
        return ""
    quantity, center = found.quantity, found.estimate.center
    text = quantity.difference(center) if signed else f"{quantity.shown(center)} {quantity.unit}"
    low, high = found.estimate.wide
    if isinf(low):
        between = "one pair"
    elif signed:
        between = interval_text(found, (low, high))
    else:
        between = f"{quantity.shown(low)} to {quantity.shown(high)}"
    return f"{text.rstrip()} ({between}; n = {found.estimate.pairs})"


def with_plain(pairing: Pairing, results: Results, found: Contrast) -> str:
    """Return a result, followed by the estimate of plain PSNR."""
    text = figure_of(found)
    plain = paired(pairing, results, PLAIN)
    if not text or plain.estimate is None:
        return text
    return f"{text}; plain {PLAIN.difference(plain.estimate.center)}"


def _unjudged(each: _Measured, tables: Tables) -> Answer:
    if each.check.arithmetic is not None:
        return _calculated(each.check.arithmetic, tables)
    if each.check.none is not None:
        return Answer(Outcome.UNTESTABLE, "", each.check.none)
    if not each.wanted:
        return Answer(Outcome.NOT_RUN, "", "no grid has these runs on a common scene and seed")
    ended = each.wanted - each.missing
    if each.missing:
        detail = f"{ended} of {each.wanted} pairs so far" if ended else ""
        return Answer(Outcome.NOT_RUN, each.figure, detail)
    return Answer(Outcome.OPEN, "", "all runs have ended, but no pair has the figure")


def _judged(each: _Measured, judgement: Judgement) -> Answer:
    if each.contrast is None or each.contrast.estimate is None:
        raise ValueError("a check without an estimate cannot be judged")
    found = replace(each.contrast, verdict=judgement.verdict)
    outcome = outcome_of(each.check.expected or "equal", judgement, found)
    lost = each.wanted - len(found.pairs)
    details = []
    if lost > 0:
        details.append(f"{lost} of {each.wanted} pairs failed or have no figure")
    if lost >= _LOST * each.wanted:
        outcome = Outcome.OPEN
    elif found.opposed:
        details.append(opposed_text(found))
    elif outcome is Outcome.OPEN:
        details.append(needed_text(found))
    elif judgement.verdict is Verdict.DIFFERENT and judgement.is_small:
        details.append("by less than the margin")
    return Answer(outcome, each.figure, "; ".join(details))


def _located(within: tuple[float, float], interval: tuple[float, float]) -> Outcome:
    """Return the verdict on the claim that a value is within bounds, from the value's interval."""
    low, high = interval
    if within[0] <= low and high <= within[1]:
        return Outcome.HOLDS
    return Outcome.FAILS if high < within[0] or low > within[1] else Outcome.OPEN


def outcome_of(expected: Expected, judgement: Judgement, found: Contrast) -> Outcome:
    """Return the verdict on a statement about two arms.

    If one scene clearly contradicts a statement, the verdict on all scenes together is open.
    """
    ahead = found.favours == found.first
    verdict = judgement.verdict
    if verdict is Verdict.INCONCLUSIVE:
        # A one-sided statement can have a verdict although the two-sided test is inconclusive.
        settled = expected == "not better" and judgement.is_not_above
        return Outcome.HOLDS if settled else Outcome.OPEN
    holds = {
        "better": verdict is Verdict.DIFFERENT and ahead,
        "worse": verdict is Verdict.DIFFERENT and not ahead,
        "equal": verdict is Verdict.EQUIVALENT or judgement.is_small,
        "not better": verdict is Verdict.EQUIVALENT or not ahead or judgement.is_small,
    }
    if holds[expected]:
        return Outcome.OPEN if found.opposed else Outcome.HOLDS
    return Outcome.FAILS


def _calculated(claim: Arithmetic, tables: Tables) -> Answer:
    """Return the answer to a statement about shares of a gap, from the paper's own numbers."""
    method = values(tables, claim.table, claim.method, "PSNR")
    base = values(tables, claim.table, claim.base, "PSNR")
    target = values(tables, claim.target_table, claim.target, "PSNR")
    shares = {
        scene: (method[scene] - base[scene]) / (target[scene] - base[scene])
        for scene in method
        if target[scene] > base[scene]
    }
    inside = sum(claim.low <= share <= claim.high for share in shares.values())
    shown = ", ".join(f"{scene} {share:.0%}" for scene, share in shares.items())
    none = [scene for scene in method if scene not in shares]
    lacking = f"; no gap on {', '.join(none)}" if none else ""
    outcome = Outcome.HOLDS if inside >= claim.scenes else Outcome.FAILS
    return Answer(outcome, f"{shown}{lacking}", "from the paper's own tables")
