"""Many searches, each in a process of its own, so that a crash or a hang ends only that one."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path

from crossgrad_fuzz.case import digest, load, save
from crossgrad_fuzz.law import Bench, Finding
from crossgrad_fuzz.loop import MEMORY, Budget, Search, Watcher, search
from crossgrad_fuzz.regressions import known_of
from crossgrad_fuzz.targets import TARGETS

#: Wall-clock seconds without a new execution after which a process counts as hung. Executions are
#: bounded in CPU seconds already; this is for code that no signal reaches. Ample, since a search
#: may begin on a machine that is busy with other work.
_HUNG = 900.0
_BEAT, _REPORT = "beat", "report.json"
#: One thread per search, so that several do not fight for the cores.
_THREADS = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


@dataclass
class Report:
    """The result of one search.

    Attributes:
        target: Name of the parser.
        executions: Inputs parsed.
        seconds: Wall-clock seconds.
        cpu_seconds: CPU seconds of the process, its start included.
        corpus: Inputs that reached something new.
        branches: Branches of the parser.
        taken: Those that were taken.
        missing: `file:function` -> pairs of lines that never followed each other.
        findings: Kind -> folder of the input.
    """

    target: str
    executions: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    corpus: int = 0
    branches: int = 0
    taken: int = 0
    missing: dict[str, list[list[int]]] = field(default_factory=dict)
    findings: dict[str, str] = field(default_factory=dict)

    def line(self) -> str:
        """One row of the table."""
        share = 100.0 * self.taken / self.branches if self.branches else 100.0
        return (
            f"{self.target:18} {self.executions:>10,} {self.seconds:>8,.0f} "
            f"{self.cpu_seconds:>6,.0f} {self.corpus:>7} "
            f"{self.taken:>4} of {self.branches:>3} = {share:5.1f} % {len(self.findings):>9}"
        )


HEAD = "parser             executions  seconds    CPU  inputs  branches taken   findings"


def search_alone(name: str, budget: Budget, seed: int, work: Path, out: Path) -> Report:
    """One search in this process, with its report and its sign of life in `work`.

    Args:
        name: The parser.
        budget: How long.
        seed: Of the mutations.
        work: Folder of this search alone.
        out: Where findings are kept.
    """
    beat = os.open(work / _BEAT, os.O_RDWR | os.O_CREAT)
    report = Report(name)

    def begin(state: Search) -> None:
        os.pwrite(beat, state.executions.to_bytes(8, "little"), 0)

    def find(finding: Finding, case: dict[str, bytes]) -> None:
        report.findings[finding.kind] = str(kept(out / name, finding, case))

    bench = Bench(TARGETS[name], work / "bench")
    state = search(TARGETS[name], bench, budget, seed, known_of(name), Watcher(begin, find))
    os.close(beat)
    reach = state.guide.reach()
    report.executions, report.seconds = state.executions, state.seconds
    report.corpus, report.cpu_seconds = len(state.corpus), time.process_time()
    report.branches, report.taken, report.missing = (
        reach.branches,
        reach.taken,
        dict(reach.missing),
    )
    (work / _REPORT).write_text(json.dumps(asdict(report)))
    return report


def kept(folder: Path, finding: Finding, case: dict[str, bytes]) -> Path:
    """Writes a finding where `replay` finds it."""
    place = folder / digest(case)
    place.mkdir(parents=True, exist_ok=True)
    save(case, place)
    place.with_suffix(".txt").write_text(f"{finding.kind}\n\n{finding.detail}\n", errors="replace")
    return place


def run(names: Sequence[str], budget: Budget, seed: int, jobs: int, out: Path) -> list[Report]:
    """All searches, `jobs` at a time; prints a line for each as it ends."""
    print(HEAD, flush=True)
    with ThreadPoolExecutor(jobs) as pool:
        waiting = [pool.submit(_in_process, name, budget, seed, out) for name in names]
        reports = []
        for each in waiting:
            reports.append(each.result())
            print(reports[-1].line(), flush=True)
    return reports


def _in_process(name: str, budget: Budget, seed: int, out: Path) -> Report:
    place = MEMORY if MEMORY.is_dir() else None
    with tempfile.TemporaryDirectory(prefix="crossgrad-fuzz-", dir=place) as folder:
        work = Path(folder)
        command = [sys.executable, "-m", "crossgrad_fuzz", "alone", name, "--work", folder]
        command += ["--seconds", str(budget.seconds), "--executions", str(budget.executions)]
        command += ["--longest", str(budget.longest), "--seed", str(seed), "--out", str(out)]
        with (work / "log").open("wb") as log:
            process = subprocess.Popen(
                command, stdout=log, stderr=log, env={**os.environ, **_THREADS}
            )
            ended = _watched(process, work / _BEAT)
        if (work / _REPORT).is_file():
            return Report(**json.loads((work / _REPORT).read_text()))
        return _lost(name, ended, work, out)


def _watched(process: subprocess.Popen[bytes], beat: Path) -> str:
    """Waits for a search; how it ended."""
    last, since = b"", time.monotonic()
    while process.poll() is None:
        time.sleep(0.5)
        now = beat.read_bytes() if beat.is_file() else b""
        if now != last:
            last, since = now, time.monotonic()
        elif time.monotonic() - since > _HUNG:
            process.kill()
            process.wait()
            return "hang"
    return f"crash with status {process.returncode}"


def _lost(name: str, ended: str, work: Path, out: Path) -> Report:
    """The report of a search that did not live to write one: its last input is the finding."""
    log = (work / "log").read_text(errors="replace")
    place = work / "bench" / "input"
    last = load(place) if place.is_dir() else {}
    folder = kept(out / name, Finding(ended, log[-4000:]), last)
    count = (work / _BEAT).read_bytes() if (work / _BEAT).is_file() else b""
    report = Report(name, executions=int.from_bytes(count, "little"))
    report.findings[ended] = str(folder)
    shutil.copy(work / "log", folder.with_suffix(".log"))
    return report
