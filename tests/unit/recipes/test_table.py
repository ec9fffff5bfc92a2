"""Recipes decide every open setting; what they decided is written down and repeats the run."""

import pytest
import yaml
from pydantic import ValidationError
from support.scenes import write_tiny_scene

import crossgrad_core as cg
from crossgrad_core.config import RunConfig
from crossgrad_core.contract.decision import Length
from crossgrad_core.errors import UserError
from crossgrad_core.recipe.table import DECIDED, LINES, short_lines
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.decisions import with_decisions
from crossgrad_core.run.resolve import resolved
from crossgrad_core.run.settings import merged
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_plugins.recipes import auto
from crossgrad_plugins.recipes.auto import Auto

#: Characters of a decision on the terminal.
WIDTH = 100


def assembled(**settings):
    return assemble(RunConfig.model_validate(settings), sample_scene(), "none")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run of 30 steps."""
    folder = tmp_path_factory.mktemp("recipes")
    scene = write_tiny_scene(folder / "tiny", views=9, points=60, width=32, height=24)
    return cg.run(scene, steps=30, out=folder / "run", threads=1, quiet=True)


def test_a_finished_run_records_every_decided_value(finished):
    written = yaml.safe_load((finished.folder / "config.yaml").read_text(encoding="utf-8"))
    assert not [name for name in DECIDED if written[name] is None]
    assert {*DECIDED, "densifier.division"} <= written["decided"].keys()
    assert isinstance(written["max_gaussians"], int)
    assert (written["rate_factor"], written["beta1"]) == (6.3, 0.7)
    rows = {row["setting"]: row for row in finished.summary["decisions"]}
    assert {*DECIDED} <= rows.keys()
    assert rows["rate_factor"]["value"] == 6.3 and rows["rate_factor"]["override"]


@pytest.mark.slow
def test_a_run_is_repeated_bit_for_bit_after_the_constants_of_the_recipe_changed(
    finished, tmp_path, monkeypatch
):
    changed = {name for name, value in vars(auto).items() if type(value) in {int, float}}
    assert {"SHORTNESS", "FEW_PASSES", "LR_TAIL", "SCALE_RATIO"} <= changed
    # A half of this one is no decay that Adam accepts.
    monkeypatch.setattr(auto, "BETA2", 0.95)
    for name in changed - {"REFERENCE", "BETA2"}:
        monkeypatch.setattr(auto, name, getattr(auto, name) / 2)
    other = tmp_path / "other"
    repeated = cg.run(config=finished.folder / "config.yaml", out=tmp_path / "again", quiet=True)
    cg.run(finished.summary["config"]["scene"], steps=30, out=other, threads=1, quiet=True)
    cloud = (finished.folder / "point_cloud.ply").read_bytes()
    assert (repeated.folder / "point_cloud.ply").read_bytes() == cloud
    assert (other / "point_cloud.ply").read_bytes() != cloud


def test_growth_is_unbounded_at_the_published_length():
    for steps, growth in ((29_999, "budget"), (30_000, "unbounded")):
        setup = assembled(steps=steps)
        assert setup.numbers.growth == growth
        assert ("growth" in {row.setting for row in setup.decisions if row.override}) == (
            growth == "budget"
        )


@pytest.mark.parametrize(("steps", "short"), [(14_999, True), (15_000, False), (29_999, False)])
def test_a_run_with_two_views_per_step_is_short_or_long_in_all_settings(steps, short):
    setup = assembled(steps=steps, views_per_step=2, operator={"name": "mean"})
    numbers = setup.numbers
    assert (numbers.rate_factor > 1.0) == short
    assert (numbers.position_lr == "per-axis") == short
    assert ("scale-clamp" in setup.selection.rules) == short
    assert (numbers.growth == "budget") == short
    assert (numbers.beta1 < 0.9) == short
    assert (numbers.reset_every == 0) == short


def test_a_value_that_rounds_to_the_published_value_is_not_reported():
    setup = assembled(max_views=29_999, views_per_step=2, operator={"name": "mean"})
    assert 0.899 < setup.numbers.beta1 < 0.9
    assert not [line for line in short_lines(setup.decisions) if line.startswith("beta1 ")]


@pytest.mark.sampled(7)
@pytest.mark.parametrize("name", DECIDED)
def test_a_recipe_without_a_row_is_refused_with_the_name_of_the_setting(name, monkeypatch):
    decide = Auto.decide

    def without(self, facts):
        return [row for row in decide(self, facts) if row.setting != name]

    monkeypatch.setattr(Auto, "decide", without)
    with pytest.raises(UserError, match="does not decide every setting") as caught:
        assembled(steps=30)
    assert caught.value.found == f"no row for {name}"


@pytest.mark.parametrize("name", ["posithon_lr", "data.max_sise"])
def test_a_reason_for_something_that_is_not_a_setting_is_refused(name):
    with pytest.raises(ValidationError) as caught:
        RunConfig(decided={name: "as published"})
    assert f"{name} is not a setting" in str(caught.value)


@pytest.mark.sampled(7)
@pytest.mark.parametrize("steps", [30, 700, 3_000, 15_000, 60_000])
@pytest.mark.parametrize("backbone", ["vanilla", "scaffold", "mip"])
def test_the_terminal_shows_a_few_short_lines(steps, backbone):
    setup = assembled(steps=steps, backbone={"name": backbone})
    lines = short_lines(setup.decisions)
    assert len(lines) <= LINES
    assert all(len(line) <= WIDTH for line in lines)


def test_a_new_length_for_a_file_is_decided_again_and_user_values_are_kept(tmp_path):
    written = resolved(assembled(steps=30, rate_factor=2.0)).model_dump(mode="json")
    file = tmp_path / "config.yaml"
    file.write_text(yaml.safe_dump(written), encoding="utf-8")
    same = RunConfig.model_validate(merged(file, {}, ()))
    assert same.beta1 == 0.7
    longer = RunConfig.model_validate(merged(file, {"steps": 9_487}, ()))
    config, rows, _ = with_decisions(longer, sample_scene())
    assert config.beta1 == pytest.approx(0.8, abs=1e-4)
    assert config.rate_factor == 2.0 and "rate_factor" not in {row.setting for row in rows}
    own = RunConfig.model_validate(merged(file, {}, ("beta1=0.5",)))
    assert own.beta1 == 0.5 and "beta1" not in own.decided


def test_a_run_in_seconds_reuses_no_decision_of_an_unplanned_length():
    dry = assembled(seconds=60.0)
    again = assemble(resolved(dry), dry.scene, "none")
    planned = again.decide(Length(500, 500))
    assert {row.setting: row.value for row in planned}["rate_factor"] > 1.0
