"""A place that cannot be written to is found before the scene is read and kernels compile."""

import shutil
import sys
import tempfile
from itertools import product
from pathlib import Path

import pytest
from support.scenes import write_tiny_scene

from crossgrad_core.cli.main import main
from crossgrad_core.run import assemble
from crossgrad_core.training import start


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    write_tiny_scene(folder, views=5)
    return folder


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    run = tmp_path_factory.mktemp("run") / "run"
    with pytest.raises(SystemExit, match="0"):
        main(["run", str(scene), "--steps", "1", "--rasterizer", "torch", "--out", str(run), "-q"])
    return run


@pytest.fixture(autouse=True)
def lazy(request, monkeypatch):
    """No scene is read and no kernel loaded after the run that others look at is there."""
    request.getfixturevalue("trained")

    def worked(*_, **__):
        raise AssertionError("work was done for nothing")

    for module in list(sys.modules.values()):
        for name, function in (("read_scene", assemble.read_scene), ("warm_up", start.warm_up)):
            if getattr(module, name, None) is function:
                monkeypatch.setattr(module, name, worked)


def forbidden(monkeypatch, tmp):
    """The system refuses every user, even root, who may write anywhere."""

    def refused(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(tempfile, "TemporaryFile", refused)
    return tmp / "new"


def below_a_file(monkeypatch, tmp):
    (tmp / "file").touch()
    return tmp / "file" / "new"


def full(monkeypatch, tmp):
    usage = shutil.disk_usage(tmp)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    return tmp / "new"


def commands(scene, run, place):
    file = str(place / "file")
    return {
        "run": ["run", str(scene), "--out", str(place), "-q"],
        "render": ["render", str(run), "--out", str(place)],
        "export": ["export", str(run), "--out", file],
        "diagnose": ["diagnose", str(scene), "--out", str(place)],
        "signature": ["diagnose", str(scene), "--signature", file],
        "stress": ["stress", "sum", "--csv", file],
    }


COMMANDS = ["run", "render", "export", "diagnose", "stress"]


@pytest.mark.parametrize(
    ("obstacle", "command"),
    [*product((forbidden, below_a_file), COMMANDS), (below_a_file, "signature")],
)
def test_an_unwritable_output_path_is_reported_before_anything_is_written(
    obstacle, command, request, tmp_path, monkeypatch, capsys
):
    place = obstacle(monkeypatch, tmp_path)
    scene, trained = map(request.getfixturevalue, ("scene", "trained"))
    before = sorted(path for path in tmp_path.rglob("*"))
    with pytest.raises(SystemExit, match="2"):
        main(commands(scene, trained, place)[command])
    message = capsys.readouterr().err
    assert str(place) in message and "to do:" in message
    assert sorted(path for path in tmp_path.rglob("*")) == before


def test_an_unwritable_default_folder_of_runs_is_reported_at_once(
    scene, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("runs").touch()
    with pytest.raises(SystemExit, match="2"):
        main(["run", str(scene), "-q"])
    assert "runs is not a folder" in capsys.readouterr().err


def test_a_full_disk_is_reported_at_once(scene, tmp_path, monkeypatch, capsys):
    place = full(monkeypatch, tmp_path)
    with pytest.raises(SystemExit, match="2"):
        main(["run", str(scene), "--out", str(place), "-q"])
    message = capsys.readouterr().err
    assert "not enough disk space" in message and "choose another disk" in message
