"""The configuration of a run: one schema for command line, file and results."""

from collections.abc import Container, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeInt,
    PositiveInt,
    field_validator,
    model_validator,
)

from crossgrad_core import defaults
from crossgrad_core.contract.flags import CONFIGURATION, MACHINE, PARTS, RESULTS, TRAINING, Flag
from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.contract.schedule import ScheduleMode, Unit, ViewsPerStepSpec

#: Value of a setting that the run chooses at its start.
AUTO: Final = "auto"
#: Settings of a run that do not change its training.
CHANGEABLE: Final = frozenset({"device", "threads", "stop_after"})
#: Growth of primitives: as density control requests, or by a budget for the length of the run.
Growth: TypeAlias = Literal["unbounded", "budget"]


#: Old name of a setting -> its present name.
_RENAMED: Final = {"views": "views_per_step"}


def current_name(setting: str, beside: Container[str] = ()) -> str:
    """Return the present name of a setting; if `beside` contains that name, keep the old name."""
    new = _RENAMED.get(setting, setting)
    return setting if new in beside else new


class ComponentChoice(BaseModel):
    """A component by name with its options; the component itself validates the options."""

    model_config = ConfigDict(frozen=True, extra="allow")

    name: str

    @model_validator(mode="before")
    @classmethod
    def _choice(cls, value: object) -> object:
        if isinstance(value, Mapping | ComponentChoice):
            return value
        raise ValueError("must be the name of a component, or a mapping with its name and options")

    @property
    def options(self) -> dict[str, Any]:
        """The options as given."""
        return dict(self.model_extra or {})


class RunConfig(BaseModel):
    """All settings that determine a run.

    `None` leaves a setting to the recipe; the recipe's decision is written to config.yaml.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    scene: Annotated[Path | None, Flag("SCENE")] = Field(
        None,
        description="Scene folder (COLMAP: images/ and sparse/). Default: the bundled example "
        "scene.",
    )
    out: Annotated[Path | None, Flag("DIR", RESULTS, common=True)] = Field(
        None, description="Output folder, a new or an empty one. Default: below runs/."
    )

    backbone: Annotated[ComponentChoice, Flag("NAME", PARTS, common=True)] = Field(
        ComponentChoice(name=defaults.BACKBONE),
        description=f"What is trained. Default: {defaults.BACKBONE}.",
    )
    sampler: Annotated[ComponentChoice, Flag("NAME", PARTS, common=True)] = Field(
        ComponentChoice(name=defaults.SAMPLER),
        description=f"Which views a step renders. Default: {defaults.SAMPLER}.",
    )
    grouping: Annotated[ComponentChoice | None, Flag("NAME", PARTS)] = Field(
        None, description="How views are labelled near or far. Default: auto."
    )
    operator: Annotated[
        ComponentChoice | tuple[ComponentChoice, ...], Flag("NAME[+NAME]", PARTS, common=True)
    ] = Field(
        ComponentChoice(name=defaults.OPERATOR),
        description="How the views' gradients become one; a chain is written "
        f"{defaults.EXAMPLE_CHAIN}. Default: {defaults.OPERATOR}.",
    )
    densifier: Annotated[ComponentChoice | None, Flag("NAME", PARTS)] = Field(
        None,
        description=f"How primitives are added and removed; {defaults.NO_DENSIFIER} keeps them. "
        "Default: auto.",
    )
    rasterizer: Annotated[ComponentChoice, Flag("NAME", PARTS)] = Field(
        ComponentChoice(name=AUTO),
        description="What draws. Default: auto, the fastest one for the device.",
    )
    loss: Annotated[ComponentChoice, Flag("NAME", PARTS)] = Field(
        ComponentChoice(name=defaults.LOSS),
        description=f"How far a render is from its photo. Default: {defaults.LOSS}.",
    )
    exposure: Annotated[ComponentChoice | None, Flag("NAME", PARTS, common=True)] = Field(
        None,
        description="What cameras do to light between render and photo. Default: auto.",
    )
    exposure_from: Annotated[Path | None, Flag("FILE", TRAINING)] = Field(
        None,
        description="exposure.json of another run on these photos: the exposure starts from its "
        "values.",
    )
    initializer: Annotated[ComponentChoice | None, Flag("NAME", PARTS)] = Field(
        None,
        description="What is added to the points that a run starts from. Default: auto.",
    )
    resolution: Annotated[ComponentChoice | None, Flag("NAME", PARTS)] = Field(
        None, description="At which scale a step renders its views. Default: auto."
    )
    exporter: Annotated[ComponentChoice, Flag("NAME", PARTS)] = Field(
        ComponentChoice(name=defaults.EXPORTER),
        description=f"What writes the trained scene to a file. Default: {defaults.EXPORTER}.",
    )
    reader: Annotated[ComponentChoice, Flag("NAME", PARTS)] = Field(
        ComponentChoice(name=AUTO),
        description="What reads the scene. Default: auto, the one that accepts the folder.",
    )
    metrics: Annotated[tuple[ComponentChoice, ...], Flag("NAME", PARTS)] = Field(
        tuple(ComponentChoice(name=name) for name in defaults.METRICS.split("+")),
        description="Adds a figure that is measured of held-out views, repeatable. "
        f"Default: {', '.join(defaults.METRICS.split('+'))}.",
    )
    observers: Annotated[tuple[ComponentChoice, ...], Flag("NAME", PARTS, "observe")] = Field(
        (), description="Adds an observer, repeatable."
    )

    views_per_step: Annotated[int | str | None, Flag("K", TRAINING, "views")] = Field(
        None,
        description="Views per step, K; 1..2@0.5 changes it after that share of the steps. "
        "Default: auto.",
    )
    steps: Annotated[int | None, Flag("N", TRAINING, common=True)] = Field(
        None, ge=1, description="Optimizer steps; schedules stretch with them. Default: 30000."
    )
    max_views: Annotated[int | None, Flag("N", TRAINING)] = Field(
        None,
        ge=1,
        description="Length of the run in views: as many steps as draw them. With --seconds the "
        "shorter of both.",
    )
    seconds: Annotated[float | None, Flag("S", TRAINING, common=True)] = Field(
        None, gt=0, description="Training seconds; the number of steps follows the clock."
    )
    clock: Annotated[Literal["wall", "cpu"], Flag("wall|cpu", TRAINING)] = Field(
        "wall",
        description="What --seconds counts: the clock on the wall, or CPU time of the process, "
        "with --threads 1 where a machine is not quiet. Default: wall.",
    )
    revisions: tuple[tuple[PositiveInt, PositiveInt], ...] = Field(
        (), description="(step, steps in all from there on) of a run that followed the clock"
    )
    revised: tuple[dict[str, int | float | str], ...] = Field(
        (), description="the settings that changed with each of these"
    )
    planned_seconds: float | None = Field(
        None, gt=0, description="the seconds that a run with a time budget was given"
    )
    planned_views: int | None = Field(
        None, ge=1, description="the views that it was given at most within these seconds"
    )
    seed: Annotated[int, Flag("N", TRAINING, common=True)] = Field(
        0, ge=0, description="Seed of every random number. Default: 0."
    )
    schedule: Annotated[ScheduleMode, Flag("scaled|absolute", TRAINING)] = Field(
        "scaled",
        description="Stretch the published schedule to the run, or keep its numbers. "
        "Default: scaled.",
    )
    schedule_length: Annotated[int | None, Flag("N", TRAINING)] = Field(
        None,
        ge=1,
        description="With --schedule absolute: have the schedule of a run of that length. "
        "Default: 30000.",
    )
    schedule_unit: Annotated[Unit | None, Flag("views|steps", TRAINING)] = Field(
        None,
        description="What schedules count. Default: auto.",
    )
    densify_from: int | None = Field(
        None, ge=0, description="density control after this, counted in --schedule-unit ..."
    )
    densify_until: int | None = Field(None, ge=0, description="... and before this")
    densify_every: int | None = Field(None, ge=1, description="interval of its edits, likewise")
    min_refinements: int | None = Field(
        None,
        ge=0,
        description="edits that any run has, for which warm-up and interval are shortened",
    )
    reset_every: int | None = Field(
        None,
        ge=0,
        description="interval of opacity resets, counted in --schedule-unit; 0 for no resets",
    )
    sh_from: int | None = Field(
        None, ge=0, le=3, description="SH degree at the first step; that of an --init file, else 0"
    )
    sh_start: float | None = Field(
        None, ge=0, le=1, description="share of the run before the SH degree grows"
    )
    densify_views: Annotated[Literal["all", "one", "extra"], Flag("all|one|extra", TRAINING)] = (
        Field(
            "all",
            description="Whose statistics density control gets: of all views of a step, of one of "
            "them, or of all and an extra one that trains nothing. Default: all.",
        )
    )
    rate_factor: Annotated[float | None, Flag("F", TRAINING)] = Field(
        None,
        gt=0,
        description="Multiplies all learning rates of the backbone. Default: auto.",
    )
    beta1: float | None = Field(None, ge=0, lt=1, description="decay of Adam's first moment")
    beta2: float | None = Field(
        None,
        ge=0.9,
        lt=1,
        description="decay of Adam's second moment; if it is set, rates are those of runs that "
        "show photos often",
    )
    few_pass_rates: bool | None = Field(
        None, description="blocks learn at the rates for runs that show each photo a few times"
    )
    step_order: Literal["optimize-first", "densify-first"] | None = Field(
        None, description="optimizer before density control, or after it as published"
    )
    position_lr: Annotated[
        Literal["extent", "per-axis"] | None, Flag("extent|per-axis", TRAINING)
    ] = Field(
        None,
        description="How far positions step: by a share of the scene's extent, as published, "
        "or along the axes of each Gaussian, by a share of their lengths. Default: auto.",
    )
    batch_rule: Annotated[Literal["none", "sqrt"], Flag("none|sqrt", TRAINING)] = Field(
        "none",
        description="sqrt: with K views per step learning rates times sqrt(K), and Adam averages "
        "over as many views as with one. Default: none.",
    )
    recipe: Annotated[ComponentChoice, Flag("NAME", CONFIGURATION, common=True)] = Field(
        ComponentChoice(name=defaults.RECIPE),
        description="Decides all settings that are not set; `crossgrad recipes` lists them. "
        f"Default: {defaults.RECIPE}.",
    )
    decided: dict[str, str] = Field({}, description="what the recipe decided -> why")
    plan: Annotated[Literal["auto", "off"], Flag("auto|off", CONFIGURATION, common=True)] = Field(
        "auto",
        description="auto: leaves out what the scene does not need, on evidence that is shown; "
        "what is set here wins. Default: auto.",
    )
    backward: Annotated[Literal["separate", "joint"], Flag("separate|joint", TRAINING)] = Field(
        "separate",
        description="One backward pass per view, or one for all views. Default: separate.",
    )
    rules: Annotated[
        dict[str, dict[str, Any] | Literal[False]],
        Flag("NAME", TRAINING, "rule"),
        Flag("NAME", TRAINING, "no_rule"),
    ] = Field(
        {},
        description="--rule adds a rule that acts during training, --no-rule leaves one out, both "
        "repeatable. Default: auto.",
    )
    device: Annotated[str, Flag("auto|cpu|cuda|cuda:N", MACHINE, common=True)] = Field(
        AUTO,
        description="Where tensors live; auto: on a GPU if a rasterizer for it works, else on the "
        "CPU. Default: auto.",
    )
    threads: Annotated[int | None, Flag("N", MACHINE)] = Field(
        None, ge=1, description="CPU threads. Default: all there are."
    )
    data: SceneOptions = SceneOptions()
    background: Annotated[str, Flag("COLOR", TRAINING)] = Field(
        "black",
        description="black, white, random or r,g,b with numbers from 0 to 1. Default: black.",
    )
    max_gaussians: Annotated[
        NonNegativeInt | Literal["auto"] | None, Flag("N|auto", TRAINING, common=True)
    ] = Field(
        None,
        description="At most N primitives, 0 for no bound; auto: as suits the length of the run. "
        "Default: auto.",
    )
    growth: Annotated[Growth | None, Flag("unbounded|budget", TRAINING)] = Field(
        None,
        description="Growth up to --max-gaussians: unbounded, or along a budget that reaches it "
        "with the last edit. Default: auto.",
    )
    eval_every: Annotated[int | None, Flag("N", RESULTS)] = Field(
        None,
        ge=1,
        description="Steps between evaluations. Default: a tenth of the run.",
    )
    eval_from: int = Field(0, ge=0, description="no evaluation before this step")
    save_every: Annotated[int | None, Flag("N", RESULTS)] = Field(
        None, ge=1, description="Steps between checkpoints. Default: a fifth of the run."
    )
    stop_after: Annotated[int | None, Flag("STEP", RESULTS)] = Field(
        None, ge=1, description="Stops after this step with a checkpoint; --resume continues."
    )
    max_nonfinite_blocks: int = Field(
        100, ge=1, description="stop after so many blocks were dropped as non-finite"
    )

    @model_validator(mode="before")
    @classmethod
    def _old_names(cls, value: object) -> object:
        if not isinstance(value, dict):
            return value
        return {current_name(key, value): each for key, each in value.items()}

    @field_validator("operator", mode="before")
    @classmethod
    def _chain(cls, value: object) -> object:
        return tuple(value) if isinstance(value, list) else value

    @field_validator("metrics", "observers")
    @classmethod
    def _each_once(cls, value: tuple[ComponentChoice, ...]) -> tuple[ComponentChoice, ...]:
        names = [choice.name for choice in value]
        twice = dict.fromkeys(name for name in names if names.count(name) > 1)
        if twice:
            raise ValueError(
                f"must name each component once, with all its options; {', '.join(twice)} is "
                "named twice"
            )
        return value

    @field_validator("rules", mode="before")
    @classmethod
    def _rules(cls, value: object) -> object:
        """Return the options of each rule; `true` or no value means a rule with its defaults."""
        if not isinstance(value, Mapping):
            return value
        return {name: {} if each in (True, None) else each for name, each in value.items()}

    @field_validator("views_per_step")
    @classmethod
    def _views_per_step(cls, value: int | str | None) -> int | str | None:
        """Return a constant K as a number, and a varying K as text in the standard form."""
        if value is None:
            return None
        return ViewsPerStepSpec.parsed(str(value)).setting

    @field_validator("background")
    @classmethod
    def _background(cls, value: str) -> str:
        if value in {"black", "white", "random"}:
            return value
        try:
            red, green, blue = (float(part) for part in value.split(","))
        except ValueError:
            red = green = blue = -1.0
        if not all(0.0 <= level <= 1.0 for level in (red, green, blue)):
            raise ValueError("must be black, white, random, or three numbers r,g,b in [0, 1]")
        return value

    @property
    def view_plan(self) -> ViewsPerStepSpec | None:
        """Views per step over the run; None if the sampler decides."""
        return (
            None
            if self.views_per_step is None
            else ViewsPerStepSpec.parsed(str(self.views_per_step))
        )

    @property
    def used_rules(self) -> tuple[ComponentChoice, ...]:
        """The rules that are not left out."""
        return tuple(
            ComponentChoice.model_validate({**options, "name": name})
            for name, options in self.rules.items()
            if options is not False
        )

    @property
    def operators(self) -> tuple[ComponentChoice, ...]:
        """The operators of the chain; a single element without a chain."""
        return self.operator if isinstance(self.operator, tuple) else (self.operator,)
