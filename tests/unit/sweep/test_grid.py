"""The grid file: what it means, and everything that can be wrong with it at once."""

import pytest
from support.commands import ended

from crossgrad_core.commands import UserError
from crossgrad_plugins.sweep.grid import choices, read_grid, with_scenes


def written(folder, text):
    path = folder / "grid.yaml"
    path.write_text(text)
    return path


def labels(grid):
    return [each.label for each in choices(grid)]


def test_parameters_are_combined_and_the_last_one_varies_fastest(tmp_path):
    grid = read_grid(written(tmp_path, """
        parameters:
          sampler: {values: [epoch, random]}
          rate: {values: [1, 2]}
          steps: {value: 30}
    """))  # fmt: skip
    assert labels(grid) == [
        f"run, sampler={sampler}, rate={rate}, steps=30"
        for sampler in ("epoch", "random")
        for rate in (1, 2)
    ]


def test_parameters_inside_a_component_become_its_options(tmp_path):
    text = "parameters: {operator: {parameters: {name: {value: cagrad}, c: {values: [0, 1]}}}}"
    found = choices(read_grid(written(tmp_path, text)))
    assert [each.parameters for each in found] == [
        {"operator.name": "cagrad", "operator.c": c} for c in (0, 1)
    ]


def test_an_arm_may_have_its_own_parameters(tmp_path):
    grid = read_grid(written(tmp_path, """
        arms:
          - {name: one, settings: {views: 1}}
          - {name: two, settings: {views: 2}, parameters: {operator: {values: [sum, pcgrad]}}}
        parameters: {backbone: {values: [vanilla, mip]}}
    """))  # fmt: skip
    assert labels(grid) == [
        "one, backbone=vanilla",
        "one, backbone=mip",
        "two, backbone=vanilla, operator=sum",
        "two, backbone=vanilla, operator=pcgrad",
        "two, backbone=mip, operator=sum",
        "two, backbone=mip, operator=pcgrad",
    ]


def test_scenes_and_seeds_may_be_given_as_parameters(tmp_path):
    text = "parameters: {scene: {values: [a, b]}, seed: {values: [3, 4]}}"
    grid = read_grid(written(tmp_path, text))
    assert grid.seeds == (3, 4)
    assert grid.scenes == (str(tmp_path / "a"), str(tmp_path / "b"))
    assert labels(grid) == ["run"]


def test_scene_paths_are_relative_to_the_grid_file(tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    path = written(tmp_path, "scenes: [scene, ../other, /abs]")
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert read_grid(path).scenes == (
        str(tmp_path / "scene"),
        str(tmp_path.parent / "other"),
        "/abs",
    )


def test_replaced_scenes_keep_the_settings_for_scenes_with_their_name(tmp_path):
    text = "scenes: [a, b]\narms: [{name: x, by_scene: {a: {steps: 3}, b: {steps: 4}}}]"
    grid = with_scenes(read_grid(written(tmp_path, text)), [tmp_path / "b", tmp_path / "c"])
    assert grid.arms[0].by_scene == {"b": {"steps": 4}}
    with pytest.raises(UserError, match="same name"):
        with_scenes(grid, [tmp_path / "b", tmp_path / "c" / "b"])


#: Grid, what the error says of it.
WRONG = {
    "sceens: [a]": "did you mean 'scenes'?",
    "steps: 30": "put settings below base",
    "method: bayes": "method: ",
    "parameters: {rate: {min: 0, max: 1}}": "distributions (max, min) are not supported",
    "parameters: {rate: [1, 2]}": "must be `values: [...]`",
    "parameters: {rate: {values: []}}": "parameters.rate.values: should not be empty, not []",
    "parameters: {rate: {values: sum}}": "parameters.rate.values: should be a list, not 'sum'",
    "name: ../esc": "name: must be the name of a folder below runs/sweeps",
    "name: ..": "name: must be the name of a folder",
    "name: ''": "name: must be the name of a folder",
    "parameters: {rate: {values: [1], value: 2}}": "exactly one of",
    "base: {out: x}": "base.out: cannot be set by a grid",
    "base: {threads: 2}": "use --threads",
    "parameters: {stop_after: {value: 3}}": "parameters.stop_after",
    "arms: [{name: a, settings: {seed: 1}}]": "list it in seeds",
    "base: {scene: x}": "list it in scenes",
    "arms: [{settings: {}}]": "arms.0.name",
    "arms: [{name: a}, {name: a}]": "two entries have the name 'a'",
    "seeds: [1, 1]": "twice",
    "seeds: [-1]": "seeds.0",
    "scenes: [x/a, y/a]": "two entries have the name 'a'",
    "scenes: [town]\narms: [{name: a, by_scene: {towm: {}}}]": "did you mean 'town'?",
    "seeds: [1]\nparameters: {seed: {values: [1]}}": "may be given only once",
}


@pytest.mark.parametrize("text", WRONG)
def test_errors_of_a_grid_name_the_file_and_the_position(tmp_path, text):
    with pytest.raises(UserError) as caught:
        read_grid(written(tmp_path, text))
    assert WRONG[text] in str(caught.value)
    assert str(tmp_path / "grid.yaml") in str(caught.value)


def test_a_list_with_only_invalid_entries_gives_one_error(tmp_path):
    with pytest.raises(UserError) as caught:
        read_grid(written(tmp_path, "seeds: [-1]"))
    assert "not be empty" not in str(caught.value) and "2 things" not in str(caught.value)


def test_all_errors_of_a_grid_are_reported_at_once(tmp_path):
    text = "base: {out: x, threads: 1}\nseeds: [1, 1]\narms: [{name: a}, {name: a}]"
    with pytest.raises(UserError, match="the grid has 4 errors"):
        read_grid(written(tmp_path, text))


@pytest.mark.parametrize(
    ("metric", "goal"),
    [
        ("{}", "maximize"),
        ("{name: ssim}", "maximize"),
        ("{name: lpips_vgg}", "minimize"),
        ("{name: lpips, goal: maximize}", "maximize"),
    ],
)
def test_lpips_is_minimized_by_default(tmp_path, metric, goal):
    assert read_grid(written(tmp_path, f"metric: {metric}")).metric.goal == goal


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--set", "seed=7"), "say --seed"),
        (("--set", "scene=there"), "say --scene"),
        (("--set", "stop_after=2"), "to its end"),
        (("--set", " threads =2"), "use --threads"),
        (("--set", "out=there"), "--set out"),
        (("--seed", "3", "--seed", "3"), "a seed is listed twice"),
        (("--list", "--best", "best.yaml"), "--list and --best cannot be combined"),
        (("--dry-run", "--list"), "--dry-run and --list cannot be combined"),
    ],
    ids=lambda case: " ".join(case) if isinstance(case, tuple) else "",
)
def test_sweep_options_without_effect_are_refused(tmp_path, capsys, options, words):
    path = written(tmp_path, "base: {steps: 3}")
    shown = () if "--list" in options else ("--dry-run",)
    assert ended("sweep", path, "--out", tmp_path / "out", *shown, *options) == 2
    assert words in capsys.readouterr().err


def test_an_empty_grid_defines_one_run_of_the_bundled_scene(tmp_path):
    grid = read_grid(written(tmp_path, ""))
    assert (grid.scenes, grid.seeds, labels(grid)) == ((None,), (0,), ["run"])


def test_a_small_grid_file_with_too_many_runs_is_refused(tmp_path):
    ten = "{values: [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]}"
    grid = lambda number: "parameters:\n" + "".join(  # noqa: E731
        f"  p{i}: {ten}\n" for i in range(number)
    )  # fmt: skip
    assert len(choices(read_grid(written(tmp_path, grid(4))))) == 10_000
    seeds = "seeds: [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]\n"
    for text in (grid(80), seeds + grid(4)):
        with pytest.raises(UserError, match="at most 100,000"):
            read_grid(written(tmp_path, text))


@pytest.mark.parametrize(
    "text",
    [
        "parameters: {views: {values: [1, 1]}}",
        "arms: [{name: 'a, views=2'}, {name: a, parameters: {views: {values: [2, 3]}}}]",
    ],
)
def test_two_configurations_with_the_same_name_are_refused(tmp_path, text):
    path = tmp_path / "grid.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match="two configurations have the name"):
        read_grid(path)
