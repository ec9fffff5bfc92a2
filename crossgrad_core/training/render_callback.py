"""Renders of training views that a plugin asks for."""

from dataclasses import dataclass

from torch import Tensor

from crossgrad_core.contract.contexts import RequestedRender
from crossgrad_core.errors import UserError
from crossgrad_core.training.per_image_params import apply
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.strided_rendering import as_in_full
from crossgrad_core.training.view_target import eval_background, target_at, weights_of


@dataclass(frozen=True, eq=False)
class RenderCallback:
    """Renders training views with the parameters as they are; a `RenderOnRequest`.

    Attributes:
        setup: The run.
        state: Its state.
        counted: Whether the renders are counted among the rendered views.
    """

    setup: Setup
    state: TrainState
    counted: bool

    def __call__(
        self,
        view: int,
        scale: float = 1.0,
        outputs: frozenset[str] = frozenset(),
        background: Tensor | None = None,
    ) -> RequestedRender:
        """See `RenderOnRequest`.

        Raises:
            UserError: There is no such view, or the scale is out of bounds.
        """
        setup, state = self.setup, self.state
        _check(setup, view, scale)
        state.counters.views += self.counted
        target = target_at(setup, state, view, scale)
        gaussians = setup.backbone.decode(
            state.parameters, target.camera, setup.phase(state.step, training=True)
        )
        gaussians = as_in_full(gaussians, setup.rasterizer, target.stride)
        if background is None:
            background = eval_background(setup)
        render = setup.rasterizer.render(gaussians, target.camera, background, outputs)
        image = apply(setup, state, setup.train_views[view], render.image)

        def measure() -> Tensor:
            weights = weights_of(setup, state, view, target)
            return setup.loss.loss(image, target.photo, target.mask, weights)

        return RequestedRender(
            view=setup.train_views[view],
            camera=target.camera,
            scale=scale,
            gaussians=gaussians,
            render=render,
            screen=render.screen,
            image=image,
            photo=target.photo,
            mask=target.mask,
            measure=measure,
        )


def _check(setup: Setup, view: int, scale: float) -> None:
    count = len(setup.train_views)
    if 0 <= view < count and 0.0 < scale <= 1.0:
        return
    raise UserError(
        "a plugin asked for a render that there cannot be",
        expected=f"a training view from 0 to {count - 1}, and a scale above 0 and at most 1",
        found=f"view {view}, scale {scale}",
        todo="repair the plugin that asks",
    )
