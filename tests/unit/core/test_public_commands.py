"""The door for command rooms: complete, documented, quick to import, and enough for a command."""

import inspect
import subprocess
import sys

import numpy as np
import pytest
import torch
from support.scenes import write_tiny_scene

from crossgrad_core import commands
from crossgrad_core.testing.commands import HEAVY


def test_importing_the_public_module_is_quick():
    program = "import sys, crossgrad_core.commands; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, check=True, text=True
    )
    assert not set(HEAVY) & set(done.stdout.split())


@pytest.mark.parametrize("name", commands.__all__)
def test_each_public_name_exists_and_has_a_docstring(name):
    thing = getattr(commands, name)
    assert name == "FAILED" or inspect.getdoc(thing)


def test_the_public_module_exports_its_documented_names_only():
    defined = {name for name, thing in vars(commands).items()
               if not name.startswith("_") and inspect.isfunction(thing)}  # fmt: skip
    assert defined <= {*commands.__all__, "replace", "import_module"}
    with pytest.raises(AttributeError, match="no attribute 'Stopper'"):
        commands.Stopper  # noqa: B018


def test_a_model_can_be_trained_without_a_folder_and_then_rendered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene_folder = write_tiny_scene(tmp_path / "scene", views=4)
    settings = {"scene": scene_folder, "rasterizer": {"name": "torch"}}
    config = commands.configured(settings)
    scene, reader = commands.read_scene(config)
    setup = commands.with_steps(commands.assemble(config, scene, reader), 2)
    state = commands.begin(setup)
    commands.take_steps(setup, state)
    assert state.step == 2
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]

    model = commands.model_of(setup, state)
    before = {name: tensor.clone() for name, tensor in model.parameters.items()}
    blocks = model.backbone.trained_blocks()
    tensors = [name for block in blocks for name in block.tensors]
    found = [commands.view_gradients(model, view, tensors) for view in scene.train_views[:2]]
    gramians = commands.gathered(found, blocks).gramians("block")
    means = [each["means"].double().flatten() for each in found]
    place = [block.name for block in blocks].index("means")
    assert gramians[place, 0, 1] == pytest.approx(float(means[0] @ means[1]), rel=1e-6)
    assert np.isfinite(gramians).all()
    assert all(torch.equal(before[name], model.parameters[name]) for name in before)
    assert all(tensor.grad is None for tensor in model.parameters.values())


def test_progress_is_shown_at_most_once_per_interval(capsys):
    every, seldom = commands.Progress(), commands.Progress(60.0)
    for text in ("one", "two"):
        every.tell(text)
        seldom.tell(text)
    assert capsys.readouterr().err == "... one\n... two\n"
    assert not seldom.due


def test_a_table_contains_every_column_and_no_nan(tmp_path):
    rows = [{"a": 1, "b": 1 / 3}, {"a": "x,y", "c": float("nan"), "b": float("inf")}]
    commands.write_table(tmp_path / "t.csv", rows)
    assert (tmp_path / "t.csv").read_text() == 'a,b,c\n1,0.333333333,\n"x,y",inf,\n'
