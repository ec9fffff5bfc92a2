"""The guided search: inputs that reach new lines are kept, and changed further."""

import random
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from crossgrad_fuzz.case import Case
from crossgrad_fuzz.guide import Guide
from crossgrad_fuzz.law import SLOW, Bench, Finding
from crossgrad_fuzz.mutate import BLIND, exchanger, inserter
from crossgrad_fuzz.target import Mutator, Target

MEMORY = Path("/dev/shm")
#: Share of mutations that know the format, where there are any.
_KNOWING = 0.6


@dataclass
class Search:
    """The findings of a search.

    Attributes:
        guide: Knows what was reached of the parser.
        executions: Inputs parsed.
        seconds: Wall-clock seconds.
        corpus: The inputs that reached something new, valid ones first.
        findings: Kind -> what was wrong, and the input.
    """

    guide: Guide
    executions: int = 0
    seconds: float = 0.0
    corpus: list[Case] = field(default_factory=list)
    findings: dict[str, tuple[Finding, Case]] = field(default_factory=dict)


@dataclass(frozen=True)
class Budget:
    """When a search ends: after so many seconds *and* so many executions, or at a bound.

    Attributes:
        seconds: Least wall-clock seconds.
        executions: Least number of executions.
        longest: Most wall-clock seconds, whatever the executions.
        findings: Enough findings.
        shrinking: Executions spent on making a finding smaller.
    """

    seconds: float = 0.0
    executions: int = 0
    longest: float = float("inf")
    findings: int = 20
    shrinking: int = 400

    def left(self, search: Search) -> bool:
        """Whether the search goes on."""
        ended = search.seconds >= self.seconds and search.executions >= self.executions
        late = search.seconds >= self.longest
        return not ended and not late and not self.enough(search)

    def enough(self, search: Search) -> bool:
        """Whether so much was found that nothing more is looked for."""
        return len(search.findings) >= self.findings


@contextmanager
def bench_for(target: Target) -> Iterator[Bench]:
    """A bench in a temporary folder, in memory where the system allows it."""
    place = MEMORY if MEMORY.is_dir() else None
    with tempfile.TemporaryDirectory(prefix="crossgrad-fuzz-", dir=place) as folder:
        yield Bench(target, Path(folder))


@dataclass(frozen=True)
class Watcher:
    """Who is told what a search does.

    Attributes:
        begin: Called before each execution.
        find: Called with each finding and the shrunk input.
    """

    begin: Callable[[Search], None] = lambda search: None
    find: Callable[[Finding, Case], None] = lambda finding, case: None


def search(
    target: Target,
    bench: Bench,
    budget: Budget,
    seed: int,
    known: Iterable[Case] = (),
    watcher: Watcher = Watcher(),
) -> Search:
    """Looks for inputs on which a parser breaks the law.

    Args:
        target: The parser.
        bench: Where to parse.
        budget: How long.
        seed: Of the mutations; the same seed and number of executions give the same inputs.
        known: Inputs to begin with besides the valid ones.
        watcher: Who is told.
    """
    state = Search(guide=Guide(target.parser))
    valid = list(target.seeds())
    bench.warm_up(valid)
    inputs = _inputs(target, state, random.Random(seed), [*valid, *known])
    started = time.monotonic()
    with state.guide.watching():
        for case, given in inputs:
            watcher.begin(state)
            finding = bench.execute(case)
            state.executions += 1
            if (state.guide.news() or given) and _handy(target, case):
                state.corpus.append(case)
            if finding is not None and finding.kind not in state.findings:
                small = shrunk(bench, case, finding, budget.shrinking)
                state.findings[finding.kind] = (finding, small)
                watcher.find(finding, small)
            state.seconds = time.monotonic() - started
            if budget.enough(state) or (not given and not budget.left(state)):
                break
    return state


def _handy(target: Target, case: Case) -> bool:
    """Whether an input is worth changing further: long ones take long."""
    return all(len(content) <= target.most_bytes for content in case.values())


def _inputs(
    target: Target, state: Search, rng: random.Random, given: Sequence[Case]
) -> Iterator[tuple[Case, bool]]:
    """The given inputs, then mutated ones without an end; and whether it is a given one."""
    for case in given:
        yield case, True
    mutators = _knowing(target)
    while True:
        yield _mutated(target, state.corpus, mutators, rng), False


def _knowing(target: Target) -> tuple[Mutator, ...]:
    if not target.words:
        return target.mutators
    return (*target.mutators, inserter(target.words), exchanger(target.words))


def _mutated(
    target: Target, corpus: Sequence[Case], mutators: Sequence[Mutator], rng: random.Random
) -> Case:
    """One of the corpus, changed a few times; the latest ones are taken more often."""
    index = max(rng.randrange(len(corpus)), rng.randrange(len(corpus)))
    case = dict(corpus[index] or corpus[0])
    count = min(8, 1 + int(rng.expovariate(0.7)))
    for _ in range(count):
        if target.case_mutators and rng.random() < 0.15:
            case = rng.choice(target.case_mutators)(case, rng)
            continue
        name = rng.choice(sorted(case))
        content = _changed(case[name], mutators, rng)
        if rng.random() < 0.03:
            content = _spliced(content, rng.choice(corpus).get(name, b""), rng)
        case[name] = content
    if rng.random() < 0.01:
        _exchange(case, rng)
    cut = {name: content[: target.most_bytes] for name, content in case.items()}
    return target.repair(cut, rng)


def _changed(content: bytes, mutators: Sequence[Mutator], rng: random.Random) -> bytes:
    pool = mutators if mutators and rng.random() < _KNOWING else BLIND
    return rng.choice(pool)(content, rng)


def _spliced(content: bytes, other: bytes, rng: random.Random) -> bytes:
    return content[: rng.randrange(len(content) + 1)] + other[rng.randrange(len(other) + 1) :]


def _exchange(case: dict[str, bytes], rng: random.Random) -> None:
    """A file goes, or holds what another one should."""
    a, b = rng.choice(sorted(case)), rng.choice(sorted(case))
    if rng.random() < 0.5:
        del case[a]
    else:
        case[a] = case[b]


def shrunk(bench: Bench, case: Case, finding: Finding, attempts: int) -> Case:
    """A smaller input with the same finding, as far as so many executions lead."""
    small = dict(case)
    if finding.kind == SLOW:
        return small
    for name in sorted(small):
        size = max(1, len(small[name]) // 2)
        at = 0
        while attempts > 0 and size >= 1:
            content = small[name]
            shorter = content[:at] + content[at + size :]
            attempts -= 1
            if shorter != content and _still(bench, {**small, name: shorter}, finding):
                small[name] = shorter
            else:
                at += size
            if at >= len(small[name]):
                at, size = 0, size // 2
    return small


def _still(bench: Bench, case: Case, finding: Finding) -> bool:
    found = bench.execute(case)
    return found is not None and found.kind == finding.kind
