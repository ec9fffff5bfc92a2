"""The class that writes the results of a run during training and at the end."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from time import perf_counter

from crossgrad_core.contract.contexts import EvaluationReport
from crossgrad_core.contract.slots.exporter import Exporter
from crossgrad_core.defaults import PAGE_EXPORTER
from crossgrad_core.errors import UserError
from crossgrad_core.evaluation.evaluation import evaluate
from crossgrad_core.evaluation.result import EvaluationResult
from crossgrad_core.run.checkpoint import Keep, drop_later, latest, renew_scalars, save
from crossgrad_core.run.export import Exported, described, export_scene, renderer, write_page
from crossgrad_core.run.load_run import to_checkpoint
from crossgrad_core.run.results.curve import draw_curve
from crossgrad_core.run.results.kept import KEY as KEPT
from crossgrad_core.run.results.kept import kept_files
from crossgrad_core.run.results.machine import Machine, environment
from crossgrad_core.run.results.metrics_csv import (
    MetricsCsv,
    Totals,
    columns_for,
    metrics_row,
    read_metrics,
    write_per_view,
)
from crossgrad_core.run.results.panels import PanelWriter
from crossgrad_core.run.results.summary import Status, Summary, write_summary
from crossgrad_core.system.files import remove
from crossgrad_core.training.memory import peak_mebibytes
from crossgrad_core.training.per_image_params import PHOTO_VALUES, write_photos
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

#: Name of the file with the trained scene, for viewers. The exporter adds the suffix.
CLOUD = "point_cloud"
#: Name of the page that shows a small scene in a browser.
PAGE = f"{CLOUD}.{PAGE_EXPORTER}"
#: Number of held-out views for which panels are rendered.
PANELS = 4


class Session:
    """A writer of the files in a run's folder; the training loop calls its methods.

    Args:
        folder: The run's folder.
        table: The metrics.csv of the run.

    Attributes:
        machine: Records the load of the machine while the run trains.
    """

    def __init__(self, folder: Path, table: MetricsCsv) -> None:
        self.folder = folder
        self.machine = Machine()
        self._table = table
        self._result: tuple[int, EvaluationResult] | None = None
        self._exports: dict[str, Exported] = {}
        self._saved_step = -1
        self._evaluated_step = -1

    @classmethod
    def fresh(cls, folder: Path, setup: Setup) -> "Session":
        """Return the session of a new run."""
        return cls(folder, MetricsCsv.create(folder, columns_of(setup)))

    @classmethod
    def resumed(cls, folder: Path, setup: Setup, step: int) -> "Session":
        """Return the session of a run that continues after `step`."""
        session = cls(folder, MetricsCsv.resume(folder, columns_of(setup), step))
        session._saved_step = step
        rows = read_metrics(folder)
        if rows:
            session._evaluated_step = int(rows[-1]["step"] or 0)
        return session

    def has_row(self, step: int) -> bool:
        """Return True if metrics.csv contains a row of a step or of a later step."""
        return self._evaluated_step >= step

    def result(self, step: int) -> EvaluationResult | None:
        """Return the results of the evaluation after a step; None without an evaluation."""
        return self._result[1] if self._result is not None and self._result[0] == step else None

    def evaluate(self, setup: Setup, state: TrainState, panels: int = 0) -> None:
        """Evaluate the held-out views, add a row to metrics.csv, and draw up to `panels` panels."""
        self._require_folder()
        start = perf_counter()
        writer = None
        if panels > 0:
            views = setup.scene.test_views
            writer = PanelWriter.of(self.folder, state.step, views, panels)
        draw = renderer(setup, state)
        result = evaluate(
            setup.scene.test_views,
            draw,
            setup.metrics,
            on_view=None if writer is None else writer.write,
            points=setup.scene.points,
        )
        state.clock.evaluate += perf_counter() - start
        self._result = (state.step, result)
        if self._evaluated_step == state.step:
            return
        row = metrics_row(totals(setup, state), result)
        self._table.append(row)
        self._evaluated_step = state.step
        if self._saved_step == state.step:
            renew_scalars(latest(self.folder), {KEPT: kept_files(self.folder)})
        report = EvaluationReport(state.step, row, tuple(result.regimes), draw)
        setup.hook.crossgrad_evaluation(report=report)

    def save(self, setup: Setup, state: TrainState) -> None:
        """Write a checkpoint, unless a checkpoint of this step exists."""
        if self._saved_step == state.step:
            return
        self._require_folder()
        with reporting(state):
            checkpoint = to_checkpoint(state, setup.config)
            scalars = {**checkpoint.scalars, KEPT: kept_files(self.folder)}
            every = None if "save_every" in setup.config.decided else setup.numbers.save_every
            keep = Keep(every=every)
            save(self.folder, replace(checkpoint, scalars=scalars), keep)
        self._saved_step = state.step

    @property
    def gone(self) -> bool:
        """True if the run's folder was moved or removed during the run."""
        return not self.folder.is_dir()

    def _require_folder(self) -> None:
        """Raise an error if the run's folder was moved or removed.

        Raises:
            UserError: The folder does not exist.
        """
        if self.gone:
            raise UserError(
                "the folder of the run no longer exists",
                where=self.folder,
                expected="the folder that the run was started in",
                todo="if the folder was moved, resume the run in its new folder: `crossgrad run "
                "--resume FOLDER`",
            )

    def rewind(self, setup: Setup, step: int) -> None:
        """Delete rows and checkpoints after `step`, to which training was rolled back."""
        self._table = MetricsCsv.resume(self.folder, columns_of(setup), step)
        drop_later(self.folder, step)
        self._saved_step = self._evaluated_step = -1

    def renew(self, setup: Setup, step: int) -> None:
        """Delete the row of `step` and allow a new save, because the state has changed."""
        if self.has_row(step):
            self._table = MetricsCsv.resume(self.folder, columns_of(setup), step - 1)
        self._saved_step = self._evaluated_step = -1

    def align(self, setup: Setup, state: TrainState) -> None:
        """Delete rows and checkpoints of steps after the state's step."""
        if max(self._saved_step, self._evaluated_step) > state.step:
            self.rewind(setup, state.step)

    def write_views(self, state: TrainState) -> None:
        """Write per_view.csv if the state was evaluated."""
        result = self.result(state.step)
        if result is not None:
            write_per_view(self.folder, result)

    def draw(self, setup: Setup, state: TrainState) -> None:
        """Draw curve.png if there are rows to draw."""
        rows = read_metrics(self.folder)
        if rows:
            with reporting(state):
                counts = view_counts(setup, self.result(state.step))
                draw_curve(self.folder, rows, title(setup), counts)

    def export(self, setup: Setup, state: TrainState) -> None:
        """Write the trained scene and log a description of the file.

        A model that lost all its primitives has no file; the run reports the loss.
        """
        if state.primitives(setup) == 0:
            return
        path = self.folder / cloud_name(setup.selection.exporter)
        with reporting(state):
            if path.is_dir():
                remove(path)  # A folder of an earlier step of the run.
            self._exports = {path.name: export_scene(setup, state, path)}
            write_photos(setup, state, self.folder / PHOTO_VALUES)
        for line in described(self._exports[path.name], path):
            setup.hook.crossgrad_log(text=line)

    def write_page(self, setup: Setup, state: TrainState) -> None:
        """Write a page that shows the exported scene, if it is small; see `export.write_page`."""
        if not self._exports or setup.selection.names["exporter"] == PAGE_EXPORTER:
            return
        (exported,) = self._exports.values()
        with reporting(state):
            page = write_page(setup, state, self.folder / PAGE, exported.gaussians)
        if page is not None:
            self._exports[PAGE] = page

    def summarise(
        self, setup: Setup, state: TrainState, status: Status, error: str | None = None
    ) -> None:
        """Write summary.json."""
        with reporting(state):
            machine = self.machine.figures(state.clock.train)
        summary = Summary(
            status=status,
            scene=setup.scene.name,
            totals=totals(setup, state),
            result=self.result(state.step),
            exports={name: exported.as_data() for name, exported in self._exports.items()},
            rows=read_metrics(self.folder),
            seconds=state.clock,
            config=setup.config.model_dump(mode="json"),
            environment={**environment(str(setup.device)), **machine},
            notes=setup.notes,
            decisions=setup.decisions,
            check=setup.scene.check,
            error=error,
        )
        write_summary(self.folder, summary)


def cloud_name(exporter: Exporter) -> str:
    """Return the name of the file or folder to which a run exports its scene."""
    return f"{CLOUD}.{exporter.suffix}" if exporter.suffix else CLOUD


@contextmanager
def reporting(state: TrainState) -> Iterator[None]:
    """Add the duration of the block to the reporting time."""
    start = perf_counter()
    yield
    state.clock.report += perf_counter() - start


def totals(setup: Setup, state: TrainState) -> Totals:
    """Return the cost of the run so far."""
    losses = state.last.losses if state.last is not None else ()
    return Totals(
        step=state.step,
        views=state.counters.views,
        backward_passes=state.counters.backward_passes,
        train_seconds=state.clock.train,
        primitives=state.primitives(setup),
        peak_memory_mib=peak_mebibytes(setup.device),
        loss=sum(losses) / len(losses) if losses else None,
        cpu_seconds=state.clock.cpu,
        peak_primitives=max(state.counters.peak_primitives, state.primitives(setup)),
    )


def regimes_of(setup: Setup) -> list[str]:
    """Return the sorted regimes of the held-out views."""
    return sorted({view.regime for view in setup.scene.test_views})


def columns_of(setup: Setup) -> tuple[str, ...]:
    """Return the columns of metrics.csv."""
    return columns_for(regimes_of(setup), [metric.figure for metric in setup.metrics])


def view_counts(setup: Setup, result: EvaluationResult | None) -> dict[str, int]:
    """Return the number of held-out views, overall and per regime.

    After an evaluation, only views with metrics count.
    """
    if result is not None:
        regimes = {regime: means.views for regime, means in result.regimes.items()}
        return {"overall": result.overall.views, **regimes}
    views = setup.scene.test_views
    counts = {regime: sum(v.regime == regime for v in views) for regime in regimes_of(setup)}
    return {"overall": len(views), **counts}


def title(setup: Setup) -> str:
    """Return the title of the curve."""
    names = setup.selection.names
    parts = f"{names['backbone']}, {names['sampler']}, {names['operator']}"
    return f"{setup.scene.name}: {parts}, K = {setup.selection.views}"
