"""Create the first state of a run, and compile the kernels of the run."""

import json
import logging
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from copy import deepcopy
from dataclasses import replace
from time import perf_counter
from typing import Final

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.config import AUTO, ComponentChoice
from crossgrad_core.contract.blocks import (
    AdamRule,
    AdamState,
    Parameters,
    PluginState,
    primitives_of,
)
from crossgrad_core.contract.component import answered
from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.slots.exporter import Exporter
from crossgrad_core.contract.slots.loss import Loss
from crossgrad_core.defaults import EXPORTER
from crossgrad_core.errors import UserError
from crossgrad_core.gradients.sparse_rows import sparse_rows
from crossgrad_core.numerics.kernel_cache import notes_on_missing
from crossgrad_core.registry.entries import build
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.system.checksums import warn_if_changed
from crossgrad_core.system.cores import available_cores
from crossgrad_core.training import per_image_params
from crossgrad_core.training.adam.adam import adam_step, counted
from crossgrad_core.training.adam.axes import step_along_axes
from crossgrad_core.training.adam.late import Late
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.rates import check_axes
from crossgrad_core.training.rngs import STREAMS, make_streams
from crossgrad_core.training.scaled_photos import decoded_meanwhile
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.step import ordered
from crossgrad_core.wording import in_one_line, listed

#: Seconds that this process waits for the compiling process, after its own compilations.
_PATIENCE: Final = 60.0


@contextmanager
def compiling_beside(setup: Setup) -> Iterator[None]:
    """Compile kernels in a second process, which starts when the first missing kernel is found.

    No second process is used on a GPU, on a single core, or if the run uses only one thread. At the
    end of the block, this process waits for the second process. After the wait, this process loads
    all kernels for sparse rows. Steps with few and with many rows use different kernels, and the
    second kind may first occur during training.
    """
    alone = setup.config.threads == 1 or available_cores() == 1
    processes: list[subprocess.Popen[bytes]] = []

    def start(*, kept: bool) -> None:
        if processes or alone or not kept or setup.device.type != "cpu":
            return
        command = [sys.executable, "-m", __name__, setup.config.loss.model_dump_json()]
        silent = subprocess.DEVNULL
        processes.append(subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent))

    try:
        with notes_on_missing(start):
            yield
        for process in processes:
            # A process that hangs, for example during the import of a plugin, must not block the
            # run.
            with suppress(subprocess.TimeoutExpired):
                process.wait(_PATIENCE)
        if setup.sparse_rows:
            compile_rows()
    finally:
        for process in processes:
            process.terminate()
            process.wait()


def compile_all(loss: ComponentChoice) -> None:
    """Compile the kernels of a loss and of the optimizer.

    To compile the kernels, call the loss and the optimizer with artificial data.
    """
    photo = torch.zeros((64, 64, 3), dtype=torch.uint8)
    render = torch.full((64, 64, 3), 0.5, requires_grad=True)
    measured = build(Loss, loss.name, loss.options).loss(render, photo, None, None)
    measured.backward()  # type: ignore[no-untyped-call]
    values = torch.zeros((8, 3))
    adam_step({"all": values}, {"all": torch.ones_like(values)}, AdamState(), {"all": 1e-3})
    step_along_axes(values, values, values, torch.zeros((8, 4)))
    compile_rows()


def compile_rows() -> None:
    """Compile the optimizer kernels for sparse rows.

    To compile the kernels, call the optimizer with artificial data.
    """
    values, state, late = torch.zeros((8, 3)), AdamState(), Late()
    # The three steps call all kernels: one row, another row with deferred steps, and enough rows
    # for the kernel that updates all rows.
    for rows in ([1], [4], [1, 4, 6]):
        grad = sparse_rows(torch.tensor(rows), torch.ones((len(rows), 3)), values.shape)
        late.step(
            "rows", values, grad, state, counted("rows", values, state, 1e-3, AdamRule(), 1.0)
        )
    late.finish()


if __name__ == "__main__":
    compile_all(ComponentChoice.model_validate(json.loads(sys.argv[1])))


_LOG = logging.getLogger(__name__)
#: Number of random initial points (`--init random`).
RANDOM_POINTS = 20_000
#: If the points would give more Gaussians than --max-gaussians, a run starts with this share of the
#: limit (docs/schedules.md). `THINNED` is the key of the state that stores how many Gaussians all
#: points would give.
BEGINNING, THINNED = 2 / 3, "thinned"
#: If a reduced set of points still gives too many Gaussians, the next attempt uses at most this
#: share of the set.
_LESS = 0.8


def first_state(setup: Setup) -> TrainState:
    """Return the state before the first step."""
    rngs = make_streams(setup.config.seed, names=(*STREAMS, *setup.selection.rules))
    created, crowd = initial_parameters(setup, rngs["create"])
    parameters = setup.densifier.started(created)
    parameters = ordered(parameters, setup.blocks, setup.backbone.positions)
    trained = {name for block in setup.trained_blocks for name in block.tensors}
    parameters = {
        # Make the tensors contiguous, because they are contiguous after a checkpoint is loaded.
        # Another memory layout would change the rounding.
        name: tensor.detach().to(setup.device).contiguous().requires_grad_(name in trained)
        for name, tensor in parameters.items()
    }
    prepared = setup.backbone.prepare(parameters, setup.scene, setup.phase(0, training=True))
    parameters = _made(setup, prepared, "prepare")
    check_axes(setup, parameters)
    state = TrainState(tensors=parameters, moments=AdamState(), rngs=rngs)
    photos = per_image_params.started(setup)
    if photos is not None:
        state.commit({per_image_params.STATE: photos})
    if crowd is not None:
        state.commit({THINNED: PluginState({"of": crowd, "start": state.primitives(setup)})})
    return state


def initial_parameters(setup: Setup, rng: np.random.Generator) -> tuple[Parameters, int | None]:
    """Return parameters made from SfM points, from random points, or from a PLY file of Gaussians.

    If the points would give more primitives than the user's limit, a random subset of the points is
    used. With such a subset, the run starts with the share `BEGINNING` of the limit. Density
    control can add the remaining primitives in regions that need more primitives. Without density
    control, the run starts with as many primitives as the limit allows. The Gaussians of a PLY file
    are used unchanged.

    Returns:
        The parameters, and the number of primitives that all points would give. The number is None
        if all points were used.
    """
    data, scene = setup.config.data, setup.scene
    if data.init_file is not None:
        warn_if_changed(data.init_file)
        gaussians = build(Exporter, EXPORTER, {}).read(data.init_file, scene.similarity)
        return _made(setup, setup.backbone.adopt(gaussians, scene, rng), "adopt"), None
    begun = with_random_points(scene, rng) if data.init == "random" else _begun(setup)
    parameters = _made(setup, setup.backbone.create(begun, rng), "create")
    present, bound = primitives_of(setup.blocks, parameters), setup.numbers.max_gaussians
    if not bound or bound == AUTO or present <= bound:
        return parameters, None
    grows = setup.densifier.edits and setup.schedule.grows
    wanted = (BEGINNING if grows else 1.0) * bound
    share, made = wanted / present, present
    while made > bound and share * len(begun.points) >= 1.0:
        parameters = _made(setup, setup.backbone.create(thinned(begun, share, rng), rng), "create")
        made = primitives_of(setup.blocks, parameters)
        # Several attempts are needed if the backbone does not make exactly one Gaussian from each
        # point.
        share *= min(_LESS, wanted / made)
    return parameters, present


def _begun(setup: Setup) -> Scene:
    """Return the scene, including the points that the initializer adds.

    Raises:
        UserError: The initializer returned invalid points.
    """
    scene, initializer = setup.scene, setup.selection.initializer
    try:
        begun = initializer.begun(scene)
        wrong = _misfit(begun, len(scene.points))
    except ValueError as error:
        # If the initializer itself fails, this call raises its original error.
        initializer.more_points(scene)
        wrong = in_one_line(error)
    if not wrong:
        return begun
    raise UserError(
        f"initializer {setup.selection.names['initializer']} returned invalid points",
        where=f"{type(initializer).__name__}.more_points",
        expected="finite positions [N, 3], colors [N, 3], sizes [N] above 0 or NaN, opacities [N] "
        "in (0, 1) or NaN",
        found=wrong,
        todo="choose another --initializer, or repair the plugin",
    )


def _misfit(begun: Scene, known_count: int) -> str:
    """Return a description of the problem of the added points; empty if all points are valid."""
    points, sizes, opacities = begun.points[known_count:], begun.point_sizes, begun.point_opacities
    if sizes is None or opacities is None:
        return ""
    counts = {"colors": len(begun.point_colors), "sizes": len(sizes), "opacities": len(opacities)}
    for name, count in counts.items():
        if count != len(begun.points):
            return f"{len(points)} positions, {count - known_count} {name}"
    if not np.isfinite(points).all():
        return "a position that is not finite"
    sizes, opacities = sizes[known_count:], opacities[known_count:]
    # NaN means that the backbone chooses the size or the opacity of the Gaussian.
    if not (((sizes > 0.0) & np.isfinite(sizes)) | np.isnan(sizes)).all():
        return "a size that is not a number above 0"
    inside = (opacities > 0.0) & (opacities < 1.0) | np.isnan(opacities)
    return "" if inside.all() else "an opacity that is not between 0 and 1"


def _made(setup: Setup, answer: object, method: str) -> Parameters:
    """Check and return the parameters that a method of the backbone returned.

    Raises:
        UserError: The result is not a dictionary, or tensors are missing. After `prepare`, all
            tensors of the blocks are required; before, only the first per-primitive tensor.
    """
    parameters = answered(answer, dict, setup.backbone, method)
    per_primitive = [block.tensors for block in setup.blocks if block.per_primitive]
    first = [names[0] for names in per_primitive[:1]]
    wanted = first if method != "prepare" else [n for block in setup.blocks for n in block.tensors]
    have = [name for name, tensor in parameters.items() if isinstance(tensor, Tensor)]
    if not set(wanted) <= set(have):
        raise UserError(
            f"{type(setup.backbone).__name__}.{method} returned tensors with other names "
            "than its blocks use",
            where=f"backbone {setup.selection.names['backbone']}",
            expected=listed(wanted),
            found=listed(have) or "none",
            todo="repair the plugin, or choose another backbone",
        )
    return parameters


def thinned(scene: Scene, share: float, rng: np.random.Generator) -> Scene:
    """Return the scene with a given share of its points, drawn at random.

    At least one point remains.

    Points that have sizes were added by an initializer. All points of the initializer are kept if
    they fit, because each point covers a region without other points.
    """
    count = len(scene.points)
    wanted = max(1, round(share * count))
    added = np.zeros(count, dtype=bool)
    if scene.point_sizes is not None:
        added = np.isfinite(scene.point_sizes)
    if int(added.sum()) >= wanted:
        added[:] = False
    kept_rows = rng.choice(np.flatnonzero(~added), wanted - int(added.sum()), replace=False)
    return scene.with_points(np.sort(np.concatenate([np.flatnonzero(added), kept_rows])))


def start_notes(setup: Setup, state: TrainState) -> tuple[str, ...]:
    """Return a note if the run does not start with all primitives that its points would give.

    If a PLY file contains more Gaussians than the limit allows, a note is returned, too.
    """
    kept, most = state.states.get(THINNED), setup.config.max_gaussians
    if kept is None:
        present = state.primitives(setup)
        if not isinstance(most, int) or not most or present <= most:
            return ()
        return (
            (
                f"start: {present:,} Gaussians, more than --max-gaussians {most:,}: a PLY is "
                "used unchanged, and no Gaussians are added"
            ),
        )
    start, crowd = kept.values["start"], kept.values["of"]
    return (
        (
            f"start: {start:,} Gaussians instead of {crowd:,}, from randomly drawn "
            "points: --max-gaussians is smaller than the number of Gaussians from all "
            "points"
        ),
    )


def with_random_points(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return the scene with random grey points, uniform in a cube of side 3 in local units."""
    points = rng.uniform(-1.5, 1.5, (RANDOM_POINTS, 3))
    colors = np.full((RANDOM_POINTS, 3), 127, dtype=np.uint8)
    views = tuple(replace(view, seen=np.zeros(0, dtype=np.int64)) for view in scene.views)
    return replace(scene, views=views, points=points, point_colors=colors)


def unwatched(setup: Setup) -> Setup:
    """Return the setup without observers and wrappers, which must not receive uncounted steps."""
    plugins = setup.selection.plugins
    return replace(setup, manager=make_manager(plugins), plugins=plugins)


def warm_up(setup: Setup, reached: TrainState | None = None) -> float:
    """Compile all kernels that the run needs, by taking steps with temporary states.

    Photos are decoded in parallel. Parallel decoding saves time, because compilers run one at a
    time and release the interpreter lock.

    Args:
        setup: Setup of the run.
        reached: The training state of a resumed run; this state does not change.

    Returns:
        The time that the compilation took, in seconds.

    Raises:
        UserError: The rasterizer fails its self-test on this machine.
    """
    _LOG.info("loading kernels")
    start = perf_counter()
    setup.rasterizer.self_test(str(setup.device))
    setup, schedule = unwatched(setup), setup.schedule
    # Use step 0 if the run has only one step.
    degrees = {max(schedule.sh_interval * degree, schedule.sh_wait) for degree in (1, 2, 3)}
    steps = [min(1, schedule.total - 1), *map(schedule.step_of, sorted(degrees))]
    if setup.densifier.needs:
        # After the end of density control, training collects no statistics and uses other kernels.
        steps.append(schedule.step_of(schedule.densify_until))
    if schedule.grows:
        # An edit may also render views.
        steps.append(schedule.first_edit - 1)
    with decoded_meanwhile(setup.scene), compiling_beside(setup):
        for step in steps:
            if step < schedule.total:
                state = first_state(setup) if reached is None else deepcopy(reached)
                state.step = step
                timed_step(setup, state)
                if setup.sparse_rows and step == steps[0] and step + 1 < schedule.total:
                    # In the second step, some rows have deferred updates, which need another
                    # kernel.
                    timed_step(setup, state)
    seconds = perf_counter() - start
    _LOG.debug("loaded kernels in %.1f s", seconds)
    return seconds


def initial_bytes(setup: Setup) -> int:
    """Return the bytes of the initial parameters, their gradients and their moments."""
    parameters, _ = initial_parameters(setup, make_streams(setup.config.seed)["create"])
    return 4 * sum(tensor.numel() * tensor.element_size() for tensor in parameters.values())
