"""Test the paper's tables and claims on our scenes, and write a page with the results.

    python benchmarks/paper.py run [--only GRID,...] [--scenes DIR] [--workers N]
    python benchmarks/paper.py page        # only write the page, from existing runs
    python benchmarks/paper.py estimate    # core hours of each grid

`run` prints the expected time, tunes the learning rates, runs the grids of benchmarks/grids/paper,
and writes docs/results/paper.md. It can be stopped and started again at any time, because finished
runs are not repeated. Tables of finished runs are packed in benchmarks/results/paper. A later call
uses these tables, also on another machine.
"""

import argparse
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import yaml
from _paper_data import BEST, GRIDS, Plan, read_claims, read_plan, read_tables
from _paper_page import page
from _paper_runs import Results, read_results
from _paper_verdicts import PSNR
from kept import pack, unpack

from crossgrad_core.commands import (
    UserError,
    available_cores,
    exit_code,
    find_runs,
    write_atomically,
    write_mapping,
)
from crossgrad_plugins.compare.ranking import ranked, standings
from crossgrad_plugins.sweep.grid import Arm, Grid, choices, read_grid, scene_name, with_scenes

ROOT = Path(__file__).parents[1]
#: Tuned arm -> scene -> factor of the learning rates.
Factors: TypeAlias = Mapping[str, Mapping[str, float]]
CROSSGRAD = [sys.executable, "-m", "crossgrad_core"]
#: CPU seconds of a view at 400 px, and CPU seconds of a run besides its views (libraries, scene,
#: evaluation, results). The values were measured with one run of 1,200 views per scene, two views
#: per step, on one shared core of an AMD EPYC.
VIEW, BESIDES = 0.049, 12.0
#: Cost of a view relative to vanilla (docs/benchmarks.md, Cost of backbones).
COSTS = {
    "scaffold": 1.5,
    "octree": 1.6,
    "analytic": 1.9,
    "mip": 1.15,
    "pixel": 1.1,
    "distance": 1.35,
}
#: Seconds that a run needs to measure its gradients.
PROBES = 25.0


@dataclass(frozen=True)
class Place:
    """The folders and files of the benchmark.

    Attributes:
        out: Folder of the sweeps and of the grids from which they are run.
        kept: Folder of packed tables of finished runs.
        page: Path of the written page.
    """

    out: Path
    kept: Path
    page: Path

    def sweep(self, grid: str) -> Path:
        """Return the folder of a grid's sweep."""
        return self.out / grid

    def grid(self, grid: str) -> Path:
        """Return the path of the grid that is run, which contains scenes and learning rates."""
        return self.out / "grids" / f"{grid}.yaml"

    @property
    def tuned(self) -> Path:
        """The grid with the best learning rates, as written by `crossgrad sweep --best`."""
        return self.out / "grids" / "tuned.yaml"

    def archive(self, grid: str) -> Path:
        """Return the path of a grid's packed tables."""
        return self.kept / f"{grid}.tar.xz"


class Paper:
    """All grids, on the user's scenes.

    Args:
        given: The options of the command line.
    """

    def __init__(self, given: argparse.Namespace) -> None:
        self.given = given
        self.place = Place(given.out.absolute(), given.kept.absolute(), given.page.absolute())
        self.plan: Plan = read_plan()

    def check(self) -> None:
        """Refuse grids that do not exist."""
        if unknown := [name for name in self.given.only or () if name not in self.plan.grids]:
            raise UserError(
                "there is no such grid",
                where="--only",
                expected=", ".join(self.plan.grids),
                found=", ".join(unknown),
                todo="copy a name, without .yaml",
            )

    @property
    def names(self) -> list[str]:
        """The grids that the user requested, in order."""
        only = self.given.only
        return [name for name in self.plan.grids if not only or name in only]

    def source(self, name: str) -> Grid:
        """Return a grid of the repository, with the user's scenes."""
        grid = read_grid(GRIDS / f"{name}.yaml")
        folder = self.given.scenes
        wanted = self.given.scene or [folder / scene_name(each) for each in grid.scenes]
        grid = with_scenes(grid, [Path(each) for each in wanted])
        seeds = self.given.seed if name != self.plan.tuning else None
        return grid.model_copy(update={"seeds": tuple(seeds)}) if seeds else grid

    def grids(self) -> dict[str, Grid]:
        """Return every grid as it was last run.

        Grids that were never run are read from the repository.
        """
        found = {
            name: read_grid(path) if path.is_file() else self.source(name)
            for name in self.plan.grids
            for path in (self.place.grid(name),)
        }
        last = self.plan.best_of.grid
        if not self.place.grid(last).is_file():
            best = self._best(self._read(found), found)
            found[last] = with_methods(found[last], best) if len(best) == BEST else found[last]
        return found

    def results(self) -> Results:
        """Return the results of all grids so far."""
        return self._read(self.grids())

    def _read(self, grids: Mapping[str, Grid]) -> Results:
        sweeps = {name: self.place.sweep(name) for name in grids}
        return read_results(sweeps, grids, self.given.set or ())

    # The following methods are the stages of `run`, in their order.

    def unpack(self) -> None:
        """Add finished runs from the packed tables."""
        for name in (self.plan.tuning, *self.plan.grids):
            if self.place.archive(name).is_file():
                unpack(self.place.archive(name), self.place.sweep(name))

    def run(self) -> int:
        """Tune, start the unfinished runs, and write the page.

        Return the exit code.
        """
        self.unpack()
        self.tell()
        worst = self._swept(self.plan.tuning, _as_mapping(self.source(self.plan.tuning)))
        if worst > 2:  # A signal stopped the sweep.
            return worst
        factors = self._factors()
        for name in self.names:
            content = self._content(name, factors)
            if content is None:
                continue
            code = self._swept(name, content)
            if code > 2:  # A signal stopped the sweep.
                return code
            worst = max(worst, code)
            self.write_page()
        return worst

    def _swept(self, name: str, content: Mapping[str, Any]) -> int:
        """Run a grid, pack its finished runs, and return the exit code."""
        path = self.place.grid(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        write_mapping(path, content)
        command = ["sweep", str(path), "--out", str(self.place.sweep(name))]
        for text in self.given.set or ():
            command += ["--set", text]
        if self.given.workers:
            command += ["--workers", str(self.given.workers)]
        print(f"\n== {name}", flush=True)
        code = _call(command)
        if find_runs(self.place.sweep(name) / "runs"):
            _packed(self.place.sweep(name), self.place.archive(name))
        return code

    def _factors(self) -> Factors:
        """Return the best factors of the learning rates."""
        self.place.tuned.unlink(missing_ok=True)
        tuning = self.place.grid(self.plan.tuning)
        command = ["sweep", str(tuning), "--out", str(self.place.sweep(self.plan.tuning))]
        for text in self.given.set or ():
            command += ["--set", text]
        if code := _call([*command, "--best", str(self.place.tuned)]):
            raise SystemExit(code)
        content = yaml.safe_load(self.place.tuned.read_text(encoding="utf-8"))
        return {
            arm["name"].removesuffix(", best"): {
                scene: settings["rate_factor"] for scene, settings in arm["by_scene"].items()
            }
            for arm in content["arms"]
            if arm["name"].endswith(", best")
        }

    def _content(self, name: str, factors: Factors) -> dict[str, Any] | None:
        """Return a grid with learning rates; None if it must wait for other grids."""
        grid = self.source(name)
        if name == self.plan.best_of.grid:
            best = self._best(self.results(), self.grids())
            if len(best) < BEST:
                print(
                    f"\n== {name}: not started, because the candidates have not finished",
                    flush=True,
                )
                return None
            grid = with_methods(grid, best)
            rates = {arm.name: rate_of(arm, best, self.plan) for arm in grid.arms}
        else:
            rates = {arm.name: own_rate(arm.name, self.plan, factors) for arm in grid.arms}
        if name in self.plan.fixed_rates:
            return _as_mapping(grid)
        return _as_mapping(with_rates(grid, rates, factors))

    def _best(self, results: Results, grids: Mapping[str, Grid]) -> list[Arm]:
        """Return the best candidates; none before all their runs have ended."""
        candidates = self.plan.best_of.candidates
        if any(results.missing([name])[1] for name in candidates):
            return []
        runs = {name: results.runs.get(name, {}) for name in candidates}
        known = {name: by for name, by in runs.items() if by}
        order = ranked(standings(known, PSNR), PSNR)[:BEST]
        arms = {arm.name: arm for grid in grids.values() for arm in grid.arms}
        return [arms[name] for name in order]

    def write_page(self) -> None:
        """Write the page from the existing results."""
        results, grids = self.results(), self.grids()
        extra = [arm.name for arm in grids[self.plan.best_of.grid].arms]
        text = page(read_claims(), results, read_tables(), extra)
        self.place.page.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self.place.page, text.encode())
        print(f"the page is in {self.place.page}", flush=True)
        for arm, folders in results.left_out.items():
            print(f"left out of {arm}: {len(folders)} runs that its grid does not ask for, such as "
                  f"{folders[0]}", file=sys.stderr)  # fmt: skip

    def tell(self) -> None:
        """Print the core hours of each grid, and the remaining core hours."""
        results, total = self.results(), 0.0
        tuning = {self.plan.tuning: self.source(self.plan.tuning)}
        for name, grid in {**tuning, **{n: self.source(n) for n in self.names}}.items():
            runs, seconds, left = self._cost(name, grid, results)
            total += left
            print(
                f"{name:16} {runs:4} runs {seconds / 3600:6.2f} core hours, {left / 3600:6.2f} left"
            )
        cores, hours = self.given.workers or len(available_cores()), total / 3600
        print(f"left: about {hours:.1f} core hours, {hours / cores:.1f} h on {cores} cores")

    def _cost(self, name: str, grid: Grid, results: Results) -> tuple[int, float, float]:
        """Return the number of a grid's runs, their seconds, and the remaining seconds."""
        cells = len(grid.scenes) * len(grid.seeds)
        count = BEST if name == self.plan.best_of.grid else 1
        runs, seconds, left = 0, 0.0, 0.0
        for choice in choices(grid):
            each = run_seconds({**grid.base, **choice.arm.settings})
            done = len(results.runs.get(choice.label, ()))
            runs, seconds = runs + count * cells, seconds + count * cells * each
            left += (count * cells - done) * each
        if name == self.plan.tuning and runs:
            finished = len(find_runs(self.place.sweep(name) / "runs"))
            left = seconds * max(0, runs - finished) / runs
        elif name == self.plan.best_of.grid and runs:
            done = sum(len(by) for arm, by in results.runs.items() if results.grids[arm] == name)
            left = seconds * max(0, runs - done) / runs
        return runs, seconds, left


def own_rate(name: str, plan: Plan, factors: Mapping[str, object]) -> str:
    """Return the tuned arm whose learning-rate factors an arm uses."""
    return name if name in factors else plan.rates.get(name, plan.rates["default"])


def with_rates(grid: Grid, rates: Mapping[str, str], factors: Factors) -> Grid:
    """Return the grid with the learning-rate factors of tuned arms, by scene.

    Args:
        grid: A grid.
        rates: Arm of the grid -> the tuned arm whose factors it uses.
        factors: Tuned arm -> scene -> factor.

    Raises:
        UserError: A scene was not used for tuning.
    """
    arms = []
    for arm in grid.arms:
        own = factors[rates[arm.name]]
        by_scene = {}
        for scene in map(scene_name, grid.scenes):
            if scene not in own:
                raise UserError(
                    "the learning rates of a scene are not tuned",
                    where=scene,
                    expected=f"one of {', '.join(own)}",
                    todo="name the scene with --scene for all grids, the tuning included",
                )
            by_scene[scene] = {"rate_factor": own[scene], **arm.by_scene.get(scene, {})}
        arms.append(arm.model_copy(update={"by_scene": by_scene}))
    return grid.model_copy(update={"arms": tuple(arms)})


def with_methods(grid: Grid, methods: Sequence[Arm]) -> Grid:
    """Return the grid in which each arm is repeated for each method, named `BACKBONE, METHOD`."""
    arms = [
        Arm(
            name=f"{backbone.name}, {method.name}",
            settings={**_without_probes(method.settings), **backbone.settings},
        )
        for backbone in grid.arms
        for method in methods
    ]
    return grid.model_copy(update={"arms": tuple(arms)})


def _without_probes(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name != "observers"}


def rate_of(arm: Arm, methods: Sequence[Arm], plan: Plan) -> str:
    """Return the tuned arm whose learning-rate factors a method uses on another backbone."""
    backbone, _, name = arm.name.partition(", ")
    method = next(each for each in methods if each.name == name)
    if (like := plan.best_of.scaffold_like.get(backbone)) is not None:
        return like["one" if method.settings["views"] == 1 else "more"]
    if name in {"four random views", "one view, 2x stretched", "two random views"}:
        return name
    return plan.rates.get(name, plan.rates["default"])


def run_seconds(settings: Mapping[str, Any]) -> float:
    """Return the approximate core seconds of a run with these settings."""
    backbone = COSTS.get(str(settings.get("backbone")), 1.0)
    train = settings.get("seconds") or backbone * VIEW * float(settings["max_views"])
    return float(train) + BESIDES + (PROBES if "observers" in settings else 0.0)


def _as_mapping(grid: Grid) -> dict[str, Any]:
    return grid.model_dump(mode="json", exclude_defaults=True)


def _packed(sweep: Path, archive: Path) -> None:
    try:
        pack(sweep, archive)
    except UserError as error:  # No run has finished. The failures were already printed.
        print(error.what, file=sys.stderr)


def _call(arguments: Sequence[str]) -> int:
    """Run a crossgrad command in a separate process, which also receives Ctrl-C."""
    process = subprocess.Popen([*CROSSGRAD, *arguments])
    while True:
        try:
            code = process.wait()
        except KeyboardInterrupt:
            # Wait again, because the process first saves checkpoints of its runs.
            continue
        return exit_code(-code) if code < 0 else code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=("run", "page", "estimate"))
    parser.add_argument(
        "--only", type=lambda text: text.split(","), help="names of grids, separated by commas"
    )
    parser.add_argument("--scenes", type=Path, default=ROOT.parent / "shared" / "scenes",
                        help="folder that contains the scenes of the grids")  # fmt: skip
    parser.add_argument(
        "--scene", action="append", help="scene that replaces the scenes of the grids; repeatable"
    )
    parser.add_argument(
        "--seed",
        action="append",
        type=int,
        help="seed that replaces the seeds of the grids; repeatable",
    )
    parser.add_argument(
        "--set", action="append", help="KEY=VALUE: a setting of all runs; repeatable"
    )
    parser.add_argument("--workers", type=int, help="number of simultaneous runs")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "paper")
    parser.add_argument("--kept", type=Path, default=ROOT / "benchmarks" / "results" / "paper")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "results" / "paper.md")
    return parser


def main() -> int:
    """Run, write the page, or estimate. Return the exit code."""
    given = _parser().parse_args()
    paper = Paper(given)
    try:
        paper.check()
        if given.what == "run":
            return paper.run()
        paper.unpack()
        paper.write_page() if given.what == "page" else paper.tell()
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
