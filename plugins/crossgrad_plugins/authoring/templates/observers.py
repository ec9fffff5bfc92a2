"""An observer of a run."""

import logging

from crossgrad_core.plugin import Field, Observer, StepRecord, hookimpl

_LOG = logging.getLogger(__name__)


class Template(Observer):
    """Logs the loss now and then."""

    every: int = Field(100, ge=1, description="steps between lines")

    @hookimpl
    def crossgrad_step_end(self, record: StepRecord) -> None:
        """Logs where it is time."""
        if record.step % self.every == 0:
            _LOG.info("step %d: losses %s", record.step, record.losses)
