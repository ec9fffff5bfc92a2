"""`crossgrad sweep` carries out real runs, once each."""

import json

import yaml
from support.commands import ended
from support.scenes import write_tiny_scene


def test_each_run_of_a_grid_is_executed_once(tmp_path, capsys):
    write_tiny_scene(tmp_path / "tiny", views=6)
    grid, out = tmp_path / "grid.yaml", tmp_path / "out"
    content = {"scenes": ["tiny"], "base": {"steps": 2}, "seeds": [3]}
    grid.write_text(yaml.safe_dump(content))
    assert ended("sweep", grid, "--out", out) == 0
    (summary,) = out.glob("runs/*/summary.json")
    told = json.loads(summary.read_text())
    assert (told["status"], told["step"], told["seed"]) == ("finished", 2, 3)
    written = summary.stat().st_mtime_ns
    capsys.readouterr()
    assert ended("sweep", grid, "--out", out) == 0
    assert summary.stat().st_mtime_ns == written
    assert ended("sweep", grid, "--out", out, "--list") == 0
    assert f"{summary.parent.name}  finished " in capsys.readouterr().out


def test_a_folder_with_other_content_is_not_changed(tmp_path, capsys):
    write_tiny_scene(tmp_path / "tiny", views=6)
    grid, out = tmp_path / "grid.yaml", tmp_path / "out"
    grid.write_text(yaml.safe_dump({"scenes": ["tiny"], "base": {"steps": 2}}))
    out.mkdir()
    (out / "config.yaml").write_text("steps: 3")
    assert ended("sweep", grid, "--out", out) == 2
    assert "do not belong to a sweep" in capsys.readouterr().err
    assert [each.name for each in out.iterdir()] == ["config.yaml"]
