"""The results of a comparison, for figures, tables and texts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from crossgrad_core.commands import UserError
from crossgrad_plugins.compare import contrasts as pairwise
from crossgrad_plugins.compare import frontier, ranking, targets
from crossgrad_plugins.compare.arms import Arm, Cells, arms_of, renamed
from crossgrad_plugins.compare.checks import (
    check_scenes,
    comparable_costs,
    differing_regimes,
    quantities_of,
)
from crossgrad_plugins.compare.contrasts import Contrast, Runs
from crossgrad_plugins.compare.load_runs import RunRecord
from crossgrad_plugins.compare.options import Options
from crossgrad_plugins.compare.quantity import Cost, Quantity
from crossgrad_plugins.compare.ranking import Standing
from crossgrad_plugins.compare.run import Run
from crossgrad_plugins.compare.targets import is_inside, shared_amount, value_at

#: The main table compares the runs at their ends.
END = "at the end"
OVERALL = "overall"
#: With at most this many arms, every table contains all pairs of arms.
_FEW_ARMS = 3


@dataclass(frozen=True, eq=False)
class Comparison:
    """Comparable runs and their results.

    Each result is computed when it is first used.

    Attributes:
        arms: The arms in the order of their names.
        baseline: The arm with which all other arms are compared; if None, all arms are compared
            with each other.
        quantities: The metrics that are compared, the main metric first.
        costs: The costs that can be compared.
        cells: All runs by arm, scene, seed and length.
        unlike: Scenes whose runs assign different regimes to the same held-out views.
        target: The quality to reach; None means the median final quality of the weakest arm on each
            scene.
        checked: Notes of the checks about results that are not compared, with the reasons.
        unused: Folder of an unfinished or unreadable run -> reason why the run is left out.
    """

    arms: tuple[Arm, ...]
    baseline: str | None
    quantities: tuple[Quantity, ...]
    costs: tuple[Cost, ...]
    cells: Cells
    unlike: tuple[str, ...]
    target: float | None
    checked: tuple[str, ...]
    unused: Mapping[str, str]

    @property
    def quantity(self) -> Quantity:
        """The main metric."""
        return self.quantities[0]

    @cached_property
    def main(self) -> Mapping[str, Runs]:
        """Arm -> scene and seed -> the run that represents this scene and seed."""
        return self.cells.main()

    @cached_property
    def scenes(self) -> tuple[str, ...]:
        """All scenes, sorted."""
        return tuple(sorted({scene for by in self.main.values() for scene, _ in by}))

    @cached_property
    def runs(self) -> tuple[Run, ...]:
        """The runs that represent an arm on a scene with a seed."""
        return tuple(run for by in self.main.values() for run in by.values())

    @cached_property
    def standing(self) -> Mapping[str, Mapping[str, Standing]]:
        """Arm -> scene -> the main metric at the ends of the runs."""
        return ranking.standings(self.main, self.quantity)

    @cached_property
    def ranking(self) -> tuple[str, ...]:
        """The names of the arms from the best to the worst."""
        return ranking.ranked(self.standing, self.quantity)

    @cached_property
    def noise(self) -> Mapping[str, tuple[float, int]]:
        """Scene -> standard deviation over seeds, and its degrees of freedom."""
        return ranking.noise(self.standing, self.main)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Notes on metrics and costs that are not compared, with the reason."""
        return (*self.checked, *_without(self.main, self.quantity))

    @cached_property
    def left_out(self) -> Mapping[str, str]:
        """Folder -> reason why the folder is left out."""
        repeated = {name: f"repeats {kept}" for name, kept in self.cells.repetitions.items()}
        return {**self.unused, **repeated, **self.cells.unlike}

    @cached_property
    def ends(self) -> tuple[Contrast, ...]:
        """The contrast of each pair of arms at the ends of their runs."""
        couples = pairwise.couples(self.ranking, self.baseline)
        return pairwise.judged(self._at_end(couple, self.quantity) for couple in couples)

    @cached_property
    def others(self) -> tuple[Contrast, ...]:
        """The contrasts of the compared pairs of arms, for all metrics except the main metric."""
        return pairwise.judged(
            self._at_end(couple, quantity)
            for quantity in self.quantities[1:]
            for couple in self._telling
        )

    @cached_property
    def equal(self) -> tuple[Contrast, ...]:
        """The contrasts of the compared pairs at equal cost, if the final costs differ."""
        contrasts = [self._at_cost(couple, cost) for couple in self._telling for cost in self.costs]
        return pairwise.judged(contrast for contrast in contrasts if contrast.inside)

    @cached_property
    def amounts(self) -> Mapping[tuple[str, str], float]:
        """Cost name and scene -> the smallest final cost of all runs on that scene."""
        return {
            (cost.name, scene): amount
            for cost in self.costs
            for scene in self.scenes
            if (amount := shared_amount(self._on(scene), self.quantity, cost)) is not None
        }

    @cached_property
    def regimes(self) -> tuple[Contrast, ...]:
        """The contrasts of the compared pairs, overall and by regime.

        Scenes without agreed regimes are left out.
        """
        regime_lists = (run.results.regimes for run in self.runs if run.scene not in self.unlike)
        names = sorted({regime for regimes in regime_lists for regime in regimes})
        if len(names) < 2:  # noqa: PLR2004 - a single regime would repeat `overall`
            return ()
        return pairwise.judged(
            self._at_end(couple, self.quantity, regime or OVERALL, regime, self.unlike)
            for couple in self._telling
            for regime in (None, *names)
        )

    @cached_property
    def reached(self) -> tuple[targets.Reached, ...]:
        """The cost at which each arm reaches a quality, for each cost."""
        goals = targets.targets_of(self.main, self.quantity, self.target)
        return tuple(
            row
            for cost in self.costs
            for row in targets.reached(self.main, self.arms, self.quantity, cost, goals)
        )

    @cached_property
    def points(self) -> tuple[frontier.Point, ...]:
        """The final quality of runs by length."""
        return frontier.points(self.cells, self.quantity, self.costs)

    @cached_property
    def gains(self) -> tuple[Contrast, ...]:
        """The gains of longer runs within each arm; empty if all runs have one length."""
        return frontier.gains(self.cells, self.quantity)

    @cached_property
    def _telling(self) -> list[tuple[str, str]]:
        """The pairs of arms that every table contains.

        If there are many arms, only pairs with the best arm are contained.
        """
        couples = pairwise.couples(self.ranking, self.baseline)
        few = self.baseline is not None or len(self.arms) <= _FEW_ARMS
        return couples if few else couples[: len(self.arms) - 1]

    def _on(self, scene: str) -> list[Run]:
        return [run for run in self.runs if run.scene == scene]

    def _at_end(
        self,
        couple: tuple[str, str],
        quantity: Quantity,
        where: str = END,
        regime: str | None = None,
        without: Sequence[str] = (),
    ) -> Contrast:
        def reading(run: Run) -> float | None:
            return None if run.scene in without else run.final(quantity.name, regime)

        return pairwise.contrast(couple, self._pair(couple), quantity, reading, where)

    def _at_cost(self, couple: tuple[str, str], cost: Cost) -> Contrast:
        quantity, pair = self.quantity, self._pair(couple)

        def reading(run: Run) -> float | None:
            amount = self.amounts.get((cost.name, run.scene))
            return None if amount is None else value_at(run, quantity, cost, amount)

        inside = any(
            is_inside(run, quantity, cost, amount)
            for runs in pair
            for run in runs.values()
            if (amount := self.amounts.get((cost.name, run.scene))) is not None
        )
        contrast = pairwise.contrast(couple, pair, quantity, reading, cost.name)
        return replace(contrast, inside=inside)

    def _pair(self, couple: tuple[str, str]) -> tuple[Runs, Runs]:
        return self.main[couple[0]], self.main[couple[1]]


def compared(found: RunRecord, options: Options) -> Comparison:
    """Check runs and compare them.

    Raises:
        UserError: No run has finished, or the runs are not comparable; the message gives the
            reason.
    """
    if not found.runs:
        raise UserError(
            "no run has finished",
            expected="at least one run with summary.json",
            found="; ".join(f"{name} {why}" for name, why in found.left_out.items()),
            todo="wait until a run has finished, or resume it: crossgrad run --resume RUN",
        )
    notes = check_scenes(found.runs)
    quantities, about_figures = quantities_of(found.runs, options.metric, options.margin)
    costs, about_clocks = comparable_costs(found.runs, options.clock)
    arms = renamed(arms_of(found.runs, found.failed), options.name or ())
    _check_baseline(arms, options.baseline)
    return Comparison(
        arms=arms,
        baseline=options.baseline,
        quantities=quantities,
        costs=costs,
        cells=Cells.of(arms),
        unlike=differing_regimes(found.runs),
        target=options.target,
        checked=(*about_clocks, *about_figures, *notes),
        unused=found.left_out,
    )


def _check_baseline(arms: Sequence[Arm], baseline: str | None) -> None:
    names = [arm.name for arm in arms]
    if baseline is not None and baseline not in names:
        raise UserError(
            "--baseline names an arm that does not exist",
            where="--baseline",
            expected=f"one of {'; '.join(names)}",
            found=baseline,
            todo="copy a name from the table that compare prints without --baseline",
        )


def _without(main: Mapping[str, Runs], quantity: Quantity) -> list[str]:
    """Return notes about runs that have no metric value at their ends."""
    notes = []
    for run in {run.name: run for by in main.values() for run in by.values()}.values():
        if run.final(quantity.name) is None:
            held_out = run.number("overall", "views") != 0.0
            why = "not finite" if held_out else "no view is held out"
            notes.append(
                f"{run.name} has no {quantity.label} at its end ({why}): its pair is left "
                "out, and it counts as never reaching a quality that it had not reached "
                "before"
            )
    return notes
