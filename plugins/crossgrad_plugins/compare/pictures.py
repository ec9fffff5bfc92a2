"""The worst held-out views side by side, as small pictures inside the page."""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from crossgrad_core.commands import UserError, panels_of, read_panel
from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.run import Run

if TYPE_CHECKING:
    from PIL.Image import Image

#: Limits of the page: number of views of all scenes, of views per scene, of arms per view, and of
#: bytes.
MOST_VIEWS, MOST_OF_A_SCENE, MOST_ARMS = 8, 3, 6
MOST_BYTES: Final = 1_400_000
_WIDTHS: Final = (320, 260, 200, 150)
_QUALITY: Final = 72


@dataclass(frozen=True)
class Picture:
    """A picture of the page.

    Attributes:
        arm: The arm that rendered the picture, or `photo` for the photo.
        figure: The main metric of the view as text; empty for the photo.
        render: The picture as a data URL for an image element.
        error: The error picture as a data URL; empty for the photo.
    """

    arm: str
    figure: str
    render: str
    error: str = ""


@dataclass(frozen=True)
class WorstView:
    """A held-out view.

    Attributes:
        scene: Name of the scene.
        name: Name of the view.
        regime: Regime of the view.
        mean: The main metric, averaged over arms and seeds.
        by_arm: Arm -> the main metric, averaged over seeds.
        pictures: The photo and the arms' renders of one seed; empty if no pictures are shown.
    """

    scene: str
    name: str
    regime: str
    mean: float
    by_arm: Mapping[str, float]
    pictures: tuple[Picture, ...] = ()


def worst_views(comparison: Comparison) -> dict[str, list[WorstView]]:
    """Return the held-out views of each scene, worst first, without pictures."""
    by_scene: dict[str, list[WorstView]] = {}
    for scene in comparison.scenes:
        values: dict[tuple[str, str], dict[str, list[float]]] = {}
        for arm, by in comparison.main.items():
            for (at, _), run in by.items():
                for view in run.results.views if at == scene else ():
                    value = view.values.get(comparison.quantity.name)
                    if value is not None and np.isfinite(value):
                        arm_values = values.setdefault((view.name, view.regime), {})
                        arm_values.setdefault(arm, []).append(value)
        views = [_view(scene, *view, by_arm) for view, by_arm in values.items()]
        sign = -1.0 if comparison.quantity.falls else 1.0
        by_scene[scene] = sorted(views, key=lambda view: sign * view.mean)
    return by_scene


def _view(scene: str, name: str, regime: str, values: Mapping[str, Sequence[float]]) -> WorstView:
    means = {arm: float(np.mean(arm_values)) for arm, arm_values in values.items()}
    return WorstView(scene, name, regime, float(np.mean(list(means.values()))), means)


def with_pictures(
    comparison: Comparison, views: Mapping[str, Sequence[WorstView]]
) -> tuple[list[WorstView], list[str]]:
    """Return the worst views of each scene with pictures, and notes about unreadable pictures.

    A view is included only if all runs that are shown have stored its pictures. The pictures are
    reduced until all of them fit into the page.
    """
    shown: list[tuple[WorstView, list[tuple[str, Run]]]] = []
    share = min(MOST_OF_A_SCENE, max(1, MOST_VIEWS // max(1, len(views))))
    for scene, scene_views in views.items():
        runs = _runs_of(comparison, scene)
        kept = {run.name: _paths(run) for _, run in runs}
        drawn = [
            view for view in scene_views if runs and all(view.name in kept[r.name] for _, r in runs)
        ]
        shown += [(view, runs) for view in drawn[:share]]
    for width in _WIDTHS:
        notes: list[str] = []
        pictured = [_pictured(comparison, view, runs, width, notes) for view, runs in shown]
        size = sum(len(p.render) + len(p.error) for view in pictured for p in view.pictures)
        if size <= MOST_BYTES:
            break
    return [view for view in pictured if view.pictures], list(dict.fromkeys(notes))


def _runs_of(comparison: Comparison, scene: str) -> list[tuple[str, Run]]:
    """Return the best arms on a scene, with one run each.

    All returned runs have the lowest seed that these arms have in common.
    """
    arms = [
        arm for arm in comparison.ranking if any(at == scene for at, _ in comparison.main[arm])
    ][:MOST_ARMS]
    seeds = [{seed for at, seed in comparison.main[arm] if at == scene} for arm in arms]
    shared = set.intersection(*seeds) if seeds else set()
    return [(arm, comparison.main[arm][scene, min(shared)]) for arm in arms] if shared else []


def _paths(run: Run) -> "Mapping[str, object]":
    step = int(run.number("step") or 0)
    return panels_of(run.results.folder, step, [view.name for view in run.results.views])


def _pictured(
    comparison: Comparison,
    view: WorstView,
    runs: Sequence[tuple[str, Run]],
    width: int,
    notes: list[str],
) -> WorstView:
    pictures: list[Picture] = []
    for arm, run in runs:
        step = int(run.number("step") or 0)
        names = [run_view.name for run_view in run.results.views]
        try:
            panel = read_panel(panels_of(run.results.folder, step, names)[view.name])
        except UserError as error:
            notes.append(f"{error.what}: {error.where}")
            return view
        if not pictures:
            pictures.append(Picture("photo", "", _data(panel["photo"], width)))
        value = next(v.values.get(comparison.quantity.name) for v in run.results.views
                     if v.name == view.name)  # fmt: skip
        figure = "" if value is None else f"{comparison.quantity.shown(value)}"
        figure = f"{figure} {comparison.quantity.unit}".strip()
        pictures.append(
            Picture(arm, figure, _data(panel["render"], width), _data(panel["error"], width))
        )
    return WorstView(view.scene, view.name, view.regime, view.mean, view.by_arm, tuple(pictures))


def _data(image: "Image", width: int) -> str:
    """Return an image, at most `width` pixels wide, as JPEG data for an image element."""
    from PIL.Image import Resampling

    height = max(1, round(image.height * min(1.0, width / image.width)))
    small = image.resize((min(width, image.width), height), Resampling.LANCZOS)
    buffer = io.BytesIO()
    small.save(buffer, format="jpeg", quality=_QUALITY, optimize=True)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}"
