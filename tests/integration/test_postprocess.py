"""Postprocessing of a run does not replace results that its summary describes."""

import json
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from support.commands import ended
from support.scenes import write_tiny_scene

from crossgrad_core.errors import UserError
from crossgrad_core.run import app, load_run
from crossgrad_core.run.export import ExportOptions
from crossgrad_core.run.postprocess import evaluate, export, render
from crossgrad_core.run.postprocess.open_options import How
from crossgrad_core.run.results.lock import locked
from crossgrad_plugins.exporters.ply_file import read_ply

STEPS = 4


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    return write_tiny_scene(folder, views=5, folders=("street", "aerial"))


def run(scene, out, **settings):
    given = {"scene": str(scene), "out": str(out), "steps": STEPS, "threads": 1}
    return app.run({**given, **settings}, verbosity=-1)


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """A run of a backbone that has to be baked."""
    out = tmp_path_factory.mktemp("trained") / "run"
    assert run(scene, out, backbone={"name": "scaffold"}, stop_after=3) == 0
    return out


@pytest.fixture
def finished(trained, tmp_path):
    return Path(shutil.copytree(trained, tmp_path / "run"))


def content(folder: Path) -> dict[str, bytes]:
    # The list of checksums follows each file that is added.
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    files = (path for path in files if path.name != "SHA256SUMS")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def new_files(folder: Path, before: dict[str, bytes]) -> set[str]:
    """Files that were not there before; no other file may have changed."""
    now = content(folder)
    assert {name: now[name] for name in before} == before
    return set(now) - set(before)


def export_file(folder, **options):
    given = ExportOptions(camera=options.pop("camera", None))
    export.export(folder, **{"file_format": "ply", "out": None, "options": given, **options})


def test_baking_for_a_view_does_not_replace_the_file_of_the_summary(finished, capsys):
    before = content(finished)
    export_file(finished, camera="street/0002.png")
    assert new_files(finished, before) == {"point_cloud_street__0002.ply"}
    assert str(finished / "point_cloud_street__0002.ply") in capsys.readouterr().out
    files = (finished / name for name in ("point_cloud.ply", "point_cloud_street__0002.ply"))
    own, baked = (read_ply(file).logit_opacities for file in files)
    assert own.shape != baked.shape or (own != baked).any()
    with pytest.raises(UserError, match="the output file already exists"):
        export_file(finished, camera="street/0002.png")
    with pytest.raises(UserError, match="no view 'nobody'"):
        export_file(finished, camera="nobody")


def test_an_output_name_of_another_file_format_is_refused(finished, tmp_path):
    with pytest.raises(UserError, match=r"a name that ends in \.ply"):
        export_file(finished, out=tmp_path / "scene.splat")
    assert not (tmp_path / "scene.splat").exists()
    export_file(finished, out=tmp_path / "scene.v1.2")
    export_file(finished, out=tmp_path / "scene.PLY")
    assert read_ply(tmp_path / "scene.PLY").means.shape[1] == 3


def test_the_same_export_writes_the_same_file(finished):
    before = content(finished)
    export_file(finished)
    assert new_files(finished, before) == set()


def test_a_backbone_without_baking_cannot_export_for_a_view(scene, tmp_path):
    run(scene, tmp_path / "run", stop_after=1)
    with pytest.raises(UserError, match="vanilla exports the same file for every view"):
        export_file(tmp_path / "run", camera="street/0002.png")


def test_results_of_a_step_newer_than_the_summary_get_separate_file_names(finished):
    """A resumed run that was killed has a checkpoint that is newer than its summary."""
    path = finished / "summary.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "step": 2}))
    before = content(finished)
    export_file(finished)
    evaluate.evaluate(finished)
    expected = {"point_cloud_step-000003.ply", "per_view_step-000003.csv"}
    assert new_files(finished, before) == expected
    assert content(finished)["per_view_step-000003.csv"] == before["per_view.csv"]


def test_a_run_in_training_is_only_read(finished, tmp_path, caplog, capsys):
    with locked(finished, "training"):
        before = content(finished)
        evaluate.evaluate(finished)
        assert "overall" in capsys.readouterr().out
        assert (
            "another process is writing" in caplog.text and "none is written there" in caplog.text
        )
        for write in (
            lambda: export_file(finished),
            lambda: export_file(finished, camera="street/0002.png"),
            lambda: render.render(finished, split="test", out=None),
        ):
            with pytest.raises(
                UserError, match=r"training since(.|\n)*another output path with --out"
            ):
                write()
        export_file(finished, out=tmp_path / "mine.ply")
        render.render(finished, split="test", out=tmp_path / "renders")
        assert content(finished) == before
    assert (tmp_path / "mine.ply").read_bytes() == before["point_cloud.ply"]
    assert len(list((tmp_path / "renders").iterdir())) == 2


def test_render_overwrites_no_image_in_a_folder_named_by_the_user(finished, tmp_path):
    for name, draw in (
        ("street__0001", lambda out: render.render(finished, split="all", out=out)),
        ("00001", lambda out: render.render_path(finished, "zoom", frames=2, out=out)),
    ):
        folder = tmp_path / name
        folder.mkdir()
        (folder / f"{name}.png").write_bytes(b"a photo of mine")
        with pytest.raises(UserError, match="the output file already exists"):
            draw(folder)
        assert content(folder) == {f"{name}.png": b"a photo of mine"}
    for _ in range(2):  # The run's own are drawn anew.
        render.render(finished, split="test", out=None)


def test_a_folder_that_is_not_a_run_is_not_changed(tmp_path):
    for look in (evaluate.evaluate, export_file):
        with pytest.raises(UserError, match="not the folder of a run"):
            look(tmp_path)
    assert content(tmp_path) == {}


def test_an_evaluation_does_not_show_its_memory_as_memory_of_the_run(finished, capsys):
    evaluate.evaluate(finished)
    said = capsys.readouterr().out
    assert "3 steps" in said and "memory" not in said


def test_evaluation_uses_all_threads_and_resuming_uses_the_threads_of_the_run(
    finished, monkeypatch
):
    asked = []
    monkeypatch.setattr(load_run, "configure_threads", asked.append)
    evaluate.evaluate(finished)
    evaluate.evaluate(finished, How(threads=2))
    assert app.run({}, resume=finished, verbosity=-1) == 0
    assert asked == [None, 2, 1]


@pytest.mark.skipif(torch.cuda.is_available(), reason="a machine with CUDA needs no way out")
def test_a_run_trained_with_cuda_can_be_used_on_a_machine_without_cuda(finished, tmp_path, caplog):
    path = finished / "config.yaml"
    stored = yaml.safe_load(path.read_text())
    options = {name: stored["rasterizer"][name] for name in ("near", "dilation", "max_alpha")}
    drawn = {"device": "cuda", "rasterizer": {"name": "gsplat", **options}}
    path.write_text(yaml.safe_dump({**stored, **drawn}))
    looks = (
        lambda how: export_file(finished, out=tmp_path / "a.ply", how=how),
        lambda how: evaluate.evaluate(finished, how),
        lambda how: render.render(finished, split="test", out=tmp_path / "renders", how=how),
    )
    for look in looks:
        with pytest.raises(UserError, match=r"config.yaml, device: cuda(.|\n)*--device cpu"):
            look(How())
        look(How(device="cpu", threads=1))
    assert (tmp_path / "a.ply").read_bytes() == (finished / "point_cloud.ply").read_bytes()
    assert app.run({"device": "cpu"}, resume=finished, verbosity=-1) == 0
    assert "rasterizer gsplat does not run on cpu: another rasterizer is used" in caplog.text


def test_eval_render_and_export_have_the_options_device_and_threads():
    from typer.testing import CliRunner

    from crossgrad_core.cli.main import app as command

    for name in ("eval", "render", "export"):
        text = CliRunner().invoke(command, [name, "--help"]).output
        assert "--device" in text and "--threads" in text


def figures_of(folder, capsys, *options):
    """PSNR overall that `crossgrad eval` prints, and all that it prints."""
    assert ended("eval", str(folder), "--threads", "1", *options) == 0
    printed = capsys.readouterr().out
    (row,) = (line.split() for line in printed.splitlines() if line.startswith("overall"))
    return float(row[2]), printed


def test_a_ply_is_evaluated_on_black_and_nothing_is_written(scene, tmp_path, capsys):
    grey = tmp_path / "grey"
    assert run(scene, grey, background="0.5,0.5,0.5") == 0
    told = json.loads((grey / "summary.json").read_text())
    ply = told["ply"]
    assert (ply["background"], ply["baked_for"]) == ("0.5,0.5,0.5", None)
    assert ply["live_psnr"] == pytest.approx(told["overall"]["psnr"], abs=1e-3)
    assert ply["loss"] == pytest.approx(ply["live_psnr"] - ply["psnr"])
    capsys.readouterr()
    before = content(grey)
    own, _ = figures_of(grey, capsys)
    before = content(grey)
    drawn, printed = figures_of(grey, capsys, "--ply", str(grey / "point_cloud.ply"))
    assert not new_files(grey, before)
    assert own == pytest.approx(ply["live_psnr"], abs=6e-3)
    assert drawn == pytest.approx(ply["psnr"], abs=6e-3)
    assert abs(own - drawn) > 0.05
    assert f"{told['primitives']} Gaussians of" in printed
    assert "rendered on black" in printed


def test_a_message_reports_the_quality_that_the_ply_loses_by_its_background(
    scene, tmp_path, capsys
):
    settings = {"scene": str(scene), "steps": STEPS, "threads": 1}
    for name in ("white", "black", "random"):
        out = tmp_path / name
        assert app.run({**settings, "out": str(out), "background": name}, verbosity=0) == 0
        told = capsys.readouterr().err
        assert ("point_cloud.ply: rendered on black, as viewers do, it has" in told) == (
            name == "white"
        )
        assert ("over its background white" in told) == (name == "white")


def test_a_ply_trained_on_black_has_the_metrics_of_the_run(scene, tmp_path, capsys):
    out = tmp_path / "black"
    assert run(scene, out) == 0
    capsys.readouterr()
    own, _ = figures_of(out, capsys)
    drawn, _ = figures_of(out, capsys, "--ply", str(out / "point_cloud.ply"))
    assert drawn == pytest.approx(own, abs=6e-3)
    other = tmp_path / "none.ply"
    assert ended("eval", str(out), "--ply", str(other)) == 2
    assert str(other) in capsys.readouterr().err
