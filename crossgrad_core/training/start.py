"""The first state of a run, and the compilation of its kernels."""

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
from crossgrad_core.contract.slots.loss import Loss
from crossgrad_core.errors import UserError
from crossgrad_core.gradients.sparse_rows import sparse_rows
from crossgrad_core.numerics.kernel_cache import notes_on_missing
from crossgrad_core.registry.entries import build
from crossgrad_core.registry.file_formats import exporter_for
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

#: Seconds to wait for the other process after this process has compiled everything.
_PATIENCE: Final = 60.0


@contextmanager
def compiling_beside(setup: Setup) -> Iterator[None]:
    """Compile kernels in a second process, which starts at the first missing kernel.

    The second process is not used with a single core or thread, or for a GPU. At the end of the
    block, this process waits for it. Then all kernels for sparse rows are loaded, because few and
    many rows use different kernels, and a view of either kind may first occur during training.
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
            # A hanging process, for example in a plugin's import, must not block the run.
            with suppress(subprocess.TimeoutExpired):
                process.wait(_PATIENCE)
        if setup.sparse_rows:
            compile_rows()
    finally:
        for process in processes:
            process.terminate()
            process.wait()


def compile_all(loss: ComponentChoice) -> None:
    """Compile the kernels of a loss and the optimizer with dummy data."""
    photo = torch.zeros((64, 64, 3), dtype=torch.uint8)
    render = torch.full((64, 64, 3), 0.5, requires_grad=True)
    measured = build(Loss, loss.name, loss.options).loss(render, photo, None, None)
    measured.backward()  # type: ignore[no-untyped-call]
    values = torch.zeros((8, 3))
    adam_step({"all": values}, {"all": torch.ones_like(values)}, AdamState(), {"all": 1e-3})
    step_along_axes(values, values, values, torch.zeros((8, 4)))
    compile_rows()


def compile_rows() -> None:
    """Compile the kernels for optimizer steps of sparse rows with dummy data."""
    values, state, late = torch.zeros((8, 3)), AdamState(), Late()
    # Train one row, then another row with deferred steps, then enough rows for the kernel that
    # updates all rows.
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
#: Maximum share of --max-gaussians with which a run starts if its points would give more Gaussians
#: (docs/schedules.md). `THINNED` is the name of the state that stores the number without this
#: limit.
BEGINNING, THINNED = 2 / 3, "thinned"
#: The next attempt keeps at most this share of the points.
_LESS = 0.8


def first_state(setup: Setup) -> TrainState:
    """Return the state before the first step."""
    rngs = make_streams(setup.config.seed, names=(*STREAMS, *setup.selection.rules))
    created, crowd = initial_parameters(setup, rngs["create"])
    parameters = setup.densifier.started(created)
    parameters = ordered(parameters, setup.blocks, setup.backbone.positions)
    trained = {name for block in setup.trained_blocks for name in block.tensors}
    parameters = {
        # Make the tensors contiguous, as they are after loading a checkpoint, because another
        # memory layout changes the rounding.
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
    """Return parameters made from SfM points, from random points, or from a file of Gaussians.

    If the points would make more primitives than the user's bound, points are drawn at random, so
    that the run starts with the share `BEGINNING` of the bound. The remaining share is left for
    density control, which places primitives where the photos need them. Without density control,
    the run starts with the full bound. A file of Gaussians is used unchanged.

    Returns:
        The parameters, and the number of primitives that all points would have made; None if all
        points were used.
    """
    data, scene = setup.config.data, setup.scene
    if data.init_file is not None:
        warn_if_changed(data.init_file)
        exporter = exporter_for(data.init_file, "--init")
        gaussians = exporter.read(data.init_file, scene.similarity)
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
        # If the number of Gaussians per point is not 1, several attempts are needed.
        share *= min(_LESS, wanted / made)
    return parameters, present


def _begun(setup: Setup) -> Scene:
    """Return the scene with the points that the initializer adds.

    Raises:
        UserError: The points are not valid.
    """
    scene, initializer = setup.scene, setup.selection.initializer
    try:
        begun = initializer.begun(scene)
        wrong = _misfit(begun, len(scene.points))
    except ValueError as error:
        initializer.more_points(scene)  # This call raises the errors of the initializer itself.
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
    """Return the problem of the points after the first `known_count`; empty if all are valid."""
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
    # NaN means that the backbone chooses the size or the opacity.
    if not (((sizes > 0.0) & np.isfinite(sizes)) | np.isnan(sizes)).all():
        return "a size that is not a number above 0"
    inside = (opacities > 0.0) & (opacities < 1.0) | np.isnan(opacities)
    return "" if inside.all() else "an opacity that is not between 0 and 1"


def _made(setup: Setup, answer: object, method: str) -> Parameters:
    """Return the checked parameters from a method of the backbone.

    Raises:
        UserError: The result is not a dictionary, or it lacks tensors that the blocks name (after
            `prepare`: any of them; before: the first per-primitive tensor).
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
    """Return the scene with this share of its points, at least one, drawn at random.

    Points with sizes come from an initializer. All of these points are kept if they fit, because
    each of them covers a region without other points.
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
    """Return notes on a start with fewer primitives than possible, or with more than the bound."""
    kept, most = state.states.get(THINNED), setup.config.max_gaussians
    if kept is None:
        present = state.primitives(setup)
        if not isinstance(most, int) or not most or present <= most:
            return ()
        return (
            (
                f"start: {present:,} Gaussians, more than --max-gaussians {most:,}: a file is "
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
    """Return the scene with random grey points, uniform in a cube of side 3 (local units)."""
    points = rng.uniform(-1.5, 1.5, (RANDOM_POINTS, 3))
    colors = np.full((RANDOM_POINTS, 3), 127, dtype=np.uint8)
    views = tuple(replace(view, seen=np.zeros(0, dtype=np.int64)) for view in scene.views)
    return replace(scene, views=views, points=points, point_colors=colors)


def unwatched(setup: Setup) -> Setup:
    """Return the run without observers and wrappers, which must not see uncounted steps."""
    plugins = setup.selection.plugins
    return replace(setup, manager=make_manager(plugins), plugins=plugins)


def warm_up(setup: Setup, reached: TrainState | None = None) -> float:
    """Compile every kernel that the run needs, with temporary states.

    Photos are decoded at the same time, because compilers run one at a time and release the
    interpreter lock.

    Args:
        setup: The run.
        reached: The state of a resumed run, which is not changed.

    Returns:
        The time in seconds.

    Raises:
        UserError: The rasterizer renders incorrectly on this machine.
    """
    _LOG.info("loading kernels")
    start = perf_counter()
    setup.rasterizer.self_test(str(setup.device))
    setup, schedule = unwatched(setup), setup.schedule
    # A run of one step cannot test a second step.
    degrees = {max(schedule.sh_interval * degree, schedule.sh_wait) for degree in (1, 2, 3)}
    steps = [min(1, schedule.total - 1), *map(schedule.step_of, sorted(degrees))]
    if setup.densifier.needs:
        # Statistics are no longer collected after the end of density control, so training then uses
        # other kernels.
        steps.append(schedule.step_of(schedule.densify_until))
    if schedule.grows:
        # An edit may render, too.
        steps.append(schedule.first_edit - 1)
    with decoded_meanwhile(setup.scene), compiling_beside(setup):
        for step in steps:
            if step < schedule.total:
                state = first_state(setup) if reached is None else deepcopy(reached)
                state.step = step
                timed_step(setup, state)
                if setup.sparse_rows and step == steps[0] and step + 1 < schedule.total:
                    # From the second step on, some rows have deferred updates.
                    timed_step(setup, state)
    seconds = perf_counter() - start
    _LOG.debug("loaded kernels in %.1f s", seconds)
    return seconds


def initial_bytes(setup: Setup) -> int:
    """Return the bytes of the initial parameters with their gradients and moments."""
    parameters, _ = initial_parameters(setup, make_streams(setup.config.seed)["create"])
    return 4 * sum(tensor.numel() * tensor.element_size() for tensor in parameters.values())
