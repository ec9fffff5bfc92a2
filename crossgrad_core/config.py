"""The configuration of a run: the class `RunConfig` for command line, files and results."""

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
#: Settings that may change when a run is resumed, because they do not affect the training.
CHANGEABLE: Final = frozenset({"device", "threads", "stop_after"})
#: Rule for the growth of the number of primitives: as the densifier requests, or by a budget that
#: depends on the length of the run.
Growth: TypeAlias = Literal["unbounded", "budget"]


#: Old name of a setting -> its present name.
_RENAMED: Final = {"views": "views_per_step"}


def current_name(setting: str, beside: Container[str] = ()) -> str:
    """Return the present name of a setting; keep an old name if `beside` contains the new name."""
    new = _RENAMED.get(setting, setting)
    return setting if new in beside else new


class ComponentChoice(BaseModel):
    """The name of a component and its options, which the component itself validates."""

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
        """The options that were given with the name; the component validates them later."""
        return dict(self.model_extra or {})


class RunConfig(BaseModel):
    """All settings that determine a run.

    The recipe decides settings that are None, and the decisions are written to config.yaml.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    scene: Annotated[Path | None, Flag("SCENE")] = Field(
        None,
        description="Scene folder (COLMAP: images/ and sparse/). Default: the bundled example "
        "scene.",
    )
    out: Annotated[Path | None, Flag("DIR", RESULTS, common=True)] = Field(
        None, description="Output folder, new or empty. Default: a folder below runs/."
    )

    backbone: Annotated[ComponentChoice, Flag("NAME", PARTS, common=True)] = Field(
        ComponentChoice(name=defaults.BACKBONE),
        description=f"Scene representation to train. Default: {defaults.BACKBONE}.",
    )
    sampler: Annotated[ComponentChoice, Flag("NAME", PARTS, common=True)] = Field(
        ComponentChoice(name=defaults.SAMPLER),
        description=f"Chooses the views of each step. Default: {defaults.SAMPLER}.",
    )
    grouping: Annotated[ComponentChoice | None, Flag("NAME", PARTS)] = Field(
        None, description="Assigns views to groups, such as near and far. Default: auto."
    )
    operator: Annotated[
        ComponentChoice | tuple[ComponentChoice, ...], Flag("NAME[+NAME]", PARTS, common=True)
    ] = Field(
        ComponentChoice(name=defaults.OPERATOR),
        description="Combines the views' gradients into one; write a chain as "
        f"{defaults.EXAMPLE_CHAIN}. Default: {defaults.OPERATOR}.",
    )
    densifier: Annotated[ComponentChoice | None, Flag("NAME", PARTS)] = Field(
        None,
        description=f"Adds and removes Gaussians; {defaults.NO_DENSIFIER} keeps their number. "
        "Default: auto.",
    )
    rasterizer: Annotated[ComponentChoice, Flag("NAME", PARTS)] = Field(
        ComponentChoice(name=AUTO),
        description="Renders the views. Default: auto, the fastest rasterizer for the device.",
    )
    loss: Annotated[ComponentChoice, Flag("NAME", PARTS)] = Field(
        ComponentChoice(name=defaults.LOSS),
        description=f"Measures the difference between render and photo. Default: {defaults.LOSS}.",
    )
    exposure: Annotated[ComponentChoice | None, Flag("NAME", PARTS, common=True)] = Field(
        None,
        description="Models brightness and colour differences between photos. Default: auto.",
    )
    exposure_from: Annotated[Path | None, Flag("FILE", TRAINING)] = Field(
        None,
        description="exposure.json of another run on the same photos; training starts from its "
        "values.",
    )
    initializer: Annotated[ComponentChoice | None, Flag("NAME", PARTS)] = Field(
        None,
        description="Adds points to the points that a run starts from. Default: auto.",
    )
    resolution: Annotated[ComponentChoice | None, Flag("NAME", PARTS)] = Field(
        None, description="Chooses the resolution of the rendered views. Default: auto."
    )
    exporter: Annotated[ComponentChoice, Flag("NAME", PARTS)] = Field(
        ComponentChoice(name=defaults.EXPORTER),
        description=f"Writes the trained scene to a file. Default: {defaults.EXPORTER}.",
    )
    reader: Annotated[ComponentChoice, Flag("NAME", PARTS)] = Field(
        ComponentChoice(name=AUTO),
        description="Reads the scene. Default: auto, the reader that detects the format of the "
        "folder.",
    )
    metrics: Annotated[tuple[ComponentChoice, ...], Flag("NAME", PARTS)] = Field(
        tuple(ComponentChoice(name=name) for name in defaults.METRICS.split("+")),
        description="Adds a metric, which is computed on held-out views. Repeatable. Default: "
        f"{', '.join(defaults.METRICS.split('+'))}.",
    )
    observers: Annotated[tuple[ComponentChoice, ...], Flag("NAME", PARTS, "observe")] = Field(
        (), description="Adds an observer. Repeatable."
    )

    views_per_step: Annotated[int | str | None, Flag("K", TRAINING, "views")] = Field(
        None,
        description="Number of views per step, K; 1..2@0.5 changes K from 1 to 2 after half of "
        "the steps. "
        "Default: auto.",
    )
    steps: Annotated[int | None, Flag("N", TRAINING, common=True)] = Field(
        None,
        ge=1,
        description="Number of optimizer steps; schedules scale with this number. Default: 30000.",
    )
    max_views: Annotated[int | None, Flag("N", TRAINING)] = Field(
        None,
        ge=1,
        description="Length of the run in rendered views. With --seconds, the run ends at the "
        "limit that it reaches first.",
    )
    seconds: Annotated[float | None, Flag("S", TRAINING, common=True)] = Field(
        None, gt=0, description="Training time in seconds, which determines the number of steps."
    )
    clock: Annotated[Literal["wall", "cpu"], Flag("wall|cpu", TRAINING)] = Field(
        "wall",
        description="Clock of --seconds: wall time, or CPU time of the process; cpu needs "
        "--threads 1 and suits a busy machine. Default: wall.",
    )
    revisions: tuple[tuple[PositiveInt, PositiveInt], ...] = Field(
        (),
        description="pairs (step, number of steps planned after this step) of a run with a time "
        "budget",
    )
    revised: tuple[dict[str, int | float | str], ...] = Field(
        (), description="settings that changed with each entry of revisions"
    )
    planned_seconds: float | None = Field(
        None, gt=0, description="training seconds of a run with a time budget"
    )
    planned_views: int | None = Field(
        None, ge=1, description="maximum number of views of a run with a time budget"
    )
    seed: Annotated[int, Flag("N", TRAINING, common=True)] = Field(
        0, ge=0, description="Seed of all random numbers. Default: 0."
    )
    schedule: Annotated[ScheduleMode, Flag("scaled|absolute", TRAINING)] = Field(
        "scaled",
        description="scaled: scale the published schedule to the length of the run; absolute: "
        "keep its step numbers. Default: scaled.",
    )
    schedule_length: Annotated[int | None, Flag("N", TRAINING)] = Field(
        None,
        ge=1,
        description="With --schedule absolute: use the schedule of a run of this length. "
        "Default: 30000.",
    )
    schedule_unit: Annotated[Unit | None, Flag("views|steps", TRAINING)] = Field(
        None,
        description="Unit of the schedules: steps or views. Default: auto.",
    )
    densify_from: int | None = Field(
        None, ge=0, description="first step of density control, in units of --schedule-unit"
    )
    densify_until: int | None = Field(
        None, ge=0, description="last step of density control, in units of --schedule-unit"
    )
    densify_every: int | None = Field(
        None, ge=1, description="interval between edits, in units of --schedule-unit"
    )
    min_refinements: int | None = Field(
        None,
        ge=0,
        description="minimum number of edits; short runs start earlier and edit more often to "
        "reach this number",
    )
    reset_every: int | None = Field(
        None,
        ge=0,
        description="interval between opacity resets, in units of --schedule-unit; 0 turns "
        "resets off",
    )
    sh_from: int | None = Field(
        None,
        ge=0,
        le=3,
        description="SH degree at the first step; default 0, or the degree of an --init file",
    )
    sh_start: float | None = Field(
        None, ge=0, le=1, description="share of the run before the SH degree increases"
    )
    densify_views: Annotated[Literal["all", "one", "extra"], Flag("all|one|extra", TRAINING)] = (
        Field(
            "all",
            description="Views whose statistics density control uses: all views of a step, only "
            "one of these views, or all views and one extra view that is not trained on. Default: "
            "all.",
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
        description="decay of Adam's second moment; setting beta2 selects the learning rates for "
        "many passes over the photos",
    )
    few_pass_rates: bool | None = Field(
        None, description="true: use the learning rates for few passes over the photos"
    )
    step_order: Literal["optimize-first", "densify-first"] | None = Field(
        None,
        description="order of the optimizer and density control in a step; the published order "
        "is density control first",
    )
    position_lr: Annotated[
        Literal["extent", "per-axis"] | None, Flag("extent|per-axis", TRAINING)
    ] = Field(
        None,
        description="Size of position steps: a share of the scene extent, as published, or a "
        "share of each Gaussian's axis lengths. Default: auto.",
    )
    batch_rule: Annotated[Literal["none", "sqrt"], Flag("none|sqrt", TRAINING)] = Field(
        "none",
        description="sqrt: with K views per step, multiply learning rates by sqrt(K) and let "
        "Adam average over the same number of views as with K = 1. Default: none.",
    )
    recipe: Annotated[ComponentChoice, Flag("NAME", CONFIGURATION, common=True)] = Field(
        ComponentChoice(name=defaults.RECIPE),
        description="Chooses every setting that you do not set; `crossgrad recipes` lists the "
        f"recipes. Default: {defaults.RECIPE}.",
    )
    decided: dict[str, str] = Field({}, description="decisions of the recipe -> their reasons")
    plan: Annotated[Literal["auto", "off"], Flag("auto|off", CONFIGURATION, common=True)] = Field(
        "auto",
        description="auto: leave out components that the scene does not need, unless you set "
        "them. Default: auto.",
    )
    backward: Annotated[Literal["separate", "joint"], Flag("separate|joint", TRAINING)] = Field(
        "separate",
        description="One backward pass per view, or one joint pass for all views. Default: "
        "separate.",
    )
    rules: Annotated[
        dict[str, dict[str, Any] | Literal[False]],
        Flag("NAME", TRAINING, "rule"),
        Flag("NAME", TRAINING, "no_rule"),
    ] = Field(
        {},
        description="--rule adds a training rule, --no-rule removes a rule. Repeatable. Default: "
        "auto.",
    )
    device: Annotated[str, Flag("auto|cpu|cuda|cuda:N", MACHINE, common=True)] = Field(
        AUTO,
        description="Device of the tensors; auto: a GPU if a rasterizer works on the GPU, else "
        "the CPU. Default: auto.",
    )
    threads: Annotated[int | None, Flag("N", MACHINE)] = Field(
        None, ge=1, description="Number of CPU threads. Default: all."
    )
    data: SceneOptions = SceneOptions()
    background: Annotated[str, Flag("COLOR", TRAINING)] = Field(
        "black",
        description="Background colour: black, white, random, or r,g,b with numbers from 0 to 1. "
        "Default: black.",
    )
    max_gaussians: Annotated[
        NonNegativeInt | Literal["auto"] | None, Flag("N|auto", TRAINING, common=True)
    ] = Field(
        None,
        description="Maximum number of Gaussians, 0 for no limit; auto: depends on the length of "
        "the run. Default: auto.",
    )
    growth: Annotated[Growth | None, Flag("unbounded|budget", TRAINING)] = Field(
        None,
        description="Growth up to --max-gaussians: unbounded, or along a budget that reaches the "
        "limit at the last edit. Default: auto.",
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
        None, ge=1, description="Stop after this step and write a checkpoint; --resume continues."
    )
    max_nonfinite_blocks: int = Field(
        100,
        ge=1,
        description="stop the run after this number of blocks were dropped because their "
        "gradients were not finite",
    )

    @model_validator(mode="before")
    @classmethod
    def _old_names(cls, value: object) -> object:
        if not isinstance(value, dict):
            return value
        return {current_name(key, value): setting for key, setting in value.items()}

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

    @field_validator("decided")
    @classmethod
    def _are_settings(cls, value: dict[str, str]) -> dict[str, str]:
        """Refuse names in `decided` that are not settings."""
        for name in value:
            setting, _, option = name.partition(".")
            options = SceneOptions.model_fields if setting == "data" else {option}
            if setting not in cls.model_fields or option not in options:
                raise ValueError(f"{name} is not a setting")
        return value

    @field_validator("rules", mode="before")
    @classmethod
    def _rules(cls, value: object) -> object:
        """Return the options of each rule; `true` or an empty value selects a rule's defaults."""
        if not isinstance(value, Mapping):
            return value
        return {name: {} if options in (True, None) else options for name, options in value.items()}

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
            red, green, blue = (float(level_text) for level_text in value.split(","))
        except ValueError:
            red = green = blue = -1.0
        if not all(0.0 <= level <= 1.0 for level in (red, green, blue)):
            raise ValueError("must be black, white, random, or three numbers r,g,b in [0, 1]")
        return value

    @property
    def view_plan(self) -> ViewsPerStepSpec | None:
        """The number of views of every step; None if the sampler decides the number."""
        return (
            None
            if self.views_per_step is None
            else ViewsPerStepSpec.parsed(str(self.views_per_step))
        )

    @property
    def used_rules(self) -> tuple[ComponentChoice, ...]:
        """The rules that the run uses; rules that were set to false are left out."""
        return tuple(
            ComponentChoice.model_validate({**options, "name": name})
            for name, options in self.rules.items()
            if options is not False
        )

    @property
    def operators(self) -> tuple[ComponentChoice, ...]:
        """The operators of the chain; if there is no chain, the only operator."""
        return self.operator if isinstance(self.operator, tuple) else (self.operator,)
