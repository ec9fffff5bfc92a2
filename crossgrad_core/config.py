"""The fully resolved configuration of a run: one schema for command line, file and results."""

from pathlib import Path
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, PositiveInt, field_validator

from crossgrad_core import defaults
from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.contract.schedule import ScheduleMode

#: Name of a choice that the run makes at its start.
AUTO: Final = "auto"


class ComponentChoice(BaseModel):
    """A component by name with its options; the options are validated by the component itself."""

    model_config = ConfigDict(frozen=True, extra="allow")

    name: str

    @property
    def options(self) -> dict[str, Any]:
        """The options as given."""
        return dict(self.model_extra or {})


class RunConfig(BaseModel):
    """Everything that determines a run.

    `None` means "decided at the start of the run": `run` writes the decision into config.yaml.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    scene: Path | None = Field(
        None, description="scene folder; the bundled one where none is given"
    )
    out: Path | None = Field(None, description="output folder")

    backbone: ComponentChoice = ComponentChoice(name=defaults.BACKBONE)
    sampler: ComponentChoice = ComponentChoice(name=defaults.SAMPLER)
    grouping: ComponentChoice | None = None
    operator: ComponentChoice | tuple[ComponentChoice, ...] = ComponentChoice(
        name=defaults.OPERATOR
    )
    densifier: ComponentChoice | None = None
    rasterizer: ComponentChoice = ComponentChoice(name=AUTO)
    reader: ComponentChoice = ComponentChoice(name=AUTO)
    observers: tuple[ComponentChoice, ...] = ()

    views: int | None = Field(None, ge=1, description="views per step, K; default: the sampler's")
    steps: int | None = Field(None, ge=1, description="optimizer steps")
    seconds: float | None = Field(
        None, gt=0, description="training seconds; the number of steps follows the clock"
    )
    revisions: tuple[tuple[PositiveInt, PositiveInt], ...] = Field(
        (), description="(step, steps in all from there on) of a run that followed the clock"
    )
    seed: int = Field(0, ge=0, description="seed of every random number of the run")
    schedule: ScheduleMode = "scaled"
    densify_from: int | None = Field(None, ge=0, description="density control after this step ...")
    densify_until: int | None = Field(None, ge=0, description="... and before this one")
    densify_every: int | None = Field(None, ge=1, description="steps between its edits")
    reset_every: int | None = Field(None, ge=1, description="steps between opacity resets")
    sh_from: int | None = Field(
        None, ge=0, le=3, description="SH degree at the first step; that of an --init file, else 0"
    )
    preset: Literal["default", "inria"] = "default"
    backward: Literal["separate", "joint"] = "separate"
    device: str = "cpu"
    threads: int | None = Field(None, ge=1, description="CPU threads; default: all there are")
    reading: SceneOptions = SceneOptions()
    ssim_weight: float = Field(0.2, ge=0, le=1, description="share of 1 - SSIM in the loss")
    background: str = Field("black", description="black, white, random, or r,g,b in [0, 1]")
    max_gaussians: int | None = Field(None, ge=1, description="density control stops growing here")
    eval_every: int | None = Field(None, ge=1, description="steps between evaluations")
    save_every: int | None = Field(None, ge=1, description="steps between checkpoints")
    stop_after: int | None = Field(None, ge=1, description="stop, resumable, after this step")
    max_dropped: int = Field(
        100, ge=1, description="stop after so many blocks were dropped as non-finite"
    )

    @field_validator("operator", mode="before")
    @classmethod
    def _chain(cls, value: object) -> object:
        return tuple(value) if isinstance(value, list) else value

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
    def operators(self) -> tuple[ComponentChoice, ...]:
        """The links of the operator chain; one for a single operator."""
        return self.operator if isinstance(self.operator, tuple) else (self.operator,)
