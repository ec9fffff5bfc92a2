"""Figures that decisions rest on: from the scene, and from a probe where one may be taken."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from crossgrad_core.commands import ComponentChoice, RunConfig, views_per_step_of
from crossgrad_core.plugin import Backbone, Sampler, Scene, ViewsPerStepSpec, build_component
from crossgrad_plugins.planner.modes import Modes, modes_of

if TYPE_CHECKING:
    from crossgrad_plugins.planner.probe import Probe


@dataclass(frozen=True, eq=False)
class Evidence:
    """The figures of a run to be; each is worked out when a decision asks for it.

    Attributes:
        config: The configuration, in which only what the user set is set.
        scene: Its scene.
        seconds: Training seconds of the probe; None where none may be taken.
    """

    config: RunConfig
    scene: Scene
    seconds: float | None = None

    def is_given(self, *names: str) -> bool:
        """Whether the user set any of these settings; None leaves one to the run.

        Args:
            names: Settings, such as `exposure`, `data.init` or `backbone.sh_degree`.
        """
        known = {n for n in self.config.model_fields_set if getattr(self.config, n) is not None}
        # A run writes down its defaults, too: in the group `data` these leave a setting open.
        own, usual = self.config.data, type(self.config.data)()
        known |= {f"data.{n}" for n in own.model_fields_set if getattr(own, n) != getattr(usual, n)}
        known |= {f"backbone.{name}" for name in self.config.backbone.options}
        known |= {f"rules.{name}" for name in self.config.rules}
        return not known.isdisjoint(names)

    @cached_property
    def modes(self) -> Modes:
        """The modes of the camera distances."""
        return modes_of(self.scene)

    @cached_property
    def sampler(self) -> Sampler:
        """The sampler, without decisions on it."""
        choice = self.config.sampler
        return build_component(Sampler, choice.name, choice.options)

    @property
    def grouping(self) -> ComponentChoice:
        """Which views are near and far: as the user has it, or where the modes part."""
        if self.config.grouping is not None:
            return self.config.grouping
        if self.is_given("sampler") and self.sampler.default_grouping is not None:
            return ComponentChoice(name=self.sampler.default_grouping)
        return self.modes.cut.grouping

    @cached_property
    def probe(self) -> "Probe | None":
        """What a short training run shows; None where none may be taken."""
        if self.seconds is None:
            return None
        from crossgrad_plugins.planner.probe import probed

        return probed(self.config, self.seconds, self.grouping)

    @cached_property
    def view_plan(self) -> ViewsPerStepSpec:
        """How many views the steps have, without decisions on it."""
        return views_per_step_of(self.config)[0]

    @property
    def is_measured(self) -> bool:
        """Whether the run has the recipe that the rules of the planner were measured with."""
        return self.config.recipe.name == "auto"

    @cached_property
    def backbone(self) -> Backbone:
        """The backbone as it fits itself to the scene."""
        choice = self.config.backbone
        return build_component(Backbone, choice.name, choice.options).fitted_to(self.scene)[0]

    @property
    def degree(self) -> int | None:
        """The highest degree of its spherical harmonics; None where none can be set."""
        degree = self.backbone.model_dump().get("sh_degree")
        return degree if isinstance(degree, int) else None

    def scene_note(self, word: str) -> str | None:
        """What the reader noted with that word; None where it did not."""
        return next((note for note in self.scene.notes if word in note), None)
