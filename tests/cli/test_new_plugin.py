"""`crossgrad plugins new`: what it writes can be installed, and passes the checks of its slot."""

import ast
import json
import sys
import tomllib
from importlib import import_module

import numpy as np
import pytest
from PIL import Image
from support.distributions import write_distribution

from crossgrad_core.cli.main import main
from crossgrad_core.plugin import SceneOptions
from crossgrad_core.registry.slots import COMMANDS, OFFERED
from crossgrad_plugins.authoring.new import examples

#: What every package may import.
PUBLIC = ("crossgrad_core.plugin", "crossgrad_core.numerics", "crossgrad_core.testing")


@pytest.fixture
def ran(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        printed = capsys.readouterr()
        return ended.value.code, printed.out, printed.err

    yield run
    for module in [name for name in sys.modules if name.startswith("made_new")]:
        del sys.modules[module]


def installed(folder, monkeypatch):
    """Announces the package where it is, as an editable install does."""
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    plugins = {group.removeprefix("crossgrad."): named
               for group, named in project["entry-points"].items()}  # fmt: skip
    write_distribution(folder, project["name"], plugins, version=project["version"])
    monkeypatch.syspath_prepend(folder)
    return plugins


@pytest.mark.sampled(6)
@pytest.mark.parametrize("slot", OFFERED)
def test_a_generated_plugin_passes_the_checks_of_its_slot(ran, tmp_path, monkeypatch, slot):
    name = f"made-new-{slot}"
    code, out, err = ran("plugins", "new", name, "--slot", slot)
    assert (code, err) == (0, "")
    assert f"crossgrad plugins check {name}" in out
    assert list(installed(tmp_path / name, monkeypatch)) == [slot]
    code, out, _ = ran("plugins", "check", name)
    assert code == 0, out
    assert "1 of 1 plugins fulfil the contract of their slot" in out


@pytest.mark.parametrize("slot", OFFERED)
def test_a_generated_plugin_imports_public_modules_only(ran, tmp_path, slot):
    ran("plugins", "new", "made-new", "--slot", slot)
    own = {"readers": "crossgrad_core.scene", COMMANDS: "crossgrad_core.commands"}
    public = (*PUBLIC, own.get(slot, PUBLIC[0]))
    for file in (tmp_path / "made-new").rglob("*.py"):
        text = file.read_text()
        assert "example" not in text
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and "crossgrad" in node.module:
                assert node.module.startswith(public)


def test_the_test_of_a_generated_plugin_runs(ran, tmp_path, monkeypatch):
    ran("plugins", "new", "made-new", "--slot", "operators")
    monkeypatch.syspath_prepend(tmp_path / "made-new")
    names = {"__name__": "made_new_test"}
    exec((tmp_path / "made-new" / "tests" / "test_made_new.py").read_text(), names)
    (mark,) = names["test_contract"].pytestmark
    assert len(mark.args[1]) > 10
    for check in mark.args[1]:
        names["test_contract"](check)


def test_a_generated_reader_plugin_reads_a_scene(ran, tmp_path, monkeypatch):
    ran("plugins", "new", "made-new", "--slot", "readers")
    monkeypatch.syspath_prepend(tmp_path / "made-new")
    (tmp_path / "images").mkdir()
    poses = []
    for number in range(3):
        Image.new("RGB", (20, 16), (number, 90, 30)).save(tmp_path / "images" / f"{number}.png")
        pose = np.eye(4)
        pose[0, 3] = number
        poses.append({"name": f"{number}.png", "size": [20, 16], "pinhole": [18.0, 18.0, 10.0, 8.0],
                      "world_to_camera": pose.tolist()})  # fmt: skip
    (tmp_path / "poses.json").write_text(json.dumps(poses))
    reader = import_module("made_new").MadeNew()
    assert reader.accepts(tmp_path)
    scene = reader.read(tmp_path, SceneOptions(init="random"))
    assert [view.name for view in scene.views] == ["0.png", "1.png", "2.png"]
    assert (scene.views[0].camera.width, scene.views[0].camera.height) == (20, 16)


def test_every_slot_has_a_template_for_a_generated_plugin():
    assert set(examples()) == set(OFFERED)


def test_the_slot_may_be_given_in_the_singular(ran, tmp_path):
    assert ran("plugins", "new", "made-new", "--slot", "operator", "--out", "elsewhere")[0] == 0
    assert (tmp_path / "elsewhere" / "made_new.py").is_file()


def test_plugins_new_does_not_write_into_an_existing_folder(ran, tmp_path):
    (tmp_path / "made-new").mkdir()
    (tmp_path / "made-new" / "notes.txt").write_text("mine")
    code, _, err = ran("plugins", "new", "made-new", "--slot", "operators")
    assert code == 2
    assert "notes.txt" in err
    assert [path.name for path in (tmp_path / "made-new").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Upper", "is not a valid name"),
        ("class", "is not a valid name"),
        ("../up", "is not a valid name"),
        ("numpy", "an installed package numpy"),
        ("pcgrad", "crossgrad_operators.projection"),
    ],
)
def test_an_invalid_plugin_name_is_refused(ran, tmp_path, name, words):
    code, _, err = ran("plugins", "new", name, "--slot", "operators")
    assert code == 2
    assert words in " ".join(err.split())
    assert not list(tmp_path.iterdir())


def test_an_unknown_slot_is_refused(ran):
    code, _, err = ran("plugins", "new", "made-new", "--slot", "oprators")
    assert code == 2
    assert "did you mean 'operators'?" in err
