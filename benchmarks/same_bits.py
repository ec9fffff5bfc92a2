"""Test whether two versions of crossgrad train bit-identically.

    python benchmarks/same_bits.py OLD_PYTHON NEW_PYTHON [--only TEXT] [--out DIR]
        [--for-new OPTIONS]

OLD_PYTHON and NEW_PYTHON are the interpreters of two environments on this machine, each with one
version installed. The cases contain every backbone with each densifier, and every operator, sampler
and grouping at least once. Each case trains the bundled scene for 60 steps, with density control
from step 20 on. It is stopped at step 30 and resumed. Tensors, moments, plugin states, random
generators, the PLY and metrics.csv (without times) must be equal. States of slots that only the new
version has are ignored. The exit status is 1 if there is a difference.

If a difference is intended, the message of the commit must explain it. If a default changed,
`--for-new "--schedule-unit steps"` gives the new version options that restore the old behaviour.
"""

import argparse
import csv
import json
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

#: Options of every run. These options cause three edits, an opacity reset, and evaluations before
#: and after the stop.
USUAL = (
    *("--steps", "60", "--max-size", "100", "--threads", "1", "--quiet"),
    *("--set", "densify_from=20", "--set", "densify_every=10", "--set", "densify_until=55"),
    *("--set", "reset_every=30", "--set", "eval_every=20", "--stop-after", "30"),
)
#: Columns of metrics.csv that differ even between two equal runs.
CLOCKS = {"train_seconds", "cpu_seconds", "peak_memory_mib"}

#: Program that runs in the tested environment. It reads command lines as JSON and writes exit codes
#: as JSON.
CHILD = """
import contextlib, io, json, sys
from crossgrad_core.cli.main import main

def code_of(arguments):
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            main(arguments)
        except SystemExit as end:
            return end.code or 0, said.getvalue()
    return 0, said.getvalue()

for line in sys.stdin:
    print(json.dumps(code_of(json.loads(line))), flush=True)
"""
NAMES = """
import json, sys
from importlib.metadata import entry_points
slots = sys.argv[1:]
print(json.dumps({s: sorted(e.name for e in entry_points(group=f"crossgrad.{s}")) for s in slots}))
"""


@dataclass(frozen=True)
class Case:
    """One run: its name and the options that make it."""

    name: str
    options: tuple[str, ...]


@dataclass
class Environment:
    """A version of crossgrad, used through one process of its Python interpreter."""

    python: str
    options: tuple[str, ...] = ()
    process: "subprocess.Popen[str]" = field(init=False)

    def __post_init__(self) -> None:
        self.process = subprocess.Popen(
            [self.python, "-P", "-c", CHILD],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(self, *arguments: str) -> tuple[int, str]:
        """Return exit code and output of a command line."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps(arguments) + "\n")
        self.process.stdin.flush()
        code, said = json.loads(self.process.stdout.readline())
        return code, said

    def names(self, *slots: str) -> dict[str, list[str]]:
        """Return the installed components of some slots."""
        found: dict[str, list[str]] = json.loads(
            subprocess.check_output([self.python, "-P", "-c", NAMES, *slots], text=True)
        )
        return found


def cases(names: dict[str, list[str]]) -> Iterator[Case]:
    """Yield every backbone x densifier, and every operator, sampler and grouping."""
    for backbone in names["backbones"]:
        for densifier in names["densifiers"]:
            options = ("--backbone", backbone, "--densifier", densifier)
            yield Case(f"{backbone} x {densifier}", options)
    pair = ("--sampler", "near-far", "--views", "2")
    for operator in names["operators"]:
        yield Case(f"operator {operator}", (*pair, "--operator", operator))
    for sampler in names["samplers"]:
        yield Case(f"sampler {sampler}", ("--sampler", sampler, "--operator", "symmetric"))
    for grouping in names["groupings"]:
        yield Case(f"grouping {grouping}", (*pair, "--grouping", grouping))


def trained(environment: Environment, case: Case, folder: Path) -> tuple[int, str]:
    """Train a case into `folder`, with a stop and a resumption.

    Return the exit code and the last output.
    """
    arguments = ("run", "--out", str(folder), *case.options, *environment.options, *USUAL)
    code, said = environment.run(*arguments)
    if code != 0:
        return code, said
    return environment.run("run", "--resume", str(folder), "--quiet")


def differences(old: Path, new: Path) -> list[str]:
    """Return the differences between two run folders."""
    first, second = _checkpoint(old), _checkpoint(new)
    found = []
    if (first / "tensors.safetensors").read_bytes() != (
        second / "tensors.safetensors"
    ).read_bytes():
        found.append("tensors")
    states = [json.loads((path / "state.json").read_text()) for path in (first, second)]
    if states[0]["step"] != states[1]["step"]:
        found.append("state.json: step")
    found += [
        f"state.json: {key} of {name}"
        for key in ("plugins", "generators")
        for name, value in states[0][key].items()
        if value != states[1][key].get(name)
    ]
    if (old / "point_cloud.ply").read_bytes() != (new / "point_cloud.ply").read_bytes():
        found.append("point_cloud.ply")
    return found + _columns(old / "metrics.csv", new / "metrics.csv")


def _checkpoint(run: Path) -> Path:
    return max((run / "checkpoints").glob("step-*"))


def _columns(old: Path, new: Path) -> list[str]:
    with old.open() as first, new.open() as second:
        rows = list(csv.DictReader(first)), list(csv.DictReader(second))
    if len(rows[0]) != len(rows[1]):
        return [f"metrics.csv: {len(rows[0])} rows and {len(rows[1])}"]
    names = [name for name in rows[0][0] if name not in CLOCKS]
    return [
        f"metrics.csv: {name}"
        for name in names
        if any(a[name] != b.get(name) for a, b in zip(*rows, strict=True))
    ]


def verdict(case: Case, environments: list[Environment], out: Path) -> tuple[bool, str]:
    """Return True if both versions agree on a case, and a description."""
    folders = [out / side / case.name.replace(" ", "-") for side in ("old", "new")]
    ends = [trained(*pair) for pair in zip(environments, [case] * 2, folders, strict=True)]
    codes = [code for code, _ in ends]
    if codes[0] != codes[1]:
        return False, f"exit codes {codes[0]} and {codes[1]}: {ends[1][1].strip()[-300:]}"
    if codes[0] == 2:
        return True, "refused by both"
    if codes[0] != 0:
        return False, f"both fail: {ends[0][1].strip()[-300:]}"
    found = differences(*folders)
    for folder in folders:
        shutil.rmtree(folder)
    return not found, "; ".join(found) or "equal"


def main() -> None:
    """Compare the two environments case by case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", help="interpreter with the old version")
    parser.add_argument("new", help="interpreter with the new version")
    parser.add_argument("--only", default="", help="only cases whose name contains this text")
    parser.add_argument("--out", type=Path, help="folder for the runs; default: a temporary folder")
    parser.add_argument(
        "--for-new", type=shlex.split, default=[], help="options that only the new version gets"
    )
    arguments = parser.parse_args()
    new = Environment(arguments.new, tuple(arguments.for_new))
    environments = [Environment(arguments.old), new]
    names = environments[0].names("backbones", "densifiers", "operators", "samplers", "groupings")
    out = arguments.out or Path(tempfile.mkdtemp(prefix="same-bits-"))
    counts = {"equal": 0, "refused by both": 0, "different": 0}
    for case in cases(names):
        if arguments.only not in case.name:
            continue
        same, text = verdict(case, environments, out)
        counts[text if same else "different"] += 1
        print(f"{'ok ' if same else 'DIFFERS'} {case.name}: {text}", flush=True)
    print(", ".join(f"{count} {what}" for what, count in counts.items()))
    sys.exit(counts["different"] > 0)


if __name__ == "__main__":
    main()
