"""The evidence for decisions: statistics of the scene and, if requested, of a probe."""

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
    """The evidence about a planned run.

    Each value is computed when it is first used.

    Attributes:
        config: The configuration with only the user's settings.
        scene: The scene of the run.
        seconds: Training time of the probe in seconds; None for no probe.
    """

    config: RunConfig
    scene: Scene
    seconds: float | None = None

    def is_given(self, *names: str) -> bool:
        """Return True if the user set any of the settings; the value None counts as not set.

        Args:
            names: Names of settings, such as `exposure`, `data.init` or `backbone.sh_degree`.
        """
        settings = {n for n in self.config.model_fields_set if getattr(self.config, n) is not None}
        # The configuration of a run also contains default values. In the group `data`, a setting
        # with its default value therefore counts as not set.
        data, defaults = self.config.data, type(self.config.data)()
        settings |= {
            f"data.{n}" for n in data.model_fields_set if getattr(data, n) != getattr(defaults, n)
        }
        settings |= {f"backbone.{name}" for name in self.config.backbone.options}
        settings |= {f"rules.{name}" for name in self.config.rules}
        return not settings.isdisjoint(names)

    @cached_property
    def modes(self) -> Modes:
        """The modes (clusters) of the camera distances."""
        return modes_of(self.scene)

    @cached_property
    def sampler(self) -> Sampler:
        """The sampler of the configuration, before any decision."""
        choice = self.config.sampler
        return build_component(Sampler, choice.name, choice.options)

    @property
    def grouping(self) -> ComponentChoice:
        """The grouping into near and far views: the user's, or a cut between the modes."""
        if self.config.grouping is not None:
            return self.config.grouping
        if self.is_given("sampler") and self.sampler.default_grouping is not None:
            return ComponentChoice(name=self.sampler.default_grouping)
        return self.modes.cut.grouping

    @cached_property
    def probe(self) -> "Probe | None":
        """The measurements of a short training run; None if no probe was requested."""
        if self.seconds is None:
            return None
        from crossgrad_plugins.planner.probe import probed

        return probed(self.config, self.seconds, self.grouping)

    @cached_property
    def view_plan(self) -> ViewsPerStepSpec:
        """The number of views per step in the configuration, before any decision."""
        return views_per_step_of(self.config)[0]

    @property
    def is_measured(self) -> bool:
        """True if the run uses recipe `auto`.

        The rules of the planner were measured with this recipe.
        """
        return self.config.recipe.name == "auto"

    @cached_property
    def backbone(self) -> Backbone:
        """The backbone, fitted to the scene."""
        choice = self.config.backbone
        return build_component(Backbone, choice.name, choice.options).fitted_to(self.scene)[0]

    @property
    def degree(self) -> int | None:
        """The highest SH degree of the backbone; None if the backbone has no such option."""
        degree = self.backbone.model_dump().get("sh_degree")
        return degree if isinstance(degree, int) else None

    def scene_note(self, word: str) -> str | None:
        """Return the reader's first note that contains a word; None if there is none."""
        return next((note for note in self.scene.notes if word in note), None)
