"""The end of `crossgrad prepare`: the planner's command, and a picture of what is known."""

import shlex
from types import SimpleNamespace

import pycolmap
import pytest
from matplotlib.figure import Figure
from support.commands import ended
from support.scenes import write_tiny_scene

from crossgrad_core.run.app import bundled_scene
from crossgrad_plugins.prepare import app
from crossgrad_plugins.prepare.app import draw
from crossgrad_plugins.prepare.plan import Settings


def test_the_last_line_is_the_command_that_the_planner_advises(tmp_path, monkeypatch, capsys):
    scene = write_tiny_scene(tmp_path / "of 12 photos", views=12, points=120)
    monkeypatch.setattr(app, "prepared", lambda *_: None)
    monkeypatch.setattr(app, "summary_lines", lambda _: [])
    app.prepare_scene(tmp_path, scene, Settings(), None)
    *_, length, last = capsys.readouterr().out.splitlines()
    assert length.startswith("planned length: 1,000 views, 100 views of each of 10 training")
    assert ended("plan", scene) == 0
    (advised,) = [x for x in capsys.readouterr().out.splitlines() if x.startswith("run it: ")]
    assert last.removeprefix("next: ") == advised.removeprefix("run it: ")
    words = shlex.split(last.removeprefix("next: crossgrad run "))
    assert words == [str(scene)]


@pytest.mark.parametrize(("georef", "known"), [(None, False), ({}, True)])
def test_a_diagram_is_titled_from_above_only_if_up_is_known(georef, known, monkeypatch):
    model = pycolmap.Reconstruction(bundled_scene() / "sparse" / "0")
    photos = [SimpleNamespace(name=each.name, folder="") for each in model.images.values()]
    report = SimpleNamespace(
        result=SimpleNamespace(georef=georef),
        plan=SimpleNamespace(used=photos, folders=[""]),
        links=[],
        posed=[each.name for each in photos],
    )
    titles = []

    def save(figure, *_, **__):
        titles.extend(axes.get_title() for axes in figure.axes)

    monkeypatch.setattr(Figure, "savefig", save)
    draw(report, model)
    assert len(titles) == 2
    assert ("from above" in titles) == known
