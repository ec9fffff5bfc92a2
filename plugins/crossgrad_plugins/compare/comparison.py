"""Everything that is said about a set of runs, as values: what is drawn, tabled and printed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from crossgrad_core.commands import UserError
from crossgrad_plugins.compare import contrasts as pairwise
from crossgrad_plugins.compare import frontier, ranking, targets
from crossgrad_plugins.compare.arms import Arm, arms_of, renamed
from crossgrad_plugins.compare.cells import Cells
from crossgrad_plugins.compare.checks.machines import comparable_costs
from crossgrad_plugins.compare.checks.metrics import quantities_of
from crossgrad_plugins.compare.checks.scenes import check_scenes, differing_regimes
from crossgrad_plugins.compare.contrasts import Contrast, Runs
from crossgrad_plugins.compare.cost import Cost
from crossgrad_plugins.compare.interpolate import is_inside, shared_amount, value_at
from crossgrad_plugins.compare.load_runs import RunRecord
from crossgrad_plugins.compare.options import Options
from crossgrad_plugins.compare.quantity import Quantity
from crossgrad_plugins.compare.ranking import Standing
from crossgrad_plugins.compare.run import Run

#: Where a contrast of the main table is taken.
END = "at the end"
OVERALL = "overall"
#: Up to so many arms every pair of them has a row in every table.
_FEW_ARMS = 3


@dataclass(frozen=True, eq=False)
class Comparison:
    """The result of a comparison.

    Attributes:
        arms: The arms in the order of their names.
        ranking: Their names from the best to the worst.
        baseline: The arm that the others are compared with, if one was named.
        quantities: What is compared, the main figure first.
        costs: What runs spend that can be compared.
        notes: What is not compared, and why.
        left_out: Folder -> why it is left out.
        cells: All runs by arm, scene, seed and length.
        main: The run that stands for an arm, a scene and a seed.
        standing: Arm -> scene -> the main figure at the end.
        noise: Scene -> standard deviation over seeds, and its degrees of freedom.
        ends: Contrasts at the ends of the runs.
        equal: Contrasts at equal costs, of costs that differ at the ends of the runs.
        amounts: Name of a cost and scene -> where it is equal.
        regimes: Contrasts overall and by regime, at the ends.
        others: Contrasts of the other figures, at the ends.
        reached: How soon a quality is reached, for each cost.
        points: Final quality over length.
        gains: What longer runs gain within each arm; none with one length.
    """

    arms: tuple[Arm, ...]
    ranking: tuple[str, ...]
    baseline: str | None
    quantities: tuple[Quantity, ...]
    costs: tuple[Cost, ...]
    notes: tuple[str, ...]
    left_out: Mapping[str, str]
    cells: Cells
    main: Mapping[str, Runs]
    standing: Mapping[str, Mapping[str, Standing]]
    noise: Mapping[str, tuple[float, int]]
    ends: tuple[Contrast, ...]
    equal: tuple[Contrast, ...]
    amounts: Mapping[tuple[str, str], float]
    regimes: tuple[Contrast, ...]
    others: tuple[Contrast, ...]
    reached: tuple[targets.Reached, ...]
    points: tuple[frontier.Point, ...]
    gains: tuple[Contrast, ...]

    @property
    def quantity(self) -> Quantity:
        """The main figure."""
        return self.quantities[0]

    @property
    def scenes(self) -> tuple[str, ...]:
        """All scenes, sorted."""
        return tuple(sorted({scene for by in self.main.values() for scene, _ in by}))

    @property
    def runs(self) -> tuple[Run, ...]:
        """The runs that stand for an arm, a scene and a seed."""
        return tuple(run for by in self.main.values() for run in by.values())


def compared(found: RunRecord, options: Options) -> Comparison:
    """Compares runs.

    Raises:
        UserError: There is nothing to compare, or it does not compare, with the reason.
    """
    if not found.runs:
        raise UserError(
            "no run has finished",
            expected="at least one run with summary.json",
            found="; ".join(f"{name} {why}" for name, why in found.left_out.items()),
            todo="let a run come to its end, or resume it: crossgrad run --resume RUN",
        )
    notes = check_scenes(found.runs)
    quantities, about_figures = quantities_of(found.runs, options.metric, options.margin)
    costs, about_clocks = comparable_costs(found.runs, options.clock)
    arms = renamed(arms_of(found.runs, found.failed), options.name or ())
    _check_baseline(arms, options.baseline)
    cells = Cells.of(arms)
    main = cells.main()
    work = _Work(main, quantities, costs, options.baseline)
    return Comparison(
        arms=arms,
        ranking=work.ranking,
        baseline=options.baseline,
        quantities=quantities,
        costs=costs,
        notes=(*about_clocks, *about_figures, *notes, *_without(main, quantities[0])),
        left_out={**found.left_out, **_not_main(cells)},
        cells=cells,
        main=main,
        standing=work.standing,
        noise=ranking.noise(work.standing, main),
        ends=work.ends(),
        equal=work.equal(),
        amounts=work.amounts,
        regimes=work.regimes(differing_regimes(found.runs)),
        others=work.others(),
        reached=_reached(main, arms, quantities[0], costs, options.target),
        points=frontier.points(cells, quantities[0], costs),
        gains=frontier.gains(cells, quantities[0]),
    )


class _Work:
    """The contrasts between the arms."""

    def __init__(
        self,
        main: Mapping[str, Runs],
        quantities: Sequence[Quantity],
        costs: Sequence[Cost],
        baseline: str | None,
    ) -> None:
        self.main, self.quantities, self.costs = main, quantities, costs
        self.standing = ranking.standings(main, quantities[0])
        self.ranking = ranking.ranked(self.standing, quantities[0])
        self.couples = pairwise.couples(self.ranking, baseline)
        few = baseline is not None or len(self.ranking) <= _FEW_ARMS
        self.telling = self.couples if few else self.couples[: len(self.ranking) - 1]
        self.amounts = {
            (cost.name, scene): amount
            for cost in costs
            for scene in sorted({scene for by in main.values() for scene, _ in by})
            if (amount := shared_amount(self._on(scene), quantities[0], cost)) is not None
        }

    def ends(self) -> tuple[Contrast, ...]:
        """Each couple at the ends of its runs."""
        return pairwise.judged(self._at_end(c, self.quantities[0], None, END) for c in self.couples)

    def others(self) -> tuple[Contrast, ...]:
        """The telling couples by the other figures."""
        return pairwise.judged(
            self._at_end(c, quantity, None, END)
            for quantity in self.quantities[1:]
            for c in self.telling
        )

    def equal(self) -> tuple[Contrast, ...]:
        """The telling couples at equal costs, where that is not at the ends of all runs anyway."""
        found = [self._at_cost(couple, cost) for couple in self.telling for cost in self.costs]
        return pairwise.judged(each for each in found if each.inside)

    def regimes(self, unlike: Sequence[str]) -> tuple[Contrast, ...]:
        """The telling couples overall and by regime, on scenes whose runs agree on them."""
        names = {
            regime
            for by in self.main.values()
            for (scene, _), run in by.items()
            if scene not in unlike
            for regime in run.results.regimes
        }
        if len(names) < 2:  # noqa: PLR2004 - a single one would repeat `overall`
            return ()
        return pairwise.judged(
            self._at_end(couple, self.quantities[0], regime, regime or OVERALL, unlike)
            for couple in self.telling
            for regime in (None, *sorted(names))
        )

    def _on(self, scene: str) -> list[Run]:
        return [run for by in self.main.values() for (at, _), run in by.items() if at == scene]

    def _at_end(
        self,
        couple: tuple[str, str],
        quantity: Quantity,
        regime: str | None,
        where: str,
        without: Sequence[str] = (),
    ) -> Contrast:
        def reading(run: Run) -> float | None:
            return None if run.scene in without else run.final(quantity.name, regime)

        return pairwise.contrast(couple, self._pair(couple), quantity, reading, where)

    def _at_cost(self, couple: tuple[str, str], cost: Cost) -> Contrast:
        quantity, pair = self.quantities[0], self._pair(couple)

        def reading(run: Run) -> float | None:
            amount = self.amounts.get((cost.name, run.scene))
            return None if amount is None else value_at(run, quantity, cost, amount)

        found = pairwise.contrast(couple, pair, quantity, reading, cost.name)
        inside = any(
            is_inside(run, quantity, cost, amount)
            for runs in pair
            for run in runs.values()
            if (amount := self.amounts.get((cost.name, run.scene))) is not None
        )
        return replace(found, inside=inside)

    def _pair(self, couple: tuple[str, str]) -> tuple[Runs, Runs]:
        return self.main[couple[0]], self.main[couple[1]]


def _check_baseline(arms: Sequence[Arm], baseline: str | None) -> None:
    names = [arm.name for arm in arms]
    if baseline is not None and baseline not in names:
        raise UserError(
            "no arm has this name",
            where="--baseline",
            expected=f"one of {'; '.join(names)}",
            found=baseline,
            todo="copy a name from the table that compare prints without --baseline",
        )


def _without(main: Mapping[str, Runs], quantity: Quantity) -> list[str]:
    """Notes on runs that have no figure at their ends."""
    notes = []
    for run in {run.name: run for by in main.values() for run in by.values()}.values():
        if run.final(quantity.name) is None:
            held_out = run.number("overall", "views") != 0.0
            why = "not finite" if held_out else "no view is held out"
            notes.append(
                f"{run.name} has no {quantity.label} at its end ({why}): its pair is left out, and "
                "it never reaches a quality that it did not reach before"
            )
    return notes


def _not_main(cells: Cells) -> dict[str, str]:
    return {name: f"repeats {kept}" for name, kept in cells.repetitions.items()} | cells.unlike


def _reached(
    main: Mapping[str, Runs],
    arms: Sequence[Arm],
    quantity: Quantity,
    costs: Sequence[Cost],
    target: float | None,
) -> tuple[targets.Reached, ...]:
    goals = targets.targets_of(main, quantity, target)
    return tuple(
        row for cost in costs for row in targets.reached(main, arms, quantity, cost, goals)
    )
