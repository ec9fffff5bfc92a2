"""Writing the trained scene as a standard PLY, and what that costs where it is an approximation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Camera, View
from crossgrad_core.contract.state import Json
from crossgrad_core.errors import UserError
from crossgrad_core.evaluation.evaluation import evaluate
from crossgrad_core.ply.cloud import SplatCloud
from crossgrad_core.ply.file import write_ply
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.views import eval_background


@dataclass(frozen=True)
class Exported:
    """What is in a PLY.

    Attributes:
        gaussians: Number of Gaussians.
        baked_for: The view that it was baked for, `N training views` on average, or None where
            nothing had to be baked.
        views: Views on which it was compared with the live model: the one that it was baked for,
            else the held-out ones.
        psnr: dB, mean over these views of the file's Gaussians, drawn again; None where nothing was
            baked or there are no such views.
        live_psnr: dB, the same of the live model.
        notes: What the user should know about the file.
    """

    gaussians: int
    baked_for: str | None = None
    views: int = 0
    psnr: float | None = None
    live_psnr: float | None = None
    notes: tuple[str, ...] = ()

    @property
    def loss(self) -> float | None:
        """What baking costs, dB."""
        if self.psnr is None or self.live_psnr is None:
            return None
        return self.live_psnr - self.psnr

    def as_data(self) -> dict[str, Json]:
        """For summary.json."""
        return {
            "gaussians": self.gaussians,
            "baked_for": self.baked_for,
            "views": self.views,
            "psnr": self.psnr,
            "live_psnr": self.live_psnr,
            "loss": self.loss,
        }


def export_ply(setup: Setup, state: TrainState, path: Path, camera: str | None = None) -> Exported:
    """Writes the standard PLY in the coordinates of the input.

    Args:
        setup: The run.
        state: Its state.
        path: The file.
        camera: Name of the view to bake what depends on the view for; None takes the average over
            the training views.

    Raises:
        UserError: There is no view of that name, or the file cannot be written.
    """
    phase = setup.phase(state.step, training=False)
    view = None if camera is None else view_named(setup, camera)
    views = setup.train_views if view is None else (view,)
    with torch.no_grad():
        cameras = [each.camera for each in views]
        cloud = SplatCloud.from_gaussians(setup.backbone.bake(state.parameters, phase, cameras))
    comments = (f"crossgrad step {state.step}",)
    notes = write_ply(path, cloud, setup.scene.similarity, comments)
    if setup.backbone.plain:
        return Exported(len(cloud), notes=notes)
    compared = setup.scene.test_views if view is None else (view,)
    drawn = drawer(setup, cloud.to_gaussians())
    return Exported(
        gaussians=len(cloud),
        baked_for=camera or f"{len(views)} training views",
        views=len(compared),
        psnr=evaluate(compared, drawn).overall.psnr,
        live_psnr=evaluate(compared, renderer(setup, state)).overall.psnr,
        notes=notes,
    )


def view_named(setup: Setup, name: str) -> View:
    """The view of that name.

    Raises:
        UserError: There is none.
    """
    for view in setup.scene.views:
        if view.name == name:
            return view
    names = [view.name for view in setup.scene.views]
    raise UserError(
        f"the scene has no view {name!r}",
        where="--camera",
        expected=f"one of {len(names)} names such as {names[0]}",
        todo="per_view.csv lists the held-out views",
    )


def renderer(setup: Setup, state: TrainState) -> Callable[[View], Tensor]:
    """Renders a view with the current parameters as an evaluation does."""
    through = camera_renderer(setup, state)
    return lambda view: through(view.camera)


def camera_renderer(setup: Setup, state: TrainState) -> Callable[[Camera], Tensor]:
    """Renders what any camera sees with the current parameters as an evaluation does."""
    background = eval_background(setup)
    phase = setup.phase(state.step, training=False)

    def render_one(camera: Camera) -> Tensor:
        gaussians = setup.backbone.decode(state.parameters, camera, phase)
        return setup.rasterizer.render(gaussians, camera, background).image

    return render_one


def drawer(setup: Setup, gaussians: Gaussians) -> Callable[[View], Tensor]:
    """Renders a view of Gaussians that are the same for every camera."""
    background = eval_background(setup)
    moved = gaussians.mapped(lambda tensor: tensor.to(setup.device))

    def render_one(view: View) -> Tensor:
        return setup.rasterizer.render(moved, view.camera, background).image

    return render_one


def described(exported: Exported, path: Path) -> Sequence[str]:
    """Lines for the user about a PLY."""
    lines = [*exported.notes]
    if exported.loss is not None:
        lines.append(
            f"{path.name}: baked for {exported.baked_for}; drawn again it has "
            f"{exported.psnr:.2f} dB, the live model {exported.live_psnr:.2f} dB "
            f"(loss {exported.loss:.2f} dB, {exported.views} views)"
        )
    return lines
