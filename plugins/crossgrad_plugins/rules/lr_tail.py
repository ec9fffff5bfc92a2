"""A decay of learning rates at the end of a run.

The published learning rates of opacity, scale and colour are constant, so the parameters still
fluctuate at the end of a run. A decay of these learning rates removes the fluctuations
(docs/steady-ends.md).
"""

from typing_extensions import override

from crossgrad_core.plugin import Backbone, Field, LearningRate, Rule, Scene, Schedule, hookimpl


class LrTail(Rule):
    """Decays the constant learning rates over the last share of the steps."""

    share: float = Field(
        0.25,
        gt=0,
        le=1,
        description="share of the steps, at the end, in which learning rates decay",
    )
    factor: float = Field(
        0.01, gt=0, le=1, description="factor of a learning rate in the last step"
    )

    @hookimpl
    def crossgrad_rate_factor(
        self, rate: LearningRate, step: int, schedule: Schedule
    ) -> float | None:
        """Return the factor of a learning rate, which decays log-linearly from 1 to `factor`.

        Return None for learning rates that already decay.
        """
        total = schedule.total
        step, start = min(step, total), (1.0 - self.share) * total
        if rate.decays or step <= start:
            return None
        return float(self.factor ** ((step - start) / (total - start)))

    @override
    def unused(self, backbone: Backbone, scene: Scene) -> str:
        constant = any(not block.lr.decays for block in backbone.trained_blocks())
        return "" if constant else "the backbone has no constant learning rates"
