"""The command `crossgrad view`: what its arguments name, and the loop that draws."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.commands import (
    RasterizerDemands,
    choose_rasterizer,
    configured,
    evaluated_model,
    merged,
    open_run,
    read_scene,
)
from crossgrad_core.plugin import (
    Exporter,
    Rasterizer,
    Scene,
    Similarity,
    UserError,
    View,
    build_component,
    centers_of,
)
from crossgrad_plugins.view.cameras import first_camera, moved
from crossgrad_plugins.view.server import Viewer
from crossgrad_plugins.view.session import Stage
from crossgrad_plugins.view.sources import Source, frame_of

#: The page draws at most this many cameras and points.
_MOST_CAMERAS, _MOST_POINTS = 1_000, 200_000
#: Length of a drawn camera, as a share of the distance to the next camera and of the scene.
_OF_NEXT, _OF_SCENE = 0.4, 0.03
_CONFIG: Final = "config.yaml"


@dataclass(frozen=True)
class How:
    """Options for opening the things to show.

    Attributes:
        device: Device of the tensors; by default the device of the run, or the CPU.
        threads: CPU threads; all by default.
        accept_scene: Accept a scene whose photos, masks, points or held-out views have changed.
    """

    device: str | None = None
    threads: int | None = None
    accept_scene: bool = False


def stage_of(paths: Sequence[Path], how: How) -> Stage:
    """Return what the viewer shows for one or two runs, PLY files or scenes.

    Raises:
        UserError: A path is nothing of these, or cannot be read.
    """
    opened = [_opened(path, how) for path in paths]
    sources = [source for source, _ in opened]
    scene = next((scene for _, scene in opened if scene is not None), None)
    world = sources[0].similarity if scene is None else scene.similarity
    shows_points = all(source.draw is None for source in sources)
    runs = [path for path in paths if (path / _CONFIG).is_file()]
    command = f"crossgrad render {runs[0]}" if runs else None
    return stage_for(sources, world, scene, command, points=shows_points)


def stage_for(
    sources: list[Source],
    world: Similarity,
    scene: Scene | None,
    command: str | None,
    *,
    points: bool = False,
) -> Stage:
    """Return the stage of opened sources; see `Stage`."""
    views = [] if scene is None else list(scene.views)
    views = views[:: -(-len(views) // _MOST_CAMERAS) or 1]
    cloud = None
    if points and scene is not None:
        kept = slice(None, None, -(-len(scene.points) // _MOST_POINTS) or 1)
        cloud = scene.points[kept], scene.point_colors[kept]
    return Stage(
        sources=lambda: sources,
        world=world,
        views=views,
        first=first_camera(views, np.zeros((0, 3))),
        spacing=_spacing(views),
        points=cloud,
        folder=Path.cwd(),
        command=command,
    )


def _opened(path: Path, how: How) -> tuple[Source, Scene | None]:
    if (path / _CONFIG).is_file():
        given = {"device": how.device, "threads": how.threads}
        machine = {name: value for name, value in given.items() if value is not None}
        setup, state = open_run(path, machine, accept_scene=how.accept_scene)
        title = f"{path}, step {state.step:,}, {state.primitives(setup):,} primitives"
        return Source.of_model(title, evaluated_model(setup, state)), setup.scene
    if path.suffix.lower() == ".ply":
        return _of_file(path, how), None
    if not path.is_dir():
        raise UserError(
            "there is nothing to view",
            where=path,
            expected="the folder of a run, a PLY file of Gaussians, or the folder of a scene",
            todo="check the path",
        )
    settings = {"scene": str(path), "threads": how.threads}
    scene, reader = read_scene(configured(merged(None, settings, [])))
    title = f"{path} ({reader}), {len(scene.views):,} photos, {len(scene.points):,} points"
    return Source.of_scene(title, scene), scene


def _of_file(path: Path, how: How) -> Source:
    """Return the Gaussians of a PLY file, in a frame of about unit size."""
    device = how.device or "cpu"
    exporter = build_component(Exporter, "ply", {})
    positions: NDArray[np.float64] = (
        exporter.read(path, Similarity(np.zeros(3), 1.0)).means.double().numpy()
    )
    similarity = frame_of(positions)
    gaussians = exporter.read(path, similarity).mapped(lambda tensor: tensor.to(device))
    demands = RasterizerDemands(device.partition(":")[0], gaussians.response)
    name, _ = choose_rasterizer("auto", demands)
    title = f"{path}, {len(gaussians):,} Gaussians"
    rasterizer = build_component(Rasterizer, name, {})
    return Source.of_gaussians(title, gaussians, similarity, rasterizer)


def _spacing(views: list[View]) -> float:
    """Return the length of a drawn camera in local units."""
    from scipy.spatial import cKDTree

    centers = centers_of(views)
    if len(centers) < 2:  # noqa: PLR2004 - a camera has no next camera
        return _OF_SCENE
    next_ones = cKDTree(centers).query(centers, k=2)[0][:, 1]
    extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
    return max(min(_OF_NEXT * float(np.median(next_ones)), _OF_SCENE * extent), 1e-4)


def warm_up(stage: Stage) -> None:
    """Draw a small frame with every output, so that kernels are compiled before a window opens."""
    camera = stage.first.resized(64, 36)
    with torch.no_grad():
        for source in stage.sources():
            for outputs in (frozenset(), frozenset({"depth"})):
                if source.draw is not None:
                    source.draw(moved(camera, stage.world, source.similarity), outputs)


def open_viewer(
    *paths: Path | str, host: str = "127.0.0.1", port: int = 8080, how: How | None = None
) -> Viewer:
    """Open one or two runs, PLY files or scenes in a viewer that draws in its own thread.

    A notebook shows the returned viewer inline.

    Args:
        paths: The things to show.
        host: Address to listen on.
        port: Port to listen on; 0 lets the system choose.
        how: Options for opening.

    Raises:
        UserError: A path cannot be read, viser is missing, or the port is taken.
    """
    from threading import Thread

    stage = stage_of([Path(path) for path in paths], how or How())
    warm_up(stage)
    viewer = Viewer(stage, host, port)
    Thread(target=serve, args=(viewer,), daemon=True, name="crossgrad viewer").start()
    return viewer


def serve(viewer: Viewer) -> None:
    """Draw frames until the viewer is closed or the user interrupts the command."""
    while not viewer.closed:
        if not viewer.draw_one():
            viewer.wait(1.0)
