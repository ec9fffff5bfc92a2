"""Functions that read the results of a run, for comparisons of runs.

The module does not import torch, because the import would delay a table of many runs.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from crossgrad_core.errors import UserError
from crossgrad_core.evaluation.result import ViewMetrics
from crossgrad_core.run.results.config_file import FILE as CONFIG
from crossgrad_core.run.results.config_file import read_config
from crossgrad_core.run.results.metrics_csv import FILE as METRICS
from crossgrad_core.run.results.metrics_csv import PER_VIEW, Row, read_metrics, read_per_view
from crossgrad_core.run.results.summary import FILE as SUMMARY
from crossgrad_core.run.results.summary import read_summary
from crossgrad_core.system.checksums import check_unchanged
from crossgrad_core.system.text_files import read_json

#: File with the fingerprint of a run's scene. The module results/scene_file.py writes this file.
SCENE = "scene.json"
#: The files of a run that this module reads.
_READ: Final = (CONFIG, METRICS, PER_VIEW, SUMMARY, SCENE)


@dataclass(frozen=True)
class RunResults:
    """The results in a run's folder.

    Attributes:
        folder: The folder.
        config: The resolved configuration as plain data.
        rows: The rows of metrics.csv in order.
        summary: The content of summary.json; None if the run has not ended yet.
        views: The metrics of each held-out view; empty before the run has ended.
    """

    folder: Path
    config: Mapping[str, Any]
    rows: tuple[Row, ...]
    summary: Mapping[str, Any] | None
    views: tuple[ViewMetrics, ...] = ()

    @cached_property
    def regimes(self) -> tuple[str, ...]:
        """Names of the regimes of the held-out views; empty before the run has ended."""
        return tuple((self.summary or {}).get("regimes") or ())

    @cached_property
    def scene_marks(self) -> Mapping[str, Any] | None:
        """The content of scene.json, which describes all views of the scene; None for older runs.

        Raises:
            UserError: The file is damaged.
        """
        try:
            marks = read_json(self.folder / SCENE)
        except FileNotFoundError:
            return None
        except ValueError:
            marks = None
        if isinstance(marks, dict) and isinstance(marks.get("views"), dict):
            return marks
        raise UserError(
            "scene.json cannot be read",
            where=self.folder / SCENE,
            expected="the views of the scene, with the fingerprints of their photos",
            todo="restore the file, or repeat the run: crossgrad run --config config.yaml",
        )

    def figure(self, name: str, regime: str | None = None) -> float | None:
        """Return a metric of the last evaluation, overall or of one regime; None if missing."""
        summary = self.summary or {}
        of = summary.get("overall") if regime is None else summary.get("regimes", {}).get(regime)
        value = (of or {}).get(name)
        return float(value) if isinstance(value, int | float) else None

    def curve(
        self, name: str, regime: str | None = None, over: str = "train_seconds"
    ) -> list[tuple[float, float]]:
        """Return the pairs (`over`, metric) of all evaluations that contain both values."""
        column = name if regime is None else f"{name}_{regime}"
        points = [(row.get(over), row.get(column)) for row in self.rows]
        return [(float(x), float(y)) for x, y in points if x is not None and y is not None]


def read_run(folder: Path) -> RunResults:
    """Return the results of a run, which may still be training, without importing torch.

    Raises:
        UserError: The folder is not a run, or one of its files is damaged.
    """
    check_unchanged(
        folder, _READ, f"restore the file, or repair it with crossgrad run --resume {folder}"
    )
    summary = read_summary(folder) if (folder / SUMMARY).is_file() else None
    views = () if summary is None else read_per_view(folder)
    return RunResults(folder, read_config(folder), read_metrics(folder), summary, views)


def find_runs(root: Path) -> tuple[Path, ...]:
    """Return the folders of runs at or below a folder, sorted, without importing torch."""
    return tuple(sorted(path.parent for path in root.rglob(CONFIG)))
