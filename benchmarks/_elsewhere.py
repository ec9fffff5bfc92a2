"""Evaluate runs on another capture of the same place.

The metrics are stored together with their origin.
"""

import csv
import json
import sys
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from crossgrad_core.commands import UserError, configured, fingerprint, read_scene, write_atomically
from crossgrad_core.run.postprocess import evaluate
from crossgrad_core.run.postprocess.open_options import How
from crossgrad_core.run.results.metrics_csv import write_per_view
from crossgrad_core.scene.fingerprint import mark_of
from crossgrad_core.system.text_files import read_json
from crossgrad_plugins.compare.run import Run

if TYPE_CHECKING:
    from crossgrad_core.contract.scene import Scene

#: Origin of a table, stored in a JSON file beside the table.
Origin: TypeAlias = dict[str, object]
PLY = "point_cloud.ply"


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture of a place.

    Attributes:
        path: Folder of the capture.
        scene: The scene, without held-out views.
        digest: Fingerprint of the scene for this size of photos, which does not depend on its path.
    """

    path: Path
    scene: "Scene"
    digest: str

    @classmethod
    def read(cls, path: Path, max_size: int) -> "Capture":
        """Read the capture in a folder.

        Raises:
            UserError: The capture cannot be read.
        """
        reading = {"split": "none", "max_size": max_size}
        config = configured({"scene": path, "data": reading})
        scene, _ = read_scene(config)
        return cls(path, scene, fingerprint(scene, config))


@dataclass(frozen=True)
class Table:
    """The metric values of a run on the views of another capture, with one row per view.

    Attributes:
        run: The evaluated run.
        capture: The capture that gives the views.
        file: True to draw the PLY of the run on black, False to draw the model.
    """

    run: Run
    capture: Capture
    file: bool = False

    @property
    def path(self) -> Path:
        """The path of the table that `crossgrad eval RUN --on SCENE` writes."""
        what = "of_ply_on" if self.file else "on"
        return self.run.results.folder / f"per_view_{what}_{self.capture.path.absolute().name}.csv"

    @property
    def is_unmarked(self) -> bool:
        """True if the table has no record of its origin, as after a plain `crossgrad eval`."""
        return self._origin() is None

    def figures(self, name: str) -> dict[str, float]:
        """Return the metric value of each photo.

        The run is evaluated again if the origin of the table is another one.

        Raises:
            UserError: The metric does not exist, or the run cannot be evaluated.
        """
        if not self.path.is_file() or not self._is_of_this():
            self._evaluate()
        rows = self._rows()
        columns = list(rows[0]) if rows else []
        if name not in columns:
            raise no_figure(name, [each for each in columns if each not in {"name", "regime"}])
        return {row["name"]: float(row[name]) for row in rows if row[name]}

    def _rows(self) -> list[dict[str, str]]:
        with self.path.open(encoding="utf-8", newline="") as lines:
            return list(csv.DictReader(lines))

    def _is_of_this(self) -> bool:
        origin = self._origin()
        if origin is not None:
            return all(origin.get(key) == value for key, value in self._wanted().items())
        # Old tables have no record of their origin. They are accepted only if the run cannot be
        # evaluated again.
        views = {view.name for view in self.capture.scene.views}
        return not self._has_checkpoint() and all(row["name"] in views for row in self._rows())

    def _origin(self) -> Origin | None:
        """Return the origin of the table; None if the record is missing or outdated."""
        path = self.path.with_suffix(".json")
        if not path.is_file():
            return None
        found = read_json(path)
        written = isinstance(found, dict) and found.get("table") == _digest(self.path)
        return dict(found) if isinstance(found, dict) and written else None

    def _wanted(self) -> Origin:
        """Return the origin that the table must have; without the PLY if the file is missing."""
        wanted: Origin = {"scene": self.capture.digest, "step": self.run.number("step")}
        ply = self.run.results.folder / PLY
        if self.file and ply.is_file():
            wanted["ply"] = mark_of(ply).model_dump()
        return wanted

    def _has_checkpoint(self) -> bool:
        return any(self.run.results.folder.glob("checkpoints/step-*"))

    def _evaluate(self) -> None:
        folder, on = self.run.results.folder, self.capture.path
        if self.path.is_file() and not self._has_checkpoint():
            raise UserError(
                "the saved metrics of this run were measured on other views, or at another step",
                where=self.path,
                expected=f"figures on {on} at step {self.run.number('step'):,.0f}",
                found="a run without checkpoints, which cannot be evaluated again",
                todo="name the scene of the table with --on, or leave out the run's arm",
            )
        print(folder, file=sys.stderr, flush=True)
        how = How(threads=1)
        if self.file:
            result = evaluate.evaluated_file(folder, folder / PLY, how, on)[0]
        else:
            result = evaluate.evaluated_on(folder, on, how)[0]
        write_per_view(folder, result, self.path.name)
        origin = {**self._wanted(), "table": _digest(self.path)}
        write_atomically(self.path.with_suffix(".json"), f"{json.dumps(origin)}\n".encode())


def no_figure(name: str, offered: list[str]) -> UserError:
    """Return the error for an unknown metric, with the names of the available metrics."""
    return UserError(
        "unknown metric",
        where="--figure",
        expected=f"one of {', '.join(offered)}" if offered else "a figure that all runs measure",
        found=name,
        todo="copy a name, or repeat the runs with it: crossgrad run --metrics NAME",
    )


def _digest(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest()
