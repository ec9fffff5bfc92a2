"""Runs of several commits or versions: what one of them changed is a part of their difference."""

from collections.abc import Iterator, Mapping
from typing import Final

from crossgrad_plugins.compare.contrasts import Runs
from crossgrad_plugins.compare.run import Run

_MEANING: Final = "that they are equally fast is not given, and bits may differ"
_MOST_SHOWN: Final = 3


def differing_code(arms: Mapping[str, Runs]) -> list[str]:
    """A note where arms, or the two runs of a pair, come from different code; else none.

    Runs that do not say where they come from agree with all.

    Args:
        arms: Arm -> scene and seed -> the run that stands for them.
    """
    used = {arm: _all_code(runs) for arm, runs in arms.items()}
    groups: dict[str, list[str]] = {}
    for arm, code in used.items():
        if code:
            groups.setdefault(code, []).append(arm)
    if len(groups) > 1:
        shown = [f"{_named(own)} ran at {code}" for code, own in groups.items()]
        more = len(shown) - _MOST_SHOWN
        parts = [*shown[:_MOST_SHOWN], *([f"{more} more"] if more > 0 else [])]
        return [f"code differs: {'; '.join(parts)}: {_MEANING}"]
    if pair := next(_unlike_pairs(arms), None):
        texts = [f"{run.name} ran at {code_of(run)}" for run in pair]
        return [f"code differs within pairs: {', '.join(texts)}: {_MEANING}"]
    return []


def code_of(run: Run) -> str:
    """The commit of a run, or of an installed package its version; empty where it has neither."""
    environment = run.summary.get("environment") or {}
    commit, version = environment.get("commit"), environment.get("crossgrad")
    if commit:
        return f"commit {commit}"
    return f"crossgrad {version}" if version else ""


def _all_code(runs: Runs) -> str:
    return " and ".join(sorted({code for run in runs.values() if (code := code_of(run))}))


def _named(arms: list[str]) -> str:
    more = len(arms) - _MOST_SHOWN
    # Names have commas in them.
    names = ", ".join(f"'{arm}'" for arm in arms[:_MOST_SHOWN])
    return names if more <= 0 else f"{names} and {more} more"


def _unlike_pairs(arms: Mapping[str, Runs]) -> Iterator[tuple[Run, Run]]:
    """Runs on one scene with one seed that come from different code."""
    known: dict[tuple[str, int], Run] = {}
    for runs in arms.values():
        for problem, run in runs.items():
            if code := code_of(run):
                first = known.setdefault(problem, run)
                if code_of(first) != code:
                    yield first, run
