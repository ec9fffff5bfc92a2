"""The command `crossgrad sweep`, from the grid to the summary."""

import signal
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from crossgrad_core.commands import (
    FAILED,
    LOCK,
    UserError,
    check_file,
    check_folder,
    clear_half_written,
    count,
    exit_code,
    finish,
    is_leftover,
    listed,
    locked,
    one_line,
    signal_names,
    tell,
    write_mapping,
    writer_of,
)
from crossgrad_plugins.sweep.best import best_grid
from crossgrad_plugins.sweep.engines import Stop, Work, check_options, engine
from crossgrad_plugins.sweep.grid import Grid, check_assignments, read_grid, with_scenes
from crossgrad_plugins.sweep.job import Layout
from crossgrad_plugins.sweep.machine import Machine, divided
from crossgrad_plugins.sweep.plan import planned
from crossgrad_plugins.sweep.progress import Screen, Watch, estimated
from crossgrad_plugins.sweep.run_status import Standing, read_records, standings
from crossgrad_plugins.sweep.summary import listing, table, write_plan

_WORDS = "stopping: running runs save a checkpoint first (press again to skip their evaluation)"


@contextmanager
def noted(stop: Stop) -> Iterator[list[int]]:
    """Collect the stop signals that arrive inside the `with` block.

    Yields:
        The numbers of the received signals, in a list that grows while the block runs.
    """
    came: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        came.append(number)
        stop.count += 1
        if stop.count == 1:
            tell(_WORDS)

    before = {number: signal.signal(number, note) for number in signal_names()}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


#: Default folder for sweeps, inside the current folder.
SWEEPS = Path("runs/sweeps")


@dataclass(frozen=True)
class Request:
    """The options of the command.

    Attributes:
        path: The grid file.
        out: Folder of the sweep.
        scenes: Scenes that replace those of the grid.
        seeds: Seeds that replace those of the grid.
        assignments: Texts `KEY=VALUE` that override the grid.
        workers: Number of runs at the same time.
        threads: Number of threads per run.
        memory: Maximum memory of a run, GiB.
        engine: Name of the engine that starts the runs.
        options: Options of the engine, as given by the user.
    """

    path: Path
    out: Path | None = None
    scenes: Sequence[Path] = ()
    seeds: Sequence[int] = ()
    assignments: Sequence[str] = ()
    workers: int | None = None
    threads: int = 1
    memory: float | None = None
    engine: str = "local"
    options: Sequence[tuple[str, str]] = ()


class Sweep:
    """A sweep: its runs and its folder.

    Args:
        request: The options of the command.
        read_only: True if no run will be started.

    Raises:
        UserError: The grid is invalid, this machine is too small, or another sweep is active in the
            folder.
    """

    def __init__(self, request: Request, *, read_only: bool = False) -> None:
        self.request = request
        check_options(request.engine, (key for key, _ in request.options))
        grid = _grid(request)
        self.layout = Layout((request.out or SWEEPS / (grid.name or request.path.stem)).absolute())
        if (
            not read_only
            # Check the lock before planning, because planning takes time. The lock is acquired
            # later.
        ):
            _refuse_a_second(self.layout.out)
            _refuse_what_is_no_sweep(self.layout)
        self.plan = planned(grid, request.path, request.assignments)
        finish()
        self.machine: Machine | None = None
        if request.engine == "local":
            self.machine = divided(request.workers, request.threads, request.memory)

    @property
    def at_a_time(self) -> int:
        """The number of runs at the same time; 1 if it is unknown."""
        return len(self.machine.cores) if self.machine else self.request.workers or 1

    def standings(self, *, alive: bool) -> tuple[Standing, ...]:
        """Return the state of each run; `alive` is True if a sweep process works in the folder."""
        return standings(
            self.plan.jobs, self.layout, read_records(self.layout.records), alive=alive
        )

    def tell(self) -> int:
        """Print the state of each run, and the table of finished runs."""
        states = self.standings(alive=writer_of(self.layout.out) is not None)
        _say(listing(self.plan.cells, states))
        _say(["", *table(self.plan.cells, states, self.plan.grid.metric)])
        return 0

    def foretell(self) -> int:
        """Print the runs that would be started, and their estimated time."""
        states = self.standings(alive=writer_of(self.layout.out) is not None)
        left = [standing for standing in states if standing.state != "finished"]
        ids = {standing.job.id for standing in left}
        _say(listing([cell for cell in self.plan.cells if cell.id in ids], states))
        _say([self._forecast(left)])
        if self.request.engine == "slurm":
            from crossgrad_plugins.sweep.engines.slurm import script

            _say(["", *script(self._work(states)).splitlines()])
        return 0

    def write_best(self, path: Path) -> int:
        """Write a grid with the best parameters of each arm and scene, for new seeds.

        Raises:
            UserError: The best parameters are not known yet, or the file exists, or the file cannot
                be written.
        """
        check_file(path)
        if path.exists():
            raise UserError(
                "the output file already exists",
                where=path,
                todo="choose another name, or remove the file",
            )
        states = self.standings(alive=writer_of(self.layout.out) is not None)
        content, notes = best_grid(self.plan.grid, self.plan.cells, states, path.parent)
        write_mapping(path, content)
        _say([*notes, f"the grid with the best parameters is in {path}"])
        return 0

    def carry_out(self) -> int:
        """Start all runs that are not finished, and wait for their ends.

        Returns:
            The exit code: 0 if all runs are finished, 1 if a run failed, or 128 plus the number of
                the signal that stopped the sweep.

        Raises:
            UserError: Another sweep is active in the folder, or the folder is not writable.
        """
        check_folder(self.layout.out)
        self.layout.make()
        with locked(self.layout.out, "sweeping") as held:
            if not held:
                _note(
                    "the file system does not support locks: nothing prevents a second sweep in "
                    "the folder"
                )
            for folder in (self.layout.out, self.layout.out / "settings"):
                clear_half_written(folder)
            write_plan(self.layout, self.plan.cells)
            states = self.standings(alive=False)
            _note(self._forecast([standing for standing in states if standing.state != "finished"]))
            signals = self._watched(states)
        return self._result(signals)

    def _watched(self, before: Sequence[Standing]) -> list[int]:
        """Start the remaining runs and show their progress; return the received signals."""
        screen = Screen(Watch(self.layout, before), self.at_a_time)
        work = self._work(before)
        with noted(work.stop) as signals:
            for _ in engine(self.request.engine)(work):
                screen.show()
            screen.close()
        return signals

    def _work(self, before: Sequence[Standing]) -> Work:
        """Return the arguments for the engine."""
        request = self.request
        return Work(
            jobs=[standing.job for standing in before if standing.state != "finished"],
            out=self.layout.out,
            folder=request.path.resolve().parent,
            threads=request.threads,
            workers=request.workers,
            memory=request.memory,
            options=dict(request.options),
            machine=self.machine,
        )

    def _result(self, signals: Sequence[int]) -> int:
        """Print the results and the failed runs; return the exit code."""
        states = self.standings(alive=False)
        _say(table(self.plan.cells, states, self.plan.grid.metric))
        failed = [standing for standing in states if standing.state == "failed"]
        left = [standing for standing in states if standing.state not in {"finished", "failed"}]
        done = len(states) - len(failed) - len(left)
        _say([f"{done} of {count(len(states), 'run')} finished, results in {self.layout.out}"])
        _say(
            f"failed: {standing.job.title} ({standing.job.id}): {standing.error}"
            for standing in failed
        )
        if left:
            are, them = ("is", "it") if len(left) == 1 else ("are", "them")
            runs = f"{count(len(left), 'run')} {are} left"
            _say([f"{runs}; run the same command to continue with {them}"])
        if failed:
            _say([(f"their output is in {self.layout.output('ID')}; run the same command to try "
"them again")])  # fmt: skip
        if signals:
            return exit_code(signals[0])
        return FAILED if failed or left else 0

    def _forecast(self, left: Sequence[Standing]) -> str:
        jobs = {job.id: job for job in self.plan.jobs}
        time = estimated(
            [standing.job for standing in left], jobs, read_records(self.layout.records)
        )
        return (
            f"{count(len(jobs), 'run')}, {len(jobs) - len(left)} finished, {len(left)} to do, "
            f"{self.at_a_time} at a time: {time.text(self.at_a_time)}"
        )


def _grid(request: Request) -> Grid:
    """Read the grid, and replace its scenes and seeds if the user requested it."""
    grid = read_grid(request.path)
    check_assignments(request.assignments)
    if request.scenes:
        grid = with_scenes(grid, request.scenes)
    if len(set(request.seeds)) < len(request.seeds):
        raise UserError(
            "a seed is listed twice",
            where="--seed",
            found=listed(map(str, request.seeds)),
            todo="list each seed once",
        )
    return grid.model_copy(update={"seeds": tuple(request.seeds)}) if request.seeds else grid


def _refuse_a_second(out: Path) -> None:
    if writer := writer_of(out):
        raise UserError(
            "another sweep is running in this folder",
            where=out,
            found=writer,
            todo="wait until it ends, stop it, or choose another --out; --list shows its progress",
        )


def _refuse_what_is_no_sweep(layout: Layout) -> None:
    out = layout.out
    if not out.is_dir():
        return
    check_folder(out)
    there = {e.name for e in out.iterdir() if e.name != LOCK and not is_leftover(e)}
    if there and not there & {"settings", "output", "workers", layout.plan.name}:
        raise UserError(
            "the folder contains files that do not belong to a sweep",
            where=out,
            expected="a new or empty folder, or the folder of a sweep",
            found=listed(sorted(there)[:4]),
            todo="choose another --out",
        )


def _note(line: str) -> None:
    print(one_line(line), file=sys.stderr)  # noqa: T201


def _say(lines: Iterable[str]) -> None:
    for line in lines:
        print(one_line(line))  # noqa: T201 - print the result of the command
