"""What version 0.1 wrote is read by this one.

`data/run-0.1` is a run of 20 steps by crossgrad 0.1.0 on the tiny scene below, without its
pictures and log; its scene was called SCENE.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.scenes import write_tiny_scene

import crossgrad_core as cg
from crossgrad_core.cli.main import main
from crossgrad_core.config import RunConfig
from crossgrad_core.run.migration import migrated
from crossgrad_core.run.results.config_file import read_config, read_notes
from crossgrad_core.run.settings import merged

OLD = Path(__file__).parent / "data" / "run-0.1"
FILE = Path("config.yaml")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    return write_tiny_scene(folder, views=9, points=60, width=32, height=24)


@pytest.fixture
def old(scene, tmp_path):
    folder = Path(shutil.copytree(OLD, tmp_path / "run"))
    config = folder / "config.yaml"
    config.write_text(config.read_text().replace("SCENE", str(scene)))
    return folder


def _parts(ply):
    """Header and numbers of a PLY of float32."""
    header, _, body = ply.read_bytes().partition(b"end_header\n")
    return header, np.frombuffer(body, "<f4")


def test_a_run_of_0_1_is_evaluated_rendered_and_exported(old, tmp_path):
    run = cg.open(old)
    means = run.evaluate().overall
    assert means["psnr"] == pytest.approx(run.summary["overall"]["psnr"], abs=1e-3)
    assert means["psnr"] == pytest.approx(run.metrics["psnr"][-1], abs=1e-3)
    image = run.render(run.scene.test_views[0].name)
    assert image.shape == (24, 32, 3) and image.std() > 0.05
    exported = run.export(tmp_path / "old.ply")
    header, values = _parts(exported)
    old_header, old_values = _parts(OLD / "point_cloud.ply")
    assert header == old_header
    # Logarithms differ in the last place from one processor to another.
    np.testing.assert_allclose(values, old_values, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("command", ["eval", "render", "export"])
def test_the_commands_open_a_run_of_0_1(old, command, capfd):
    with pytest.raises(SystemExit) as ended:
        main([command, str(old)])
    assert not ended.value.code
    assert capfd.readouterr().out


def test_the_configuration_of_a_run_of_0_1_repeats_it(old, scene, tmp_path):
    again = cg.run(config=old / "config.yaml", out=tmp_path / "again", steps=2, quiet=True)
    assert again.summary["config"]["operator"] == {"name": "pcgrad", "granularity": "kind"}
    written = yaml.safe_load((again.folder / "config.yaml").read_text())
    assert written.pop("crossgrad") == "0.2"
    assert tuple(written.pop("notes")) == read_notes(again.folder)
    # Where that start was to stop is no part of what repeats the run.
    assert written == {**again.summary["config"], "stop_after": None}


def test_a_run_of_0_1_keeps_its_units_and_rates(old):
    kept = read_config(old)
    assert (kept["events"], kept["rate_factor"]) == ("steps", 1.0)
    assert (kept["beta1"], kept["beta2"]) == (0.9, 0.999)
    assert kept["lr_tail"] == 0.0


def test_a_stopped_run_of_0_1_goes_on(old):
    config = old / "config.yaml"
    config.write_text(config.read_text().replace("steps: 20", "steps: 24"))
    header, *rows = (old / "metrics.csv").read_text().splitlines()
    assert cg.resume(old, quiet=True).summary["status"] == "finished"
    now = (old / "metrics.csv").read_text().splitlines()
    assert now[0] == header.replace("train_seconds", "train_seconds,cpu_seconds")
    assert [row.partition(",")[0] for row in now[1 + len(rows) :]] == ["22", "24"]


def test_a_file_by_hand_without_a_version_measures_what_this_version_does():
    assert "metrics" not in migrated({"steps": 24}, FILE)
    assert migrated({"revisions": [], "metrics": ["psnr"]}, FILE)["metrics"] == ["psnr"]


def test_a_run_of_0_1_keeps_the_photos_that_it_held_out(tmp_path):
    def split(**more):
        return migrated({"scene": str(tmp_path), **more}, FILE).get("reading")

    whole = {"split": "auto", "test_every": 8}
    assert split(reading=whole) == {"split": "every", "test_every": 8}
    assert split(crossgrad="0.2", reading=whole) == whole
    assert split(reading={"split": "none"}) == {"split": "none"}
    # A file by hand that does not say how has the way of this version.
    assert split(reading={"max_size": 99}) == {"max_size": 99}
    assert split() is None
    (tmp_path / "test_list.txt").write_text("a.jpg\n")
    assert split(reading=whole) == whole


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ({"name": "sum", "granularity": "tensor"}, {"name": "sum"}),
        ({"name": "graddrop", "granularity": "tensor"}, {"name": "graddrop"}),
        ({"name": "pcgrad", "granularity": "tensor"}, {"name": "pcgrad", "granularity": "block"}),
        ({"name": "pcgrad", "granularity": "group"}, {"name": "pcgrad", "granularity": "kind"}),
        ({"name": "pcgrad", "granularity": "global"}, {"name": "pcgrad", "granularity": "global"}),
        (
            {"name": "mgda", "granularity": "gaussian"},
            {"name": "mgda", "granularity": "gaussian"},
        ),
        ({"name": "pcgrad"}, {"name": "pcgrad"}),
        ({"name": "nobody", "granularity": "group"}, {"name": "nobody", "granularity": "kind"}),
        (
            [
                {"name": "preconditioner", "granularity": "tensor"},
                {"name": "symmetric", "granularity": "tensor"},
            ],
            [{"name": "preconditioner"}, {"name": "symmetric", "granularity": "block"}],
        ),
        (
            {
                "name": "dispatch",
                "granularity": "group",
                "rules": {"geometry": {"name": "mean", "granularity": "tensor"}},
            },
            {"name": "dispatch", "granularity": "kind", "rules": {"geometry": {"name": "mean"}}},
        ),
    ],
)
def test_operators_of_0_1_have_the_granularity_of_now(old, new):
    assert migrated({"operator": old, "seed": 3}, FILE) == {"operator": new, "seed": 3}


def test_a_configuration_of_0_2_is_taken_as_it_stands(tmp_path):
    operator = {"name": "pcgrad", "granularity": "group"}
    assert migrated({"crossgrad": "0.2", "operator": operator}, FILE) == {"operator": operator}
    config = tmp_path / "config.yaml"
    config.write_text("crossgrad: 0.2\noperator: {name: sum, granularity: tensor}\n")
    with pytest.raises(cg.UserError, match="sum has no option"):
        cg.run(config=config, out=tmp_path / "run", quiet=True)


def test_what_a_user_types_is_of_this_version(scene, tmp_path):
    for operator in ("sum", "pcgrad"):
        with pytest.raises(cg.UserError, match="granularity"):
            cg.run(scene, operator={"name": operator, "granularity": "tensor"}, quiet=True)


def test_short_forms_in_a_file_of_0_1(tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text("operator: [{name: mean, granularity: tensor}, soft]\nsteps: 5\n")
    settings = merged(config, {}, ())
    assert settings == {"operator": [{"name": "mean"}, {"name": "soft"}], "steps": 5}


def test_the_default_preset_has_a_name_now():
    assert RunConfig(preset="default") == RunConfig(preset="fast") == RunConfig()


def test_a_configuration_of_a_newer_version_is_refused(old):
    config = old / "config.yaml"
    config.write_text("crossgrad: '0.9'\n" + config.read_text())
    with pytest.raises(cg.UserError, match=r"another version(.|\n)*0\.9(.|\n)*install"):
        read_config(old)
