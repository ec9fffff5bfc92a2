"""The page that a run writes in addition to its file, so that a double click shows the scene."""

import json

import pytest
from support.commands import ended
from support.scenes import write_tiny_scene

from crossgrad_core.run import app, export
from crossgrad_core.run.export import ExportOptions
from crossgrad_core.run.postprocess.export import exported

STEPS = 4


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=5)


def run(scene, out, **settings):
    given = {"scene": str(scene), "out": str(out), "steps": STEPS, "threads": 1}
    return app.run({**given, **settings}, verbosity=-1)


def summary(out):
    return json.loads((out / "summary.json").read_text())


def facts(page):
    text = page.read_text(encoding="utf-8")
    return json.loads(text.partition('id="scene">')[2].partition("</script>")[0])


def test_a_run_writes_a_page_of_its_scene_and_its_training_cameras(scene, tmp_path):
    out = tmp_path / "run"
    assert run(scene, out) == 0
    assert "point_cloud.html" in summary(out)["exports"]
    shown = facts(out / "point_cloud.html")
    assert shown["gaussians"] == summary(out)["exports"]["point_cloud.ply"]["gaussians"]
    assert f"crossgrad step {STEPS}" in shown["comments"]
    assert len(shown["cameras"]) == 4
    assert "point_cloud.html" in (out / "SHA256SUMS").read_text()


def test_a_large_scene_gets_no_page_and_loses_an_old_one(scene, tmp_path, monkeypatch):
    out = tmp_path / "run"
    assert run(scene, out, stop_after=2) == 0
    assert (out / "point_cloud.html").is_file()
    monkeypatch.setattr(export, "MOST_PAGE_BYTES", 1000)
    assert app.run({}, resume=out, verbosity=-1) == 0
    assert summary(out)["status"] == "finished"
    assert "point_cloud.html" not in summary(out)["exports"]
    assert not (out / "point_cloud.html").exists()


def test_a_run_that_exports_a_page_anyway_writes_one_page(scene, tmp_path):
    out = tmp_path / "run"
    assert run(scene, out, exporter={"name": "html"}) == 0
    assert [*summary(out)["exports"]] == ["point_cloud.html"]
    assert summary(out)["exports"]["point_cloud.html"]["loss"] is not None
    assert [path.name for path in out.glob("point_cloud*")] == ["point_cloud.html"]


def test_the_gaussians_of_a_mip_run_keep_their_response_in_a_page(scene, tmp_path):
    out = tmp_path / "run"
    assert run(scene, out, backbone={"name": "mip"}) == 0
    assert facts(out / "point_cloud.html")["antialiased"] is True
    path, content = exported(out, file_format="html", out=tmp_path / "other.html")
    assert (content.baked_for, facts(path)["antialiased"]) == (None, True)
    assert abs(content.loss) < 0.1
    _, baked = exported(out, file_format="ply", out=tmp_path / "other.ply")
    assert baked.baked_for == "4 training views"
    unbaked = ExportOptions(baked=False)
    _, kept = exported(out, file_format="ply", out=tmp_path / "unbaked.ply", options=unbaked)
    assert kept.baked_for is None


def test_the_last_line_of_a_run_names_the_page(scene, tmp_path, capsys):
    out = tmp_path / "run"
    assert ended("run", scene, "--out", out, "--steps", 2, "--threads", 1) == 0
    printed = capsys.readouterr().out
    assert printed.endswith(f"open the scene in a browser: {out / 'point_cloud.html'}\n")
