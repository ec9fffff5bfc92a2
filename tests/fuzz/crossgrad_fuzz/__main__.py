"""Searches for inputs on which a parser fails: `python -m crossgrad_fuzz --help`."""

import argparse
import os
import sys
import time
from pathlib import Path

from crossgrad_fuzz.case import load
from crossgrad_fuzz.defects import DEFECTS
from crossgrad_fuzz.loop import Budget, bench_for, search
from crossgrad_fuzz.suite import run, search_alone
from crossgrad_fuzz.targets import TARGETS

_OUT = Path("fuzz-findings")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="crossgrad_fuzz", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, words in (("run", "all parsers, or those named"), ("alone", "one, in this process")):
        one = commands.add_parser(name, help=words)
        one.add_argument("targets", nargs="*" if name == "run" else 1, choices=[*TARGETS, []])
        one.add_argument("--seconds", type=float, default=600.0, help="at least so long each")
        one.add_argument("--executions", type=int, default=100_000, help="and at least so many")
        one.add_argument("--longest", type=float, default=float("inf"), help="seconds at most")
        one.add_argument("--seed", type=int, default=0)
        one.add_argument("--out", type=Path, default=_OUT, help="where findings are kept")
        one.add_argument("--work", type=Path, help=argparse.SUPPRESS)
        one.add_argument("--jobs", type=int, default=max(1, (os.cpu_count() or 2) - 1))
        one.add_argument("--least", type=float, default=0.0, help="least share of branches")
    again = commands.add_parser("replay", help="what a finding does now")
    again.add_argument("folders", nargs="+", type=Path, help="folders below fuzz-findings/PARSER/")
    back = commands.add_parser("defects", help="repaired defects, put back: are they found?")
    back.add_argument("--seconds", type=float, default=60.0)
    back.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def _run(given: argparse.Namespace) -> int:
    budget = Budget(given.seconds, given.executions, given.longest)
    if given.command == "alone":
        search_alone(given.targets[0], budget, given.seed, given.work, given.out)
        return 0
    reports = run(given.targets or list(TARGETS), budget, given.seed, given.jobs, given.out)
    for report in reports:
        for kind, folder in report.findings.items():
            print(f"{report.target}: {kind}\n    {folder}")
        for place, lines in report.missing.items():
            print(f"{report.target}: not reached: {place} {lines}")
    poor = [r.target for r in reports if r.taken < given.least * r.branches]
    if poor:
        print(f"fewer than {100 * given.least:.0f} % of the branches: {', '.join(poor)}")
    return int(bool(poor) or any(report.findings for report in reports))


def _replay(folders: list[Path]) -> int:
    failed = 0
    for folder in folders:
        target = TARGETS[folder.absolute().parent.name]
        with bench_for(target) as bench:
            bench.warm_up(target.seeds())
            finding = bench.execute(load(folder))
        print(f"{folder}: {'holds' if finding is None else finding.kind}")
        if finding is not None:
            print(finding.detail)
            failed += 1
    return int(failed > 0)


def _defects(seconds: float, seed: int) -> int:
    lost = 0
    for name, defect in DEFECTS.items():
        target = TARGETS[defect.target]
        started = time.monotonic()
        with bench_for(target) as bench:
            bench.warm_up(target.seeds())
            with defect.put_back():
                found = search(target, bench, Budget(seconds, findings=1, shrinking=0), seed)
        took = time.monotonic() - started
        kinds = ", ".join(found.findings)
        print(f"{name}: {f'found after {took:.1f} s: {kinds}' if kinds else 'NOT FOUND'}")
        lost += not kinds
    return int(lost > 0)


def main() -> int:
    """Runs the command; 1 where something was found, or a defect was not."""
    given = _arguments()
    if given.command == "replay":
        return _replay(given.folders)
    if given.command == "defects":
        return _defects(given.seconds, given.seed)
    return _run(given)


if __name__ == "__main__":
    sys.exit(main())
