"""The first state of a run, and compiling what it needs."""

import logging
from copy import deepcopy
from dataclasses import replace
from time import perf_counter

import numpy as np

from crossgrad_core.contract.adam_state import AdamState
from crossgrad_core.contract.blocks import Parameters
from crossgrad_core.contract.exporter import Exporter
from crossgrad_core.contract.scene import Scene
from crossgrad_core.defaults import EXPORTER
from crossgrad_core.registry.entries import build
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.training import photo_parameters
from crossgrad_core.training.compile_ahead import compiling_beside
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.order import ordered
from crossgrad_core.training.photos_ahead import decoded_meanwhile
from crossgrad_core.training.rngs import make_streams
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

_LOG = logging.getLogger(__name__)
#: Random initial points where a scene has none (`--init random`).
RANDOM_POINTS = 20_000


def first_state(setup: Setup) -> TrainState:
    """The state before the first step."""
    rngs = make_streams(setup.config.seed)
    parameters = setup.densifier.started(initial_parameters(setup, rngs["create"]))
    parameters = ordered(parameters, setup.blocks, setup.backbone.positions)
    trained = {name for block in setup.trained_blocks for name in block.tensors}
    parameters = {
        name: tensor.detach().to(setup.device).requires_grad_(name in trained)
        for name, tensor in parameters.items()
    }
    parameters = setup.backbone.prepare(parameters, setup.scene, setup.phase(0, training=True))
    state = TrainState(tensors=parameters, moments=AdamState(), rngs=rngs)
    photos = photo_parameters.started(setup)
    if photos is not None:
        state.commit({photo_parameters.STATE: photos})
    return state


def initial_parameters(setup: Setup, rng: np.random.Generator) -> Parameters:
    """Parameters from the SfM points, from random points, or from a PLY of Gaussians."""
    reading = setup.config.reading
    if reading.init_file is None:
        scene = setup.scene
        if reading.init == "random":
            return setup.backbone.create(with_random_points(scene, rng), rng)
        return setup.backbone.create(setup.selection.start.begun(scene), rng)
    gaussians = build(Exporter, EXPORTER, {}).read(reading.init_file, setup.scene.similarity)
    return setup.backbone.adopt(gaussians, setup.scene, rng)


def with_random_points(scene: Scene, rng: np.random.Generator) -> Scene:
    """The scene with grey points uniform in a cube of three extents around the cameras."""
    points = rng.uniform(-1.5, 1.5, (RANDOM_POINTS, 3))
    colors = np.full((RANDOM_POINTS, 3), 127, dtype=np.uint8)
    return replace(scene, points=points, point_colors=colors)


def unwatched(setup: Setup) -> Setup:
    """The same run without observers and wrappers, which must not see steps that do not count."""
    components = setup.selection.components
    return replace(setup, manager=make_manager(components), plugins=components)


def warm_up(setup: Setup, reached: TrainState | None = None) -> float:
    """Compiles every kernel that the run will need, on throw-away states.

    Photos are decoded meanwhile: compilers run one at a time and leave the interpreter to others.

    Args:
        setup: The run.
        reached: The state of a resumed run, which stays as it is.

    Returns:
        The seconds that it took.

    Raises:
        UserError: The rasterizer does not draw rightly on this machine.
    """
    _LOG.info("loading kernels")
    start = perf_counter()
    setup.rasterizer.burn_in(str(setup.device))
    setup, schedule = unwatched(setup), setup.schedule
    steps = [1, *(schedule.step_of(schedule.sh_interval * degree) for degree in (1, 2, 3))]
    if setup.densifier.needs:
        # Once density control is over, its statistics are left out: other kernels.
        steps.append(schedule.step_of(schedule.densify_until))
    if schedule.grows:
        # An edit may draw, too.
        steps.append(schedule.first_edit - 1)
    with decoded_meanwhile(setup.scene), compiling_beside(setup):
        for step in steps:
            if step < schedule.total:
                state = first_state(setup) if reached is None else deepcopy(reached)
                state.step = step
                timed_step(setup, state)
                if setup.by_rows and step == steps[0] and step + 1 < schedule.total:
                    # Rows are behind from the second step on.
                    timed_step(setup, state)
    seconds = perf_counter() - start
    _LOG.debug("loaded kernels in %.1f s", seconds)
    return seconds


def initial_bytes(setup: Setup) -> int:
    """Bytes of the initial parameters with their gradients and moments."""
    parameters = initial_parameters(setup, make_streams(setup.config.seed)["create"])
    return 4 * sum(tensor.numel() * tensor.element_size() for tensor in parameters.values())
