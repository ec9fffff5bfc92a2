"""The hooks: specifications that plugins implement or wrap.

Three hooks of a training step are first-result hooks, which the selected component answers:
`crossgrad_sample_views`, `crossgrad_aggregate_gradients` and `crossgrad_densify`. Any other plugin
may wrap these hooks (`@hookimpl(wrapper=True)`) to watch a call or replace its result. A
first-result hook must return a value; None is an error.
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
    """All hooks, in the order in which a run calls them."""

    @hookspec
    def crossgrad_validate_selection(self, selection: "Selection") -> "list[str] | None":
        """Return reasons why the selected components cannot work together; called before training.

        All plugins answer this hook. A single reason is enough to refuse the run.
        """

    @hookspec
    def crossgrad_run_start(self, run: "RunInfo") -> None:
        """Event: the scene was read and the components were chosen; no step has begun."""

    @hookspec
    def crossgrad_update_intervals(self, blocks: "tuple[Block, ...]") -> "Mapping[str, int] | None":
        """Return a dict from tensor name to N, for tensors that are updated in one of N steps.

        All plugins answer this hook, once per run. In the steps that update such a tensor, its
        learning rate is multiplied by sqrt(N).
        """

    @hookspec(firstresult=True)
    def crossgrad_sample_views(self, context: "SampleContext") -> "SampleResult | None":
        """Hook 1: return the K views of this step (sampler slot)."""

    @hookspec(firstresult=True)
    def crossgrad_choose_scales(self, context: "ScaleContext") -> "ScaleResult | None":
        """Return the scale at which each drawn view is rendered for the loss (resolution slot)."""

    @hookspec
    def crossgrad_view_gaussians(self, context: "GaussiansContext") -> "GaussiansResult | None":
        """Return the Gaussians to render for a training view; None keeps the Gaussians unchanged.

        All plugins are called one after another, once per view. Each plugin gets the Gaussians that
        the previous plugin returned.
        """

    @hookspec
    def crossgrad_pixel_weights(self, context: "PixelContext") -> "Tensor | None":
        """Return the weight of each pixel in the loss of a view, [H, W], not negative.

        All plugins answer this hook, once per view; None means equal weights. The results are
        multiplied.
        """

    @hookspec
    def crossgrad_regularize(self, context: "RegularizeContext") -> "RegularizeResult | None":
        """Return a loss term in addition to the photometric loss, per view or per step.

        All plugins answer this hook, once per view (`context.gaussians` given) and once per step
        (`context.gaussians` is None). None means that there is no term. The gradients are added
        after aggregation.
        """

    @hookspec(firstresult=True)
    def crossgrad_aggregate_gradients(
        self, context: "AggregateContext"
    ) -> "AggregateResult | None":
        """Hook 2: return one gradient per tensor from the gradients of K views (operator slot)."""

    @hookspec
    def crossgrad_rate_factor(
        self, rate: "LearningRate", step: int, schedule: "Schedule"
    ) -> float | None:
        """Return a factor for a learning rate of the backbone in a step, not negative.

        All plugins answer this hook, for each block; None means no change. The results are
        multiplied.
        """

    @hookspec
    def crossgrad_after_optimizer(self, context: "AfterStepContext") -> "DensifyResult | None":
        """Return an edit of values after the optimizer and before density control; or None.

        All plugins are called one after another. The set of primitives must not change.
        """

    @hookspec(firstresult=True)
    def crossgrad_densify(self, context: "DensifyContext") -> "DensifyResult | None":
        """Hook 3: return the edit of this step, or NO_EDIT (densifier slot)."""

    @hookspec
    def crossgrad_after_step(self, context: "AfterStepContext") -> "DensifyResult | None":
        """Return an edit (noise, clamps, filters) after optimizer and density control; or None."""

    @hookspec
    def crossgrad_step_done(self, context: "AfterStepContext") -> "Answer | None":
        """Return new plugin states after a complete step, such as an average of the parameters.

        `context.edited` is True if the set of primitives changed in this step, or if density
        control overwrote values.
        """

    @hookspec
    def crossgrad_step_end(self, record: "StepRecord") -> None:
        """Event: the step is complete."""

    @hookspec
    def crossgrad_model_ready(self, model: "Model") -> None:
        """Event: the step is complete. The model is read-only; training time excludes this hook."""

    @hookspec
    def crossgrad_eval_parameters(
        self, states: "Mapping[str, PluginState]", step: int
    ) -> "Mapping[str, Tensor] | None":
        """Return tensors that replace parameters of the same names in evaluations and exports."""

    @hookspec
    def crossgrad_final_edit(self, model: "Model") -> "FinalEdit | None":
        """Return the edit of a finished run, before it is evaluated and exported; or None.

        All plugins are called one after another. `model.parameters` are the parameters that
        evaluations use.
        """

    @hookspec
    def crossgrad_evaluation(self, report: "EvaluationReport") -> None:
        """Event: the test views were evaluated."""

    @hookspec
    def crossgrad_length_changed(self, step: int, total: int) -> None:
        """Event: after `step`, the length of a run with a time budget changed to `total` steps."""

    @hookspec
    def crossgrad_log(self, text: str) -> None:
        """Event: the run reports a message to the user (one line of plain text)."""

    @hookspec
    def crossgrad_run_end(self, status: str) -> None:
        """Event: training is over; status is `finished`, `stopped` or `failed`."""
