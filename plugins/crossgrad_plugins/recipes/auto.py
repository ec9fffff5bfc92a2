"""Recipe `auto`: the best measured settings for the length and the device of a run."""

from functools import cached_property
from typing import Final, Literal

from typing_extensions import override

from crossgrad_core.plugin import REFERENCE, Decision, Densifier, Facts, Recipe, shortness
from crossgrad_plugins.recipes import budget

#: Decay rates of Adam's two moments in the published code.
BETA1, BETA2 = 0.9, 0.999
#: The components of long runs (keys), and the components that replace them in short runs (values).
DENSIFIER, SHORT_DENSIFIER = "adc", "absgrad"
RESOLUTION, SHORT_RESOLUTION = "full", "strided"
INITIALIZER, POINTS_ONLY, EXPOSURE = "fill-gaps", "points", "auto"
#: A short run uses absolute-gradient densification only if it has at least this many training
#: photos. With fewer photos, absolute-gradient densification overfits.
MANY_PHOTOS: Final = 100

#: The published learning rates are for `REFERENCE` steps. A shorter run multiplies them by the
#: ratio `REFERENCE` / steps to this power. The power is below 1, so a shorter run still has a
#: smaller sum of learning rates.
SHORTNESS: Final = 0.45
#: Largest factor of the learning rates. It is reached by runs of about 1,000 steps.
MOST: Final = 4.5
#: A run has few passes if it renders each training photo fewer than 40 times on average. Such a run
#: ends long before it overfits.
FEW_PASSES: Final = 40
#: Power and largest factor of the learning rates in runs with few passes.
FEW_PASSES_SHORTNESS, FEW_PASSES_MOST = 0.65, 6.3
#: In a run with few passes, Adam's second moment averages over this share of the steps, and over at
#: least `LEAST_MEMORY` steps. The first gradients are much larger than later gradients. With the
#: published decay rate, these first gradients would slow down training for 1,000 steps.
MEMORY, LEAST_MEMORY = 1 / 50, 50
#: Decay of the first moment in short runs. The first moment then averages over 3 steps instead of
#: 10.
SHORT_BETA1: Final = 0.7
#: Maximum standard deviation of a Gaussian, as a share of the distance to a camera. The camera is
#: the nearest one whose photo does not show the Gaussian.
SCALE_RATIO: Final = 0.5
#: SH bands above the first are rendered only after this share of a short run with few passes.
#: Earlier in the run, these bands cost time and hardly improve the result.
SH_START: Final = 0.5
#: Highest SH degree.
MOST_DEGREES: Final = 3
#: Learning rates that are otherwise constant decay in this last share of the run.
LR_TAIL: Final = 0.25
#: Share of the Gaussians that dropout leaves out of a render. Dropout is used if half of the SfM
#: points are observed by at most `FEW_PHOTOS` photos.
DROPOUT, FEW_PHOTOS = 0.3, 5
#: Minimum number of density-control edits of a run with budgeted growth. The minimum applies to
#: runs of at least `SHORTEST_RUN_WITH_EDITS` views. In shorter runs, new Gaussians have no time to
#: converge, and late edits can cost 1 dB.
EDITS, SHORTEST_RUN_WITH_EDITS = 6, 600
#: Text in the table of decisions while the length of the run is not yet planned.
UNKNOWN: Final = "decided when the length is planned"
#: Documentation page with the measurements of these values.
SCHEDULES: Final = "docs/schedules.md"


class Auto(Recipe):
    """Uses the best measured settings for the length and the device of the run."""

    @override
    def decide(self, facts: Facts) -> list[Decision]:
        choice = Choice(facts)
        return [
            *components(choice),
            *growth(choice),
            *rates(choice),
            *steps(choice),
            *ends(choice),
            *facts.intervals(),
        ]


class Choice:
    """Values that several decisions use. Each value is computed only once.

    Args:
        facts: The facts about the run.
    """

    def __init__(self, facts: Facts) -> None:
        self.facts = facts
        self.given = facts.given

    @cached_property
    def is_plain(self) -> bool:
        """True if the backbone's Gaussians have separate axes and are rendered as in plain 3DGS."""
        backbone = self.facts.backbone
        return bool(backbone.axes) and backbone.response == "plain"

    @cached_property
    def few_passes(self) -> bool:
        """True if the run renders each training photo only a few times."""
        views = self.facts.views
        if views is None or "beta2" in self.given:
            return False
        return views < min(REFERENCE, FEW_PASSES * self.facts.photos)

    @cached_property
    def densifier_name(self) -> str:
        """Name of the densifier."""
        named = self.given.get("densifier")
        return self._default_densifier if named is None else str(named.name)

    @cached_property
    def _default_densifier(self) -> str:
        facts = self.facts
        default = facts.backbone.default_densifier
        suits = default == DENSIFIER and self.is_plain and facts.photos >= MANY_PHOTOS
        here = suits and facts.short and facts.device == "cpu"
        if not here or self.default_growth(budgeted=True) == "unbounded":
            return default
        needs = facts.densifier(SHORT_DENSIFIER).needs
        return SHORT_DENSIFIER if needs <= facts.provides else default

    @cached_property
    def densifier(self) -> Densifier:
        """The densifier."""
        return self.facts.densifier(self.densifier_name)

    def default_growth(self, *, budgeted: bool) -> Literal["unbounded", "budget"]:
        """Return the growth mode for any length: the user's choice, or the densifier's default."""
        given: Literal["unbounded", "budget"] | None = self.given.get("growth")
        if given is not None:
            return given
        # If the user sets `max_gaussians`, the number is only a limit, and growth does not aim at
        # it.
        named = self.given["max_gaussians"] not in {None, "auto"}
        led = budgeted and self.facts.unit == "views"
        return "budget" if led and not named else "unbounded"

    @cached_property
    def length(self) -> int:
        """Length of the schedule, in steps or views (the schedule's unit)."""
        return self.facts.schedule(self.facts.unit).length

    @cached_property
    def growth(self) -> Literal["unbounded", "budget"]:
        """The growth mode of this run; a run of the published length has no budget."""
        default = self.default_growth(budgeted=self.densifier.budgeted)
        return default if self.length < REFERENCE or "growth" in self.given else "unbounded"

    @cached_property
    def led(self) -> bool:
        """True if growth follows the budget for the length of the run."""
        return self.growth == "budget" and self.length < REFERENCE


def components(choice: Choice) -> list[Decision]:
    """Return the decisions about the components of the run."""
    facts, name = choice.facts, choice.densifier_name
    default = facts.backbone.default_densifier
    swapped = name != default
    budgeted = choice.densifier.budgeted
    led = not choice.densifier.edits or choice.default_growth(budgeted=budgeted) == "budget"
    first = led and choice.is_plain and facts.device == "cpu" and facts.short
    start = INITIALIZER if facts.own_points else POINTS_ONLY
    return [
        Decision(
            "views_per_step",
            facts.views_per_step.setting,
            facts.views_because or "default of the sampler",
            override="--views K" if facts.views_because else "",
        ),
        Decision(
            "densifier",
            name,
            f"short run with at least {MANY_PHOTOS} photos"
            if swapped
            else "default of the backbone",
            f"{facts.photos} training photos; {SCHEDULES}",
            f"--densifier {default}" if swapped else "",
        ),
        Decision(
            "resolution",
            SHORT_RESOLUTION if first else RESOLUTION,
            "pixels take most of the time of a step on a CPU"
            if first
            else "all pixels in every step",
            "docs/resolutions.md",
            f"--resolution {RESOLUTION}" if first else "",
        ),
        Decision(
            "initializer",
            start,
            "adds points in areas with few points" if facts.own_points else "the points of --init",
            "docs/initializers.md",
        ),
        Decision("exposure", EXPOSURE, "depends on the photos", "docs/exposure.md"),
        _dropout(facts),
    ]


def _dropout(facts: Facts) -> Decision:
    photos = facts.photos_per_point
    few = 0.0 < photos <= FEW_PHOTOS
    return Decision(
        "rules.dropout",
        few and {"share": DROPOUT},
        "few photos show each point" if few else "enough photos show each point",
        f"a point is visible in {photos:g} of {facts.photos} photos (median); docs/few-photos.md",
        "--no-rule dropout" if few else "",
    )


def growth(choice: Choice) -> list[Decision]:
    """Return the decisions about density control."""
    facts, led = choice.facts, choice.led
    schedule = facts.schedule(facts.unit)
    default = choice.default_growth(budgeted=choice.densifier.budgeted)
    long = (
        facts.unit == "views" and not facts.published and choice.length >= SHORTEST_RUN_WITH_EDITS
    )
    edits = EDITS if default == "budget" and long else 0
    resets = 0 if led else choice.densifier.window(schedule).reset_every or 0
    rows = [
        Decision("schedule_unit", facts.unit, "published numbers" if facts.published else "any K"),
        Decision(
            "growth",
            choice.growth,
            "suits the length of the run" if led else "as density control requests",
            "Taming 3DGS; " + SCHEDULES,
            "--growth unbounded" if led else "",
        ),
        _budget(choice),
        Decision(
            "min_refinements",
            edits,
            "the budget schedule needs some edits"
            if edits
            else "the number of edits in the schedule",
            SCHEDULES,
        ),
        Decision(
            "reset_every",
            resets,
            "the budget schedule already limits growth" if led else "as published",
            SCHEDULES,
            f"--set reset_every={schedule.reset_every or 3000}" if led else "",
        ),
    ]
    if "division" in type(choice.densifier).model_fields:
        why = "a split of the longest axis leaves no gap" if led else "as published"
        division, force = ("axis", "--set densifier.division=drawn") if led else ("drawn", "")
        rows.append(Decision("densifier.division", division, why, SCHEDULES, force))
    return rows


def _budget(choice: Choice) -> Decision:
    facts = choice.facts
    asked = choice.given["max_gaussians"] == "auto"
    if choice.growth == "unbounded" and not asked:
        return Decision("max_gaussians", 0, "growth is unbounded", SCHEDULES)
    most: int | str = "auto"
    if facts.start is not None:
        most = budget.budget(facts.start, choice.length, facts.pixels, few_passes=choice.few_passes)
    return Decision(
        "max_gaussians",
        most,
        "a number that suits the length" if most else "no limit at the published length",
        f"{facts.start} Gaussians at the start, photos of "
        f"{facts.pixels / 1000000.0:.2f} MP; {SCHEDULES}",
        "--max-gaussians N",
    )


def rates(choice: Choice) -> list[Decision]:
    """Return the decisions about learning rates and Adam."""
    if choice.facts.steps is None:
        values = {"rate_factor": 1.0, "few_pass_rates": False, "beta1": BETA1, "beta2": BETA2}
        return [Decision(name, value, UNKNOWN, SCHEDULES) for name, value in values.items()]
    factor, few_passes = _rate_factor(choice), choice.few_passes
    per_block = few_passes and "rate_factor" not in choice.given
    beta1, beta2 = _beta1(choice), _beta2(choice)
    few = f"fewer than {FEW_PASSES} views of each photo"
    return [
        Decision(
            "rate_factor",
            factor,
            f"published learning rates are for {REFERENCE:,} steps",
            SCHEDULES,
            "--rate-factor 1" if factor != 1.0 else "",
        ),
        Decision(
            "few_pass_rates",
            per_block,
            few if per_block else "one factor for all blocks",
            SCHEDULES,
            "--set few_pass_rates=false" if per_block else "",
        ),
        Decision(
            "beta1",
            beta1,
            "short runs average over fewer steps" if beta1 != BETA1 else "as published",
            SCHEDULES,
            f"--set beta1={BETA1}" if f"{beta1:.3g}" != f"{BETA1:.3g}" else "",
        ),
        Decision(
            "beta2",
            beta2,
            few if few_passes else "as published",
            SCHEDULES,
            f"--set beta2={BETA2}" if f"{beta2:.3g}" != f"{BETA2:.3g}" else "",
        ),
    ]


def _rate_factor(choice: Choice) -> float:
    facts = choice.facts
    schedule = facts.schedule(facts.unit)
    steps = facts.total if facts.mode == "scaled" else schedule.step_of(schedule.length)
    if schedule.pace.views(steps) >= REFERENCE:
        return 1.0
    power, most = (
        (FEW_PASSES_SHORTNESS, FEW_PASSES_MOST) if choice.few_passes else (SHORTNESS, MOST)
    )
    return min(max(1.0, float((REFERENCE / steps) ** power)), most)


def _beta1(choice: Choice) -> float:
    """Return the decay of Adam's first moment; batch rules and anchors use the published value."""
    facts = choice.facts
    if facts.views is None or facts.batched or not facts.backbone.axes:
        return BETA1
    return BETA1 - (BETA1 - SHORT_BETA1) * shortness(facts.views)


def _beta2(choice: Choice) -> float:
    facts = choice.facts
    if not choice.few_passes or facts.steps is None or facts.views is None:
        return BETA2
    memory = max(LEAST_MEMORY, MEMORY * facts.steps)
    if facts.batched:
        # With K views per step, a run has 1/K as many steps, so Adam must average over 1/K as many
        # steps.
        memory *= facts.views / facts.steps
    return min(BETA2, 1.0 - 1.0 / memory)


def steps(choice: Choice) -> list[Decision]:
    """Return the decisions about the updates of the parameters in a step."""
    facts, short = choice.facts, choice.facts.short
    along = short and facts.backbone.gaussian_tensors is not None
    bounded = short and facts.backbone.learns_scales
    share = _sh_start(choice)
    banded = any(block.rests for block in facts.backbone.trained_blocks())
    late = share > 0.0 and banded and facts.given.get("sh_from") != MOST_DEGREES
    return [
        Decision("step_order", "optimize-first", "density control uses the updated values"),
        Decision(
            "position_lr",
            "per-axis" if along else "extent",
            "short runs use the size of a Gaussian as the step size" if along else "as published",
            SCHEDULES,
            "--position-lr extent" if along else "",
        ),
        Decision(
            "rules.scale-clamp",
            bounded and {"ratio": SCALE_RATIO},
            "large Gaussians near a camera hide the scene" if bounded else "as published",
            "docs/floaters.md",
            "--no-rule scale-clamp" if bounded else "",
        ),
        Decision(
            "sh_start",
            share,
            "SH bands gain little before this share" if late else "degree by degree from the start",
            SCHEDULES,
            "--set sh_start=0" if late else "",
        ),
    ]


def _sh_start(choice: Choice) -> float:
    """Return the share of the run before the SH degree grows.

    It corresponds to a whole number of views.
    """
    facts = choice.facts
    if not choice.few_passes or facts.unit != "views" or facts.published:
        return 0.0
    schedule = facts.schedule(facts.unit)
    # A learning-rate schedule that the user sets may be longer than the run.
    length = min(schedule.length, schedule.counted(schedule.total))
    return int(SH_START * shortness(schedule.length) * length) / length


def ends(choice: Choice) -> list[Decision]:
    """Return the decisions about the end of a run: learning-rate tail, averaging and floaters."""
    edits = choice.densifier.edits
    fades = any(not block.lr.decays for block in choice.facts.backbone.trained_blocks())
    return [
        Decision(
            "rules.lr-tail",
            fades and {"share": LR_TAIL},
            "constant learning rates decay at the end"
            if fades
            else "all learning rates already decay",
            "docs/steady-ends.md",
            "--no-rule lr-tail" if fades else "",
        ),
        Decision(
            "rules.floaters",
            {} if edits else False,
            "floaters that no photo shows hide the scene" if edits else "the Gaussians stay",
            "docs/floaters.md",
            "--no-rule floaters" if edits else "",
        ),
    ]
