"""The model between two steps, as it is shown to observers."""

from functools import partial

from crossgrad_core.contract.contexts import Model
from crossgrad_core.training.per_image_params import apply
from crossgrad_core.training.rates import rule_at
from crossgrad_core.training.render_callback import RenderCallback
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.view_target import eval_background


def model_of(setup: Setup, state: TrainState) -> Model:
    """The model as it is after the last step, shared, not copied."""
    return Model(
        phase=setup.phase(state.step, training=True),
        scene=setup.scene,
        backbone=setup.backbone,
        rasterizer=setup.rasterizer,
        parameters=state.parameters,
        adam=state.adam,
        background=eval_background(setup),
        loss=setup.loss,
        exposed=partial(apply, setup, state),
        rule=rule_at(setup, state.step + 1),
        render=RenderCallback(setup, state, counted=False),
        groups=setup.groups,
    )
