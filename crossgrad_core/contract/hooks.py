"""The hooks: specifications that plugins implement or wrap.

The three hooks of a training step, `crossgrad_sample_views`, `crossgrad_aggregate_gradients` and
`crossgrad_densify`, stop at the first answer: the selected component gives it. Any other plugin may
wrap them (`@hookimpl(wrapper=True)`) to watch the call or replace its result. A first-result hook
must answer with a value; None is an error.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from crossgrad_core.contract.component import hookspec

if TYPE_CHECKING:
    from torch import Tensor

    from crossgrad_core.contract.blocks import Block, LearningRate, PluginState
    from crossgrad_core.contract.contexts import (
        AfterStepContext,
        AggregateContext,
        AggregateResult,
        Answer,
        DensifyContext,
        DensifyResult,
        EvaluationReport,
        Model,
        PixelContext,
        RegularizeContext,
        RegularizeResult,
        RunInfo,
        SampleContext,
        SampleResult,
        ScaleContext,
        ScaleResult,
        StepRecord,
    )
    from crossgrad_core.contract.schedule import Schedule
    from crossgrad_core.contract.selection import Selection
    from crossgrad_core.contract.slots.rule import FinalEdit, GaussiansContext, GaussiansResult


class HookSpecs:
    """All hooks in the order in which a run calls them."""

    @hookspec
    def crossgrad_validate_selection(self, selection: "Selection") -> "list[str] | None":
        """Before training: reasons why this selection of components cannot work.

        Every plugin is asked; one reason is enough to refuse the run.
        """

    @hookspec
    def crossgrad_run_start(self, run: "RunInfo") -> None:
        """Event: the scene is read, the components are chosen, no step is taken yet."""

    @hookspec
    def crossgrad_update_intervals(self, blocks: "tuple[Block, ...]") -> "Mapping[str, int] | None":
        """Tensors that learn in one of N steps only, by name -> N.

        Every plugin is asked once per run. In its steps such a tensor has sqrt(N) times its rate.
        """

    @hookspec(firstresult=True)
    def crossgrad_sample_views(self, context: "SampleContext") -> "SampleResult | None":
        """Hook 1: the K views of this step. Answered by the selected sampler."""

    @hookspec(firstresult=True)
    def crossgrad_choose_scales(self, context: "ScaleContext") -> "ScaleResult | None":
        """The scale at which each drawn view is rendered and compared. The selected resolution."""

    @hookspec
    def crossgrad_view_gaussians(self, context: "GaussiansContext") -> "GaussiansResult | None":
        """The Gaussians that a training view is rendered from, if others than the decoded ones.

        Every plugin is asked in turn, once per view, about what the one before it answered.
        """

    @hookspec
    def crossgrad_pixel_weights(self, context: "PixelContext") -> "Tensor | None":
        """How much each pixel of a view counts in its loss, [H, W], not negative.

        Every plugin is asked, once per view; None means "all alike". Answers multiply.
        """

    @hookspec
    def crossgrad_regularize(self, context: "RegularizeContext") -> "RegularizeResult | None":
        """Loss terms besides the photometric one, per view or per step.

        Every plugin is asked, once per view (`context.gaussians` given) and once per step (None);
        None means "no term here". The gradients join after aggregation.
        """

    @hookspec(firstresult=True)
    def crossgrad_aggregate_gradients(
        self, context: "AggregateContext"
    ) -> "AggregateResult | None":
        """Hook 2: one gradient per tensor from the gradients of K views. The selected operator."""

    @hookspec
    def crossgrad_rate_factor(
        self, rate: "LearningRate", step: int, schedule: "Schedule"
    ) -> float | None:
        """A factor for a learning rate of the backbone in a step, not negative.

        Every plugin is asked for each block; None means "as it is". Answers multiply.
        """

    @hookspec
    def crossgrad_after_optimizer(self, context: "AfterStepContext") -> "DensifyResult | None":
        """After the optimizer and before density control: an edit that overwrites values; or None.

        Every plugin is asked in turn. The set of primitives stays.
        """

    @hookspec(firstresult=True)
    def crossgrad_densify(self, context: "DensifyContext") -> "DensifyResult | None":
        """Hook 3: the edit of this step, or NO_EDIT. Answered by the selected densifier."""

    @hookspec
    def crossgrad_after_step(self, context: "AfterStepContext") -> "DensifyResult | None":
        """After optimizer and density control: an edit for noise, clamps, filters; or None."""

    @hookspec
    def crossgrad_step_done(self, context: "AfterStepContext") -> "Answer | None":
        """The parameters after a complete step, for states that follow them, such as an average.

        `context.edited` is True if the set of primitives changed in this step, or if density
        control overwrote values.
        """

    @hookspec
    def crossgrad_step_end(self, record: "StepRecord") -> None:
        """Event: the step is complete."""

    @hookspec
    def crossgrad_model_ready(self, model: "Model") -> None:
        """Event: the step is complete, and this is the model now. Read only; off the clock."""

    @hookspec
    def crossgrad_eval_parameters(
        self, states: "Mapping[str, PluginState]", step: int
    ) -> "Mapping[str, Tensor] | None":
        """Tensors that evaluations and exports show in place of the parameters of these names."""

    @hookspec
    def crossgrad_final_edit(self, model: "Model") -> "FinalEdit | None":
        """The edit of a finished run, before it is evaluated and exported; or None.

        Every plugin is asked in turn. `model.parameters` are those that evaluations show.
        """

    @hookspec
    def crossgrad_evaluation(self, report: "EvaluationReport") -> None:
        """Event: the test views were evaluated."""

    @hookspec
    def crossgrad_length_changed(self, step: int, total: int) -> None:
        """Event: after `step`, a run with a time budget is to have `total` steps in all."""

    @hookspec
    def crossgrad_log(self, text: str) -> None:
        """Event: the run says something to the user (one line of plain text)."""

    @hookspec
    def crossgrad_run_end(self, status: str) -> None:
        """Event: training is over; status is `finished`, `stopped` or `failed`."""
