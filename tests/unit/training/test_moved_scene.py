"""A scene that was moved trains as one whose first positions differ in the last bit."""

import numpy as np
import pytest
import torch
from support.scenes import write_tiny_scene

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.scene import centers_of
from crossgrad_core.evaluation.evaluation import evaluate
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.run.assemble import assemble, read_scene
from crossgrad_core.run.export import renderer
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state

#: Fewer perturbed runs than this miss the ends of their own spread.
STEPS, RUNS = 30, 24
TIMES = {"schedule_unit": "steps", "densify_from": 10, "densify_every": 10, "densify_until": 25}
#: How a run steps -> how far apart in PSNR perturbed runs may end. A step by size is up to five
#: times as long, and so is a difference of the last bit. In runs with few passes sizes learn at
#: twice the rate, and the first moment averages over fewer steps.
WAYS = {"extent": 0.01, "per-axis": 0.03, "as by default": 0.05}
SETTINGS = {
    **{
        way: {
            "position_lr": way,
            "beta1": 0.9,
            "backbone": {"name": "vanilla", "lr_scales": 0.0025},
        }
        for way in ("extent", "per-axis")
    },
    "as by default": {},
}
OFFSETS = [(1e6, 1e6, 1e6), (4e5, 5.6e6, 120.0), (0.0, 0.0, -1e6)]


def written(folder, **options):
    write_tiny_scene(folder, views=9, **options)
    return read_scene(RunConfig(scene=folder), folder)[0]


@pytest.fixture(scope="module")
def in_place(tmp_path_factory):
    return written(tmp_path_factory.mktemp("scenes") / "tiny")


#: `make slow` trains the two ways that a run does not take by default.
DEFAULT = "as by default"
OTHERS = [pytest.param(way, marks=pytest.mark.slow) for way in WAYS if way != DEFAULT]


@pytest.fixture(scope="module", params=[*OTHERS, DEFAULT])
def spread(in_place, request):
    """How a run steps, PSNR in place, and how far apart runs from perturbed positions end."""
    plain = psnr(in_place, request.param)
    runs = [plain, *(psnr(in_place, request.param, seed) for seed in range(RUNS))]
    return request.param, plain, max(runs) - min(runs)


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    before = configure_threads()
    configure_threads(1)
    yield
    configure_threads(before)


def psnr(scene, way, seed=None):
    """After a short run; from positions one unit in the last place aside, where a seed is given."""
    settings = {"steps": STEPS, **TIMES, **SETTINGS[way]}
    setup = assemble(RunConfig.model_validate(settings), scene, "colmap")
    state = first_state(setup)
    if seed is not None:
        state.parameters["means"] = aside(state.parameters["means"].detach(), seed)
    for _ in range(STEPS):
        timed_step(setup, state)
    return evaluate(scene.test_views, renderer(setup, state), setup.metrics).overall["psnr"]


def aside(means, seed):
    signs = np.random.default_rng(seed).choice([-np.inf, np.inf], means.shape)
    return torch.nextafter(means, torch.from_numpy(signs).to(means)).requires_grad_()


@pytest.mark.slow
@pytest.mark.parametrize("offset", OFFSETS)
def test_a_moved_scene_equals_the_original_to_2e_9_and_its_psnr_within_the_spread_of_runs(
    tmp_path, in_place, spread, offset
):
    moved = written(tmp_path / "moved", offset=offset)
    assert np.abs(centers_of(moved.views) - centers_of(in_place.views)).max() <= 2e-9
    assert np.abs(moved.points - in_place.points).max() <= 2e-9
    way, plain, apart = spread
    assert 0 < apart < WAYS[way]
    assert abs(psnr(moved, way) - plain) <= apart
