"""The evidence for decisions: statistics of the scene and, if allowed, of a probe."""

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
    """The evidence about a planned run; each value is computed at first use.

    Attributes:
        config: The configuration, which contains only settings of the user.
        scene: The scene of the run.
        seconds: Training seconds of the probe; None if no probe is allowed.
    """

    config: RunConfig
    scene: Scene
    seconds: float | None = None

    def is_given(self, *names: str) -> bool:
        """Return True if the user set any of these settings; a value of None counts as not set.

        Args:
            names: Settings, such as `exposure`, `data.init` or `backbone.sh_degree`.
        """
        settings = {n for n in self.config.model_fields_set if getattr(self.config, n) is not None}
        # A run also stores its defaults. In the group `data`, a setting with its default value
        # therefore counts as not set.
        data, defaults = self.config.data, type(self.config.data)()
        settings |= {
            f"data.{n}" for n in data.model_fields_set if getattr(data, n) != getattr(defaults, n)
        }
        settings |= {f"backbone.{name}" for name in self.config.backbone.options}
        settings |= {f"rules.{name}" for name in self.config.rules}
        return not settings.isdisjoint(names)

    @cached_property
    def modes(self) -> Modes:
        """The modes of the camera distances."""
        return modes_of(self.scene)

    @cached_property
    def sampler(self) -> Sampler:
        """The sampler as configured, before any decision."""
        choice = self.config.sampler
        return build_component(Sampler, choice.name, choice.options)

    @property
    def grouping(self) -> ComponentChoice:
        """The grouping into near and far views: the user's choice, or the cut between the modes."""
        if self.config.grouping is not None:
            return self.config.grouping
        if self.is_given("sampler") and self.sampler.default_grouping is not None:
            return ComponentChoice(name=self.sampler.default_grouping)
        return self.modes.cut.grouping

    @cached_property
    def probe(self) -> "Probe | None":
        """The results of a short training run; None if no probe is allowed."""
        if self.seconds is None:
            return None
        from crossgrad_plugins.planner.probe import probed

        return probed(self.config, self.seconds, self.grouping)

    @cached_property
    def view_plan(self) -> ViewsPerStepSpec:
        """The number of views per step as configured, before any decision."""
        return views_per_step_of(self.config)[0]

    @property
    def is_measured(self) -> bool:
        """True if the run uses recipe `auto`, with which the planner's rules were measured."""
        return self.config.recipe.name == "auto"

    @cached_property
    def backbone(self) -> Backbone:
        """The backbone, fitted to the scene."""
        choice = self.config.backbone
        return build_component(Backbone, choice.name, choice.options).fitted_to(self.scene)[0]

    @property
    def degree(self) -> int | None:
        """The highest degree of the backbone's spherical harmonics; None without such an option."""
        degree = self.backbone.model_dump().get("sh_degree")
        return degree if isinstance(degree, int) else None

    def scene_note(self, word: str) -> str | None:
        """Return the reader's first note that contains a word; None if there is none."""
        return next((note for note in self.scene.notes if word in note), None)
