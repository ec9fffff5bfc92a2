"""Evaluation of a trained run: on its held-out views, of a file, or on another capture."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from crossgrad_core.errors import UserError
from crossgrad_core.evaluation.evaluation import evaluate as measured
from crossgrad_core.evaluation.result import EvaluationResult, ViewMetrics
from crossgrad_core.run.export import plain_renderer, renderer
from crossgrad_core.run.load_run import require_checkpoint
from crossgrad_core.run.postprocess.cross_capture import Elsewhere, elsewhere
from crossgrad_core.run.postprocess.drawn_file import DrawnFile
from crossgrad_core.run.postprocess.open_options import AS_IT_IS, Opens
from crossgrad_core.run.postprocess.output_paths import is_changed, own_name, writing_if_possible
from crossgrad_core.run.results.metrics_csv import PER_VIEW, Totals, read_per_view, write_per_view
from crossgrad_core.run.results.panels import ending
from crossgrad_core.run.results.sources import name_for
from crossgrad_core.run.results.summary import final_table, metric_lines
from crossgrad_core.run.session import totals
from crossgrad_core.system.checksums import relisted
from crossgrad_core.wording import listed

_LOG = logging.getLogger(__name__)


def evaluate(
    folder: Path,
    how: Opens = AS_IT_IS,
    file: DrawnFile | None = None,
    on: Path | None = None,
) -> None:
    """Evaluate the held-out views of a run again, or other views; print the table.

    Args:
        folder: The run's folder.
        how: The options for opening the run.
        file: A file whose Gaussians are rendered instead of the run's model.
        on: Another capture of the place; its views are rendered instead of the held-out views.

    Raises:
        UserError: See `evaluated`, `evaluated_file` and `evaluated_on`.
    """
    if file is not None:
        result, gaussians, capture = evaluated_file(folder, file, how, on)
        line = f"{gaussians:,} Gaussians of {file.path}, rendered on black {file.manner}"
        print(  # noqa: T201
            "\n".join([*metric_lines(result), line, *(capture.messages() if capture else ())])
        )
    elif on is not None:
        result, there = evaluated_on(folder, on, how)
        print("\n".join([*metric_lines(result), *there.messages()]))  # noqa: T201
    else:
        print(final_table(*evaluated(folder, how)))  # noqa: T201


def evaluated_on(
    folder: Path, on: Path, how: Opens = AS_IT_IS
) -> tuple[EvaluationResult, Elsewhere]:
    """Evaluate a run on another capture of its place; write per_view_on_<name>.csv.

    Views that the run was trained on are left out. Renders have no exposure, because the exposure
    of other photos is unknown.

    Args:
        folder: The run's folder.
        on: The other scene, in the coordinates of the run's scene.
        how: The options for opening the run.

    Raises:
        UserError: The folder is not a run, or the run has no checkpoint; see also `elsewhere`.
    """
    require_checkpoint(folder)
    with writing_if_possible(folder, "evaluating") as writes:
        setup, state = how.open(folder)
        there = elsewhere(setup, on)
        draw, points = plain_renderer(setup, state), there.points
        result = measured(there.views, draw, setup.metrics, points=points)
        if writes:
            name = name_for(folder, ending(there.name), on)
            file = f"per_view_on_{name}.csv"
            with relisted(folder, file):
                write_per_view(folder, result, file)
        return result, there


def evaluated_file(
    folder: Path, file: DrawnFile, how: Opens = AS_IT_IS, on: Path | None = None
) -> tuple[EvaluationResult, int, Elsewhere | None]:
    """Evaluate the Gaussians of a file on the held-out views of a run, with the run's exposures.

    Nothing is written.

    Args:
        folder: The run's folder.
        file: The file, and the rules by which it is drawn.
        how: The options for opening the run.
        on: Another capture of the place, whose views are rendered instead, without exposures (see
            `evaluated_on`).

    Returns:
        The metrics, the number of Gaussians, and the other capture if there is one.

    Raises:
        UserError: The folder is not a run, the run has no checkpoint, or the file cannot be read;
            see also `elsewhere`.
    """
    require_checkpoint(folder)
    setup, state = how.open(folder)
    gaussians = file.gaussians(setup)
    if on is None:
        there, views, points = None, setup.scene.test_views, setup.scene.points
    else:
        there = elsewhere(setup, on)
        views, points = there.views, there.points
    draw = file.drawer(setup, gaussians, None if there else state)
    return measured(views, draw, setup.metrics, points=points), len(gaussians), there


def evaluated(folder: Path, how: Opens = AS_IT_IS) -> tuple[EvaluationResult, Totals]:
    """Evaluate the held-out views of a run again, and rewrite per_view.csv.

    The results get another file name if the scene has changed, or if summary.json describes another
    step. Nothing is written if the run is training, if the folder is not writable, or if
    per_view.csv has values that cannot be measured here.

    Raises:
        UserError: The folder is not a run, or the run has no checkpoint.
    """
    # Check before taking the lock, because a folder of another kind must not be changed.
    require_checkpoint(folder)
    with writing_if_possible(folder, "evaluating") as writes:
        setup, state = how.open(folder)
        draw, points = renderer(setup, state), setup.scene.points
        result = measured(setup.scene.test_views, draw, setup.metrics, points=points)
        if writes:
            name = own_name(folder, PER_VIEW, state.step)
            name = name.replace(".", "_accepted.") if is_changed(setup) else name
            if name != PER_VIEW or not _loses_figures(folder, result):
                with relisted(folder, name):
                    write_per_view(folder, result, name)
        # The peak memory of this process is not the peak memory of the run.
        return result, replace(totals(setup, state), peak_memory_mib=None)


def _loses_figures(folder: Path, result: EvaluationResult) -> bool:
    """Return True, with a warning, if per_view.csv has values that could not be measured now."""
    try:
        before = read_per_view(folder)
    except UserError:  # A damaged file is replaced.
        return False
    lost = _known(before) - _known(result.views)
    if lost:
        _LOG.warning(
            "%s was not changed: it contains metrics that were not computed here (%s)",
            PER_VIEW,
            listed(sorted(lost)),
        )
    return bool(lost)


def _known(views: Sequence[ViewMetrics]) -> set[str]:
    """Return the names of the metrics that have a value for some view."""
    return {name for view in views for name, value in view.values.items() if value is not None}
