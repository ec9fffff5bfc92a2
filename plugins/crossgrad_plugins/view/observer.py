"""The observer of `crossgrad run --view`: it shows a run in a browser while the run trains."""

import logging
import sys
from collections.abc import Callable
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING

from pydantic import Field, PrivateAttr
from typing_extensions import override

from crossgrad_core.plugin import (
    BetweenSteps,
    Camera,
    EvaluationReport,
    Model,
    Observer,
    Pace,
    Render,
    RunInfo,
    StepRecord,
    UserError,
    hookimpl,
    progress_line,
)

if TYPE_CHECKING:
    from crossgrad_plugins.view.server import Viewer
    from crossgrad_plugins.view.session import Stage
    from crossgrad_plugins.view.sources import Source
    from crossgrad_plugins.view.training import Training

_LOG = logging.getLogger(__name__)
#: Largest drawing time that is saved up while no frame is due, in seconds, and longest wait of a
#: paused run before it looks for requests.
_SAVED, _WAIT = 0.2, 0.1


def _no_model(_camera: Camera, _outputs: frozenset[str]) -> Render:
    """Stand for the model outside of the calls that draw."""
    raise RuntimeError("a frame can only be drawn between two steps")


class LiveViewer(Observer):
    """Shows a run in a browser while it trains, within a share of the training time.

    Frames are drawn between two steps by the thread that trains. The viewer ends with the run.
    """

    host: str = Field("127.0.0.1", description="address to listen on")
    port: int = Field(8080, ge=0, le=65_535, description="port; 0: the system chooses")
    share: float = Field(
        0.05, gt=0.0, le=1.0, description="largest drawing time as a share of the training time"
    )

    # The state of the display. It is not part of the run's state.
    _viewer: "Viewer | None" = PrivateAttr(default=None)
    _training: "Training | None" = PrivateAttr(default=None)
    _source: "Source" = PrivateAttr()
    _pace: Pace = PrivateAttr(default_factory=lambda: Pace(1))
    _trained: float | None = PrivateAttr(default=None)
    _allowed: float = PrivateAttr(default=_SAVED)

    @override
    def check(self) -> None:
        from crossgrad_plugins.view.server import check_address, check_viser

        check_viser()
        check_address(self.host, self.port)

    @hookimpl
    def crossgrad_run_start(self, run: RunInfo) -> None:
        """Start the server; the page shows the cameras until the first step is done."""
        from crossgrad_plugins.view.server import Viewer

        try:
            self._viewer = Viewer(self._stage(run), self.host, self.port)
        except UserError as error:
            _LOG.warning("no viewer: %s", error)
            return
        self._pace = Pace(run.schedule.total)
        sys.stderr.write(f"viewer at {self._viewer.url}\n")
        sys.stderr.flush()

    def _stage(self, run: RunInfo) -> "Stage":
        from crossgrad_plugins.view.session import Stage
        from crossgrad_plugins.view.sources import Source
        from crossgrad_plugins.view.training import Training

        self._training = Training(text="the first step is not done yet")
        scene = run.scene
        title = f"{scene.name} in training" if run.folder is None else f"{run.folder} in training"
        self._source = replace(Source.of_scene(title, scene), draw=_no_model)
        command = None if run.folder is None else f"crossgrad render {run.folder}"
        return Stage(lambda: [self._source], scene.similarity, scene, command, self._training)

    @hookimpl
    def crossgrad_step_end(self, record: StepRecord) -> None:
        """Update the progress, and add a share of the step's time to the drawing time."""
        if self._viewer is None or self._training is None:
            return
        self._pace = self._pace.after(record)
        before = self._trained or record.train_seconds
        self._trained = record.train_seconds
        earned = self.share * (record.train_seconds - before)
        self._allowed = min(_SAVED, self._allowed + earned)
        self._training.add_loss(record.step, sum(record.losses) / len(record.losses))
        self._source = replace(self._source, version=record.step)

    @hookimpl
    def crossgrad_length_changed(self, total: int) -> None:
        """Show the new number of steps."""
        self._pace = self._pace.with_length(total)

    @hookimpl
    def crossgrad_evaluation(self, report: EvaluationReport) -> None:
        """Add the PSNR of the held-out views to its curve."""
        psnr = report.row.get("psnr")
        if self._training is not None and isinstance(psnr, int | float):
            self._training.scores.append((float(report.step), float(psnr)))

    @hookimpl
    def crossgrad_between_steps(self, model: Callable[[], Model]) -> BetweenSteps | None:
        """Draw a frame if there is time for it; a paused run draws without a limit."""
        viewer, training = self._viewer, self._training
        if viewer is None or training is None:
            return None
        if training.stopping:
            return "stop"
        if viewer.connected and (training.paused or self._allowed > 0.0):
            begun = perf_counter()
            try:
                self._draw(viewer, training, model)
            except Exception as error:  # An observer must not end a run.
                _LOG.warning("the viewer ended: %s: %s", type(error).__name__, error)
                self.crossgrad_run_end("failed")
                return None
            self._allowed -= 0.0 if training.paused else perf_counter() - begun
        if training.paused:
            viewer.wait(_WAIT)
            return "pause"
        return None

    def _draw(self, viewer: "Viewer", training: "Training", model: Callable[[], Model]) -> None:
        from crossgrad_plugins.view.sources import Source

        training.text = progress_line(self._pace)
        viewer.refresh()
        if viewer.is_due:
            self._source = Source.of_model(self._source.title, model())
            viewer.draw_one(lossless=training.paused)
            # The source must not keep the parameters, because density control replaces them.
            self._source = replace(self._source, draw=_no_model)

    @hookimpl
    def crossgrad_run_end(self, status: str) -> None:
        """End the server."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
