"""The backbone that docs/write-a-backbone.md builds is complete, short, and trains."""

import re
from pathlib import Path

import pytest
import torch

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.run import assemble as assembling
from crossgrad_core.run import select as selecting
from crossgrad_core.testing.checking import checks_of
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state

GUIDE = (Path(__file__).parents[2] / "docs" / "write-a-backbone.md").read_text(encoding="utf-8")
CODE = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)


@pytest.fixture(scope="module")
def shown():
    names = {"__name__": "shown_in_the_cookbook"}
    for code in CODE:
        exec(code, names)
    return names


def test_the_cookbook_backbone_has_60_lines():
    assert len([line for line in CODE[0].splitlines() if line]) <= 60


@pytest.mark.parametrize("check", checks_of("backbones"), ids=lambda check: check.__name__)
def test_the_cookbook_backbone_keeps_the_contract(shown, check):
    check(shown["Spheres"])


def test_the_cookbook_test_is_parametrized_by_the_checks(shown):
    (mark,) = shown["test_spheres"].pytestmark
    assert mark.args == ("check", checks_of("backbones"))


def test_the_cookbook_backbone_trains(shown, monkeypatch):
    built = selecting.build

    def with_spheres(slot, name, options):
        return shown["Spheres"]() if name == "spheres" else built(slot, name, options)

    monkeypatch.setattr(selecting, "build", with_spheres)
    config = RunConfig(
        steps=60,
        plan="off",
        backbone=ComponentChoice(name="spheres"),
        operator=ComponentChoice(name="pcgrad"),
        sampler=ComponentChoice(name="random"),
        # Spheres have one size: large ones in front of the rest would be no start.
        initializer=ComponentChoice(name="points"),
    )
    setup = assembling.assemble(config, sample_scene(), "none")
    state = first_state(setup)
    losses = [sum(timed_step(setup, state).losses) for _ in range(60)]
    assert sum(losses[-20:]) < 0.9 * sum(losses[:20])
    assert all(torch.isfinite(tensor).all() for tensor in state.parameters.values())
