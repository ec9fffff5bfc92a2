"""Compare the time of a training step of each backbone with vanilla, as a Markdown table.

    python benchmarks/backbone_cost.py SCENE [--max-size 400] [--steps 400] [--reps 40]

Each backbone is first trained for --steps steps. Then the backbone and a vanilla model take
alternate steps on one view. The vanilla model consists of the Gaussians that the backbone decodes
for this view. Backbone and vanilla model therefore draw the same number of Gaussians. The ratio of
times is computed for each pair of steps. The first row compares vanilla with itself.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from statistics import median

import torch
from _machine import facts

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Scene
from crossgrad_core.numerics.raster_constants import SH_C0
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.run.assemble import assemble, read_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.start import first_state, warm_up
from crossgrad_core.training.state import TrainState

BACKBONES = ("vanilla", "pixel", "mip", "analytic", "distance", "scaffold", "octree")
#: A step of the published schedule at which all SH bands are trained. No edit is near this step.
START = 5001
REPS_BETWEEN_EDITS = 90


def trained(scene: Scene, config: RunConfig, steps: int) -> tuple[Setup, TrainState]:
    """Return a backbone after some steps on the whole scene."""
    setup = assemble(config, scene, "none")
    warm_up(setup)
    state = first_state(setup)
    for _ in range(steps):
        timed_step(setup, state)
    return setup, state


def on_one_view(setup: Setup, state: TrainState) -> Setup:
    """Return the run with only its first training view, in the middle of the schedule."""
    scene = replace(setup.scene, train=setup.scene.train[:1])
    state.step = START
    # Remove the state of the sampler, because it refers to all views.
    state.states.pop("sampler", None)
    return replace(setup, scene=scene)


def drawn(setup: Setup, state: TrainState) -> Gaussians:
    """Return the Gaussians that touch a pixel of the single view."""
    camera = setup.train_views[0].camera
    with torch.no_grad():
        gaussians = setup.backbone.decode(
            state.parameters, camera, setup.phase(state.step, training=True)
        )
        render = setup.rasterizer.render(gaussians, camera, torch.zeros(3))
    seen = (render.screen.radii > 0).nonzero().squeeze(1)
    return gaussians.mapped(lambda tensor: tensor[seen])


def as_vanilla(setup: Setup, gaussians: Gaussians) -> TrainState:
    """Return a vanilla training state that contains these Gaussians."""
    if gaussians.colors is not None:
        dc = ((gaussians.colors - 0.5) / SH_C0)[:, None, :]
        gaussians = replace(gaussians, colors=None, sh_dc=dc, sh_rest=None)
    state = first_state(setup)
    plain = replace(gaussians, response="plain", dilation=None)
    parameters = setup.backbone.adopt(plain, setup.scene, state.rngs["create"])
    state.parameters = {name: t.detach().requires_grad_() for name, t in parameters.items()}
    state.step = START
    return state


def milliseconds(setup: Setup, state: TrainState) -> float:
    """Return the milliseconds of one step."""
    before = state.clock.train
    timed_step(setup, state)
    return 1000.0 * (state.clock.train - before)


def row(name: str, scene: Scene, vanilla: Setup, arguments: argparse.Namespace) -> str:
    """Return one line of the table."""
    config = vanilla.config.model_copy(
        update={"backbone": ComponentChoice(name=name), "densifier": None}
    )
    setup, state = trained(scene, config, arguments.steps)
    setup = on_one_view(setup, state)
    shown = drawn(setup, state)
    reference = as_vanilla(vanilla, shown)
    beside = on_one_view(vanilla, reference)
    for _ in range(3):
        milliseconds(setup, state), milliseconds(beside, reference)
    pairs = [
        (milliseconds(setup, state), milliseconds(beside, reference)) for _ in range(arguments.reps)
    ]
    own, plain = (median(values) for values in zip(*pairs, strict=True))
    ratio = median(mine / theirs for mine, theirs in pairs)
    count = state.primitives(setup)
    return f"| {name} | {len(shown):,} | {count:,} | {own:.1f} | {plain:.1f} | {ratio:.2f} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--backbones", nargs="+", default=list(BACKBONES))
    parser.add_argument("--max-size", type=int, default=400)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--reps", type=int, default=40)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.reps > REPS_BETWEEN_EDITS:
        parser.error(f"--reps must be at most {REPS_BETWEEN_EDITS}")
    configure_threads(arguments.threads)
    config = RunConfig.model_validate(
        {"data": {"max_size": arguments.max_size}, "sampler": {"name": "epoch"}}
    )
    scene, _ = read_scene(config, arguments.scene)
    vanilla = assemble(config, scene, "none")
    warm_up(vanilla)
    print("| backbone | drawn | primitives | ms | vanilla, ms | ratio |")
    print("|---|---|---|---|---|---|")
    for name in arguments.backbones:
        print(row(name, scene, vanilla, arguments), flush=True)
    print(f"\n{arguments.scene.name} at {arguments.max_size} px, {json.dumps(facts())}")


if __name__ == "__main__":
    main()
