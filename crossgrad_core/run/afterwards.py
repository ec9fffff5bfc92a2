"""Evaluation, renders and exports of a run that was trained."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import torch

from crossgrad_core.contract.exporter import Exporter
from crossgrad_core.contract.georeference import INPUT, check_coordinates
from crossgrad_core.defaults import EXPORTER
from crossgrad_core.errors import UserError
from crossgrad_core.evaluation.evaluation import evaluate as measured
from crossgrad_core.evaluation.result import EvaluationResult, ViewMetrics
from crossgrad_core.registry.entries import build, find
from crossgrad_core.run.elsewhere import Elsewhere, elsewhere
from crossgrad_core.run.export import (
    Exported,
    camera_renderer,
    described,
    drawer,
    export_scene,
    georef_of,
    plain_drawer,
    plain_renderer,
    renderer,
)
from crossgrad_core.run.flight import FRAMES, LADDER, flight
from crossgrad_core.run.opening import opened, require_checkpoint
from crossgrad_core.run.results.film import (
    ENCODER,
    drop_frames,
    film_files,
    write_film,
    write_frames,
)
from crossgrad_core.run.results.lock import RunInUseError, locked
from crossgrad_core.run.results.panel_layout import folder_of
from crossgrad_core.run.results.panel_names import ending, flat_names
from crossgrad_core.run.results.panels import PanelWriter
from crossgrad_core.run.results.per_view import FILE as PER_VIEW
from crossgrad_core.run.results.per_view import read_per_view, write_per_view
from crossgrad_core.run.results.scene_file import ACCEPTED
from crossgrad_core.run.results.sources import name_for
from crossgrad_core.run.results.summary import summarised_step
from crossgrad_core.run.results.table import final_table, metric_lines
from crossgrad_core.run.results.totals import Totals
from crossgrad_core.run.session import CLOUD, totals
from crossgrad_core.system.writability import check_file, check_folder, check_new
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.wording import listed

_LOG = logging.getLogger(__name__)
#: Files of Gaussians by the names that programs give them: none holds what another one's says.
_OF_FORMATS = frozenset({".ply", ".splat", ".ksplat", ".spz", ".sog", ".rad", ".usdz"})


class Opens(Protocol):
    """A way of opening a run."""

    def open(self, folder: Path) -> tuple[Setup, TrainState]:
        """The run's setup and its newest state."""
        ...


@dataclass(frozen=True)
class How:
    """How a run is opened.

    Attributes:
        device: Where tensors live; the run's own by default.
        threads: CPU threads; all by default.
        accept_scene: Take a scene of which photos, masks, points or held-out views have changed.
    """

    device: str | None = None
    threads: int | None = None
    accept_scene: bool = False

    def open(self, folder: Path) -> tuple[Setup, TrainState]:
        """The run's setup and its newest state."""
        given = {"device": self.device, "threads": self.threads}
        machine = {name: value for name, value in given.items() if value is not None}
        return opened(folder, machine, accept_scene=self.accept_scene)


#: On the run's own device, with all threads and its own scene.
AS_IT_IS = How()


def evaluate(
    folder: Path, how: Opens = AS_IT_IS, ply: Path | None = None, on: Path | None = None
) -> None:
    """Evaluates the held-out views of a run again, or others; prints the table.

    Args:
        folder: The run's folder.
        how: How the run is opened.
        ply: A file that is drawn instead of the run's model.
        on: Another capture of the place, whose views are drawn instead of the held-out ones.

    Raises:
        UserError: See `evaluated`, `evaluated_file` and `evaluated_on`.
    """
    if ply is not None:
        result, gaussians, place = evaluated_file(folder, ply, how, on)
        told = f"{gaussians:,} Gaussians of {ply}, drawn on black as viewers draw them"
        print("\n".join([*metric_lines(result), told, *_told_of(place)]))  # noqa: T201
    elif on is not None:
        result, there = evaluated_on(folder, on, how)
        print("\n".join([*metric_lines(result), *_told_of(there)]))  # noqa: T201
    else:
        print(final_table(*evaluated(folder, how)))  # noqa: T201


def evaluated_on(
    folder: Path, on: Path, how: Opens = AS_IT_IS
) -> tuple[EvaluationResult, Elsewhere]:
    """Evaluates a run on another capture of its place; writes per_view_on_<name>.csv.

    Views that the run was trained on are left out. Renders have no exposure: nothing is known of
    those of other photos.

    Args:
        folder: The run's folder.
        on: The other scene, in the coordinates of the run's.
        how: How the run is opened.

    Raises:
        UserError: See `elsewhere`; or it is no run, or it has no checkpoint.
    """
    require_checkpoint(folder)
    with _writing_if_possible(folder, "evaluating") as writes:
        setup, state = how.open(folder)
        there = elsewhere(setup, on)
        draw, points = plain_renderer(setup, state), there.points
        result = measured(there.views, draw, setup.metrics, points=points)
        if writes:
            name = name_for(folder, ending(there.name), on)
            write_per_view(folder, result, f"per_view_on_{name}.csv")
        return result, there


def _told_of(there: Elsewhere | None) -> list[str]:
    if there is None or not there.trained:
        return []
    return [f"left out: {there.trained} of its views that the run was trained on"]


def evaluated_file(
    folder: Path, ply: Path, how: Opens = AS_IT_IS, on: Path | None = None
) -> tuple[EvaluationResult, int, Elsewhere | None]:
    """Evaluates Gaussians of a PLY on the held-out views of a run, exposures of the run included.

    Nothing is written.

    Args:
        folder: The run's folder.
        ply: The file, in the coordinates of the scene's input; this or another program wrote it.
        how: How the run is opened.
        on: Another capture of the place, whose views are drawn instead, without exposures; see
            `evaluated_on`.

    Returns:
        The figures, the number of Gaussians, and the other capture where there is one.

    Raises:
        UserError: It is no run, it has no checkpoint, or the file cannot be read; see also
            `elsewhere`.
    """
    require_checkpoint(folder)
    setup, state = how.open(folder)
    gaussians = build(Exporter, EXPORTER, {}).read(ply, setup.scene.similarity)
    if on is None:
        there, views, points = None, setup.scene.test_views, setup.scene.points
        draw = drawer(setup, state, gaussians)
    else:
        there = elsewhere(setup, on)
        views, points, draw = there.views, there.points, plain_drawer(setup, gaussians)
    return measured(views, draw, setup.metrics, points=points), len(gaussians), there


def evaluated(folder: Path, how: Opens = AS_IT_IS) -> tuple[EvaluationResult, Totals]:
    """Evaluates the held-out views of a run again and renews per_view.csv, if they are its own.

    The folder of a run that is training, and one that may not be written to, is only read; so is
    one whose per_view.csv has figures that cannot be measured here.

    Raises:
        UserError: It is no run, or it has no checkpoint.
    """
    require_checkpoint(folder)  # Before a lock is laid into a folder that is no run's.
    with _writing_if_possible(folder, "evaluating") as writes:
        setup, state = how.open(folder)
        draw, points = renderer(setup, state), setup.scene.points
        result = measured(setup.scene.test_views, draw, setup.metrics, points=points)
        if writes:
            name = _own_name(folder, PER_VIEW, state.step)
            name = name.replace(".", "_accepted.") if _is_changed(setup) else name
            if name != PER_VIEW or not _loses_figures(folder, result):
                write_per_view(folder, result, name)
        return result, replace(totals(setup, state), peak_memory_mib=None)  # It is not the run's.


def _loses_figures(folder: Path, result: EvaluationResult) -> bool:
    """Whether per_view.csv has figures that could not be measured now; then says that it stays."""
    try:
        before = read_per_view(folder)
    except UserError:  # A damaged one is written anew.
        return False
    lost = _known(before) - _known(result.views)
    if lost:
        _LOG.warning("%s stays as it is: %s not measured here", PER_VIEW, listed(sorted(lost)))
    return bool(lost)


def _known(views: Sequence[ViewMetrics]) -> set[str]:
    """The figures that some view has."""
    return {name for view in views for name, value in view.values.items() if value is not None}


def render(
    folder: Path,
    *,
    split: str,
    out: Path | None,
    how: Opens = AS_IT_IS,
    on: Path | None = None,
) -> None:
    """Draws photo | render | error of the views of a run, or of another capture of its place.

    Args:
        folder: The run's folder.
        split: Which of its views: test, train or all.
        out: Where the pictures go; by default into the run's folder.
        how: How the run is opened.
        on: The other capture, whose views are drawn instead; see `evaluated_on`.

    Raises:
        UserError: It is no run, it has no checkpoint, the split is empty, the named folder holds a
            picture of that name, or it is training and none is named; see also `elsewhere`.
    """
    with _writing(folder, out, "rendering"):
        check_folder(out or folder)
        setup, state = how.open(folder)
        scene, draw = setup.scene, renderer(setup, state)
        views = {"test": scene.test_views, "train": scene.train_views, "all": scene.views}[split]
        own = folder_of(folder, state.step) / ("accepted" if _is_changed(setup) else "")
        if on is not None:
            there, draw = elsewhere(setup, on), plain_renderer(setup, state)
            views = there.views
            if out is None:
                own /= f"on_{name_for(folder, ending(there.name), on)}"
        if not views:
            raise UserError(
                "there are no views to render",
                where=f"--split {split}",
                todo="choose another --split: train, test or all",
            )
        writer = PanelWriter.of(folder, state.step, views, len(views))
        writer = replace(writer, folder=out or own)
        if out is not None:
            check_new(*(out / f"{file}.png" for file in writer.files.values()))
        measured(views, draw, setup.metrics, on_view=writer.write)
        print(f"{len(views)} panels in {writer.folder}")  # noqa: T201


def fly(
    folder: Path,
    path: str,
    *,
    frames: int | None = None,
    out: Path | None,
    how: Opens = AS_IT_IS,
) -> None:
    """Draws what cameras along a path see, as pictures and, beside them, as a film.

    Args:
        folder: The run's folder.
        path: See `flight`.
        frames: How many a ladder has, `FRAMES` by default.
        out: Where the pictures go; by default into the run's folder.
        how: How the run is opened.

    Raises:
        UserError: See `flight`; or it is no run, it has no checkpoint, it is training and no other
            folder is named, the named one holds a film or such frames, or there are frames for a
            path from a file.
    """
    if frames is not None and path != LADDER:
        raise UserError(
            "--frames is the number of frames of a ladder; a camera path has its own",
            where=f"--path {path}",
            todo=f"leave out --frames, or draw --path {LADDER}",
        )
    with _writing(folder, out, "rendering"):
        check_folder(out or folder)
        check_new(*(() if out is None else film_files(out)))
        setup, state = how.open(folder)
        along = flight(setup.scene, path, frames or FRAMES)
        if out is not None:
            check_new(*(out / f"{number:05d}.png" for number in range(len(along.cameras))))
        draw, own = camera_renderer(setup, state), out is None
        if out is None:
            name = ending(along.name)
            name = name if path == LADDER else name_for(folder, name, Path(path))
            out = folder_of(folder, state.step) / f"path_{name}"
        with torch.no_grad():
            files = write_frames(map(draw, along.cameras), out)
        if own:
            drop_frames(out, len(files))
        made = write_film(files, along.fps)
        for film in film_files(out) if own else ():
            if film != made:  # Of other frames.
                film.unlink(missing_ok=True)
        told = f"film {made}" if made else f"no film: too many or too large without {ENCODER}"
        print(f"{len(files)} frames in {out}, {told}")  # noqa: T201


def export(
    folder: Path,
    *,
    file_format: str | None,
    out: Path | None,
    camera: str | None = None,
    coordinates: str = INPUT,
    how: Opens = AS_IT_IS,
) -> None:
    """As `exported`; prints what is in the file."""
    path, content = exported(
        folder, file_format=file_format, out=out, camera=camera, coordinates=coordinates, how=how
    )
    for line in described(content, path):
        print(line)  # noqa: T201
    print(f"{content.gaussians:,} Gaussians in {path}")  # noqa: T201


def exported(
    folder: Path,
    *,
    file_format: str | None,
    out: Path | None,
    camera: str | None = None,
    coordinates: str = INPUT,
    how: Opens = AS_IT_IS,
) -> tuple[Path, Exported]:
    """Writes the trained scene to a file that viewers open.

    Args:
        folder: The run's folder.
        file_format: Name of an exporter; None takes the run's own.
        out: The file; by default one in the run's folder that summary.json does not describe as
            something else.
        camera: Name of the view to bake for; by default the average over the training views.
        coordinates: Of the file, as `check_coordinates` takes them.
        how: How the run is opened.

    Returns:
        The file and what is in it.

    Raises:
        UserError: There is no such format, it is no run, it has no checkpoint, the file exists,
            there is no such view or nothing to bake for it, the scene cannot be put into these
            coordinates, or the run is training and no other file is named.
    """
    check_coordinates(coordinates)
    if file_format is not None:
        find("exporters", file_format)
    with _writing(folder, out, "exporting"):
        if out is not None:
            check_new(out, georef_of(out))
            check_file(out)
        setup, state = how.open(folder)
        exporter = setup.selection.exporter  # With the run's own options, where it is the run's.
        if file_format not in {None, setup.selection.names["exporter"]}:
            exporter = build(Exporter, str(file_format), {})
        if out is not None and out.suffix.lower() in _OF_FORMATS - {f".{exporter.suffix}"}:
            raise UserError(
                "the file is named as one of another format",
                where=f"--out {out}",
                expected=f"a name that ends in .{exporter.suffix}",
                todo="rename it, or choose another --format (`crossgrad plugins list` shows them)",
            )
        if camera is not None and setup.backbone.plain:
            raise UserError(
                f"backbone {setup.selection.names['backbone']} has nothing to bake for a view",
                where="--camera",
                todo="leave it out: the file is the same for every view",
            )
        words = [CLOUD] if camera is None else [CLOUD, _flat(setup, camera)]
        words += [] if coordinates == INPUT else [coordinates.replace(":", "-")]
        name = f"{'_'.join(words)}.{exporter.suffix}"
        if words == [CLOUD]:
            path = out or folder / _own_name(folder, name, state.step)
        else:
            path = out or folder / name
            check_new(path)
        return path, export_scene(setup, state, path, camera, exporter, coordinates)


@contextmanager
def _writing_if_possible(folder: Path, doing: str) -> Iterator[bool]:
    """Locks the run's folder, or says why it is only read; answers which."""
    with ExitStack() as stack:
        try:
            stack.enter_context(locked(folder, doing))
        except UserError as error:
            found = f" ({error.found})" if error.found else ""
            _LOG.warning("%s%s: results are shown, and none is written there", error.what, found)
            yield False
        else:
            yield True


@contextmanager
def _writing(folder: Path, out: Path | None, doing: str) -> Iterator[None]:
    """Locks the run's folder, unless what is written goes elsewhere."""
    require_checkpoint(folder)  # Before a lock is laid into a folder that is no run's.
    if out is not None:
        yield
        return
    try:
        with locked(folder, doing):
            yield
    except RunInUseError as error:
        raise UserError(
            error.what, where=error.where, found=error.found, todo="name another place with --out"
        ) from error


def _is_changed(setup: Setup) -> bool:
    """Whether the scene is not that of the run: what summary.json describes is left alone."""
    return any(note.startswith(ACCEPTED) for note in setup.scene.notes)


def _own_name(folder: Path, name: str, step: int) -> str:
    """A file name for results of a step, other than that of a file which describes another one.

    The run may have gone on, and been killed, after summary.json and its files were written.
    """
    described = summarised_step(folder)
    if described in {None, step}:
        return name
    path = Path(name)
    return f"{path.stem}_step-{step:06d}{path.suffix}"


def _flat(setup: Setup, camera: str) -> str:
    """The view's name as a part of a file name; that of no view as it is, to be refused later."""
    return flat_names([view.name for view in setup.scene.views]).get(camera, "view")
