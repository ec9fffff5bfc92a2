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
    check_frame,
    choose_rasterizer,
    configured,
    evaluated_model,
    exporter_for,
    merged,
    open_run,
    read_scene,
)
from crossgrad_core.plugin import (
    Rasterizer,
    Scene,
    Similarity,
    UserError,
    build_component,
)
from crossgrad_plugins.view.cameras import free_camera, moved
from crossgrad_plugins.view.server import Viewer
from crossgrad_plugins.view.session import Stage
from crossgrad_plugins.view.sources import Source, frame_of

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
    """Return what the viewer shows for one or two runs, files of Gaussians or scenes.

    Raises:
        UserError: A path is nothing of these, or cannot be read.
    """
    opened = [_opened(path, how) for path in paths]
    if any(scene is not None for _, scene in opened):
        for path in filter(Path.is_file, paths):
            check_frame(path)
    sources = [source for source, _ in opened]
    scene = next((scene for _, scene in opened if scene is not None), None)
    world = sources[0].similarity if scene is None else scene.similarity
    runs = [path for path in paths if (path / _CONFIG).is_file()]
    command = f"crossgrad render {runs[0]}" if runs else None
    return Stage(lambda: sources, world, scene, command)


def _opened(path: Path, how: How) -> tuple[Source, Scene | None]:
    if (path / _CONFIG).is_file():
        given = {"device": how.device, "threads": how.threads}
        machine = {name: value for name, value in given.items() if value is not None}
        setup, state = open_run(path, machine, accept_scene=how.accept_scene)
        title = f"{path}, step {state.step:,}, {state.primitives(setup):,} primitives"
        return Source.of_model(title, evaluated_model(setup, state)), setup.scene
    if path.is_file():
        return _of_file(path, how), None
    if not path.is_dir():
        raise UserError(
            "there is nothing to view",
            where=path,
            expected="the folder of a run, a file of Gaussians, or the folder of a scene",
            todo="check the path",
        )
    settings = {"scene": str(path), "threads": how.threads}
    scene, reader = read_scene(configured(merged(None, settings, [])))
    title = f"{path} ({reader}), {len(scene.views):,} photos, {len(scene.points):,} points"
    return Source.of_scene(title, scene), scene


def _of_file(path: Path, how: How) -> Source:
    """Return the Gaussians of a file, in a frame of about unit size."""
    device = how.device or "cpu"
    exporter = exporter_for(path)
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


def warm_up(stage: Stage) -> None:
    """Draw a small frame with every output, so that kernels are compiled before a window opens."""
    camera = free_camera().resized(64, 36)
    with torch.no_grad():
        for source in stage.sources():
            for outputs in (frozenset(), frozenset({"depth"})):
                if source.draw is not None:
                    source.draw(moved(camera, stage.world, source.similarity), outputs)


def open_viewer(
    *paths: Path | str, host: str = "127.0.0.1", port: int = 8080, how: How | None = None
) -> Viewer:
    """Open one or two runs, files of Gaussians or scenes in a viewer that draws in its own thread.

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
