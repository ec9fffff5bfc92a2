"""The class `Run`, which reads the metrics, views and files of a trained run.

Reading metrics does not import torch; methods that render import torch.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.run.checkpoint import CHECKPOINTS, named_checkpoints
from crossgrad_core.run.results.config_file import read_config
from crossgrad_core.run.results.metrics_csv import read_metrics
from crossgrad_core.run.results.summary import read_summary

if TYPE_CHECKING:
    from crossgrad_core.contract.scene import Camera, Scene
    from crossgrad_core.evaluation.result import EvaluationResult
    from crossgrad_core.training.setup import Setup
    from crossgrad_core.training.state import TrainState

#: Column name -> [E] numbers, which are integers if all numbers of the column are integers.
Columns: TypeAlias = dict[str, NDArray[np.float64] | NDArray[np.int64]]


class Run:
    """A run and its folder.

    The properties `metrics` and `summary` read the files again at each access, so that a program
    can watch a run while it trains. The scene and the newest checkpoint are loaded at their first
    use and then kept in memory.

    Args:
        folder: The run's folder.
        device: Device of the tensors; by default the device of the run.
        threads: Number of CPU threads; all by default.
        accept_scene: Accept a scene whose photos, masks, points or held-out views have changed.
    """

    def __init__(
        self,
        folder: Path | str,
        *,
        device: str | None = None,
        threads: int | None = None,
        accept_scene: bool = False,
    ) -> None:
        self.folder = Path(folder).resolve()
        self._opened = _Opened(device, threads, accept_scene)

    @override
    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"

    @property
    def metrics(self) -> "Columns":
        """Column of metrics.csv -> one number per evaluation; NaN for a missing value.

        Raises:
            UserError: metrics.csv does not exist, or it does not contain numbers.
        """
        rows = read_metrics(self.folder)
        names = list(rows[0]) if rows else []
        return {name: _column([row[name] for row in rows]) for name in names}

    @property
    def summary(self) -> dict[str, Any]:
        """The content of summary.json.

        Raises:
            UserError: The file does not exist, because the run has not ended or its process was
                killed.
        """
        return read_summary(self.folder)

    @property
    def scene(self) -> "Scene":
        """The scene of the run, in its local frame.

        Raises:
            UserError: The scene cannot be read, or the run was trained on another scene.
        """
        return self._open()[0].scene

    def render(self, view: "str | Camera") -> NDArray[np.float32]:
        """Render the image of a camera like an evaluation, but without rounding to 8 bits.

        Args:
            view: Name of a view of the scene, or a camera in the scene's local frame, such as
                `run.scene.views[0].camera`.

        Returns:
            [H, W, 3] image with values in [0, 1].

        Raises:
            UserError: There is no view of that name, `view` is not a valid camera, or the run has
                no checkpoint.
        """
        import torch

        from crossgrad_core.run.app import as_in_a_command
        from crossgrad_core.run.camera_path import checked_camera
        from crossgrad_core.run.export import camera_renderer, renderer, view_named

        setup, state = self._open()
        with as_in_a_command(), torch.no_grad():
            if isinstance(view, str):
                image = renderer(setup, state)(view_named(setup, view, "Run.render"))
            else:
                image = camera_renderer(setup, state)(checked_camera(view))
            return np.asarray(image.clamp(0.0, 1.0).cpu().numpy(), dtype=np.float32)

    def evaluate(self) -> "EvaluationResult":
        """Evaluate the held-out views again and rewrite per_view.csv, as `crossgrad eval` does.

        Raises:
            UserError: The run has no checkpoint, or its scene has changed.
        """
        from crossgrad_core.run.app import as_in_a_command
        from crossgrad_core.run.postprocess.evaluate import evaluated

        with as_in_a_command():
            return evaluated(self.folder, self._opened)[0]

    def export(
        self, path: Path | str, camera: str | None = None, coordinates: str = "input"
    ) -> Path:
        """Write the trained scene with the run's exporter, as `crossgrad export` does.

        Args:
            path: Path of the output file.
            camera: Name of the view for which view-dependent values are baked; by default, the
                values are averaged over the training views.
            coordinates: input, local, enu, utm or epsg:N (docs/coordinates.md).

        Returns:
            The file.

        Raises:
            UserError: The file exists or cannot be written, there is no such view, the scene is not
                georeferenced, or the run has no checkpoint.
        """
        from crossgrad_core.run.app import as_in_a_command
        from crossgrad_core.run.export import ExportOptions
        from crossgrad_core.run.postprocess.export import exported

        with as_in_a_command():
            out = Path(path)
            exported(
                self.folder,
                out=out,
                options=ExportOptions(camera=camera, coordinates=coordinates),
                how=self._opened,
            )
            return out

    def _open(self) -> "tuple[Setup, TrainState]":
        from crossgrad_core.run.app import as_in_a_command
        from crossgrad_core.run.load_run import require_checkpoint

        require_checkpoint(self.folder)
        with as_in_a_command():
            return self._opened.open(self.folder)


def open(  # noqa: A001 - users call it as `cg.open`
    folder: Path | str,
    *,
    device: str | None = None,
    threads: int | None = None,
    accept_scene: bool = False,
) -> Run:
    """Open a run that has been trained or is still training.

    Args:
        folder: The run's folder.
        device: Device of the tensors; by default the device of the run.
        threads: Number of CPU threads; all by default.
        accept_scene: Accept a scene whose photos, masks, points or held-out views have changed.

    Raises:
        UserError: The folder is not a run.
    """
    read_config(Path(folder))
    return Run(folder, device=device, threads=threads, accept_scene=accept_scene)


def _column(numbers: Sequence[float | None]) -> NDArray[np.float64] | NDArray[np.int64]:
    if all(isinstance(number, int) for number in numbers):
        return np.array(numbers, dtype=np.int64)
    return np.array(numbers, dtype=np.float64)


class _Opened:
    """A cache of one opened run, which is loaded again if there is a newer checkpoint."""

    def __init__(self, device: str | None, threads: int | None, accept_scene: bool) -> None:
        self._how = device, threads, accept_scene
        self._kept: tuple[int, tuple[Setup, TrainState]] | None = None

    def open(self, folder: Path) -> "tuple[Setup, TrainState]":
        """Return the run's setup and its newest state."""
        from crossgrad_core.run.postprocess.open_options import How

        newest = max(named_checkpoints(folder / CHECKPOINTS), default=0)
        if self._kept is None or self._kept[0] != newest:
            self._kept = newest, How(*self._how).open(folder)
        return self._kept[1]
