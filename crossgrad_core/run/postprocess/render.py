"""Pictures and videos of a trained run."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Final

import torch
from torch import Tensor

from crossgrad_core.errors import UserError
from crossgrad_core.evaluation.evaluation import evaluate as measured
from crossgrad_core.run.camera_path import FRAMES, ZOOM, camera_path
from crossgrad_core.run.checkpoint import CHECKPOINTS, load, named_checkpoints
from crossgrad_core.run.export import camera_renderer, plain_renderer, renderer
from crossgrad_core.run.load_run import from_checkpoint
from crossgrad_core.run.postprocess.cross_capture import elsewhere
from crossgrad_core.run.postprocess.drawn_file import DrawnFile
from crossgrad_core.run.postprocess.open_options import AS_IT_IS, Opens
from crossgrad_core.run.postprocess.output_paths import is_changed, writing
from crossgrad_core.run.results.panels import PanelWriter, ending, folder_of
from crossgrad_core.run.results.sources import name_for
from crossgrad_core.run.results.video import (
    ENCODER,
    drop_frames,
    video_files,
    write_frames,
    write_video,
)
from crossgrad_core.system.check_writable import check_folder, check_new
from crossgrad_core.system.checksums import relisted
from crossgrad_core.system.files import clear_leftovers
from crossgrad_core.wording import count, one_line

#: Least number of checkpoints of a video of the training, and how many it shows per second.
_FEWEST: Final = 2
_CHECKPOINTS_PER_SECOND: Final = 4.0


def render(
    folder: Path,
    *,
    split: str,
    out: Path | None,
    how: Opens = AS_IT_IS,
    on: Path | None = None,
    file: DrawnFile | None = None,
) -> None:
    """Write panels with photo, render and error of the views of a run or of another capture.

    Args:
        folder: The run's folder.
        split: The views to render: test, train or all.
        out: Folder of the pictures; by default a folder inside the run's folder.
        how: The options for opening the run.
        on: Folder of another capture of the same place, whose views are rendered instead of the
            run's views.
        file: A file whose Gaussians are rendered instead of the run's model.

    Raises:
        UserError: The folder is not a run, the run has no checkpoint, or the split is empty. Also
            if `out` already contains a picture of the same name, or if the run is training and
            `out` is not given. See also `elsewhere`.
    """
    with writing(folder, out, "rendering"):
        check_folder(out or folder)
        setup, state = how.open(folder)
        scene, draw, messages = setup.scene, renderer(setup, state), list[str]()
        views = {"test": scene.test_views, "train": scene.train_views, "all": scene.views}[split]
        default_folder = folder_of(folder, state.step) / ("accepted" if is_changed(setup) else "")
        if on is not None:
            there, draw = elsewhere(setup, on), plain_renderer(setup, state)
            messages = there.messages()
            views = there.views
            if out is None:
                default_folder /= f"on_{name_for(folder, ending(there.name), on)}"
        if file is not None:
            draw = file.drawer(setup, file.gaussians(setup), None if on else state)
            if out is None:
                default_folder /= f"of_{name_for(folder, file.path.name, file.path)}"
                default_folder /= file.viewer or ""
        if not views:
            raise UserError(
                "there are no views to render",
                where=f"--split {split}",
                todo="choose another --split: train, test or all",
            )
        writer = PanelWriter.of(folder, state.step, views, len(views))
        writer = replace(writer, folder=out or default_folder)
        if out is not None:
            check_new(*(out / f"{file}.png" for file in writer.files.values()))
        clear_leftovers(writer.folder, shared=True)
        with relisted(folder, *(() if out else (_below(folder, default_folder),))):
            measured(views, draw, setup.metrics, on_view=writer.write)
        print("\n".join([*messages, f"{count(len(views), 'panel')} in {one_line(writer.folder)}"]))  # noqa: T201


def render_path(
    folder: Path,
    path: str,
    *,
    frames: int | None = None,
    out: Path | None,
    how: Opens = AS_IT_IS,
) -> None:
    """Render the cameras along a path, and write images and a video to the same folder.

    Args:
        folder: The run's folder.
        path: See `camera_path`.
        frames: Number of frames of a zoom path, `FRAMES` by default.
        out: Folder of the pictures; by default a folder inside the run's folder.
        how: The options for opening the run.

    Raises:
        UserError: See `camera_path`. Also if the folder is not a run, the run has no checkpoint, or
            the run is training and `out` is not given. Also if `out` already contains a video or
            frames of the same names, or if `frames` is given for a path from a file.
    """
    if frames is not None and path != ZOOM:
        raise UserError(
            "--frames applies only to a zoom path; a camera path from a file defines its "
            "own frames",
            where=f"--path {path}",
            todo=f"leave out --frames, or use --path {ZOOM}",
        )
    with writing(folder, out, "rendering"):
        check_folder(out or folder)
        check_new(*(() if out is None else video_files(out)))
        setup, state = how.open(folder)
        along = camera_path(setup.scene, path, frames or FRAMES)
        if out is not None:
            check_new(*(out / f"{number:05d}.png" for number in range(len(along.cameras))))
            clear_leftovers(out, shared=True)
        draw, is_default_folder = camera_renderer(setup, state), out is None
        if out is None:
            name = ending(along.name)
            name = name if path == ZOOM else name_for(folder, name, Path(path))
            out = folder_of(folder, state.step) / f"path_{name}"
        with relisted(folder, *((_below(folder, out),) if is_default_folder else ())):
            _write_video(map(draw, along.cameras), along.fps, out, replaces=is_default_folder)


def render_evolution(folder: Path, *, out: Path | None, how: Opens = AS_IT_IS) -> None:
    """Render the first held-out view at each kept checkpoint, as images and as a video.

    Args:
        folder: The run's folder.
        out: Folder of the pictures; by default a folder inside the run's folder.
        how: The options for opening the run.

    Raises:
        UserError: The run has fewer than two checkpoints, the folder is not a run, the run is
            training and `out` is not given, or `out` already contains a video or such frames.
    """
    with writing(folder, out, "rendering"):
        check_folder(out or folder)
        kept = named_checkpoints(folder / CHECKPOINTS)
        if len(kept) < _FEWEST:
            raise UserError(
                "a video of the training needs at least two checkpoints",
                where=folder / CHECKPOINTS,
                found=count(len(kept), "checkpoint"),
                todo="train the run again with --save-every N, which keeps the checkpoint of every "
                "N-th step",
            )
        frames = () if out is None else (out / f"{number:05d}.png" for number in range(len(kept)))
        check_new(*(() if out is None else (*video_files(out), *frames)))
        setup, state = how.open(folder)
        view = (setup.scene.test_views or setup.train_views)[0]
        is_default_folder = out is None
        out = out or folder_of(folder, state.step) / "evolution"
        clear_leftovers(out, shared=True)
        states = (from_checkpoint(setup, load(checkpoint)) for checkpoint in kept.values())
        images = (renderer(setup, each)(view) for each in states)
        with relisted(folder, *((_below(folder, out),) if is_default_folder else ())):
            _write_video(images, _CHECKPOINTS_PER_SECOND, out, replaces=is_default_folder)


def _write_video(images: Iterable[Tensor], fps: float, out: Path, *, replaces: bool) -> None:
    """Write frames and a video, and print where they are.

    Args:
        images: Images [H, W, 3].
        fps: Frames per second.
        out: The folder.
        replaces: True if frames and videos of an earlier call are replaced.
    """
    with torch.no_grad():
        files = write_frames(images, out)
    if replaces:
        drop_frames(out, len(files))
    made = write_video(files, fps)
    for video in video_files(out) if replaces else ():
        if video != made:  # The existing frames belong to another video.
            video.unlink(missing_ok=True)
    video_line = (
        f"video {made}"
        if made
        else (
            "no video was written: there are too many frames, or they are too large "
            f"without {ENCODER}"
        )
    )
    print(f"{count(len(files), 'frame')} in {one_line(out)}, {one_line(video_line)}")  # noqa: T201


def _below(folder: Path, path: Path) -> str:
    return path.relative_to(folder).as_posix()
