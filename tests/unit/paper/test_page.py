"""The page of the paper's claims: nothing is left out, and nothing is made up."""

import re

import pytest
from support.paper_runs import write_probes

OUTCOMES = ("holds", "does not hold", "inconclusive", "not run", "not testable")


@pytest.fixture(scope="module")
def grids(modules):
    from crossgrad_plugins.sweep.grid import read_grid

    plan = modules.data.read_plan()
    names = (plan.tuning, *plan.grids)
    return {name: read_grid(modules.data.GRIDS / f"{name}.yaml") for name in names}


@pytest.fixture(scope="module")
def measured(modules, grids):
    return {name: grids[name] for name in modules.data.read_plan().grids}


@pytest.fixture(scope="module")
def empty(modules, measured):
    """The page before anything has run."""
    results = modules.runs.read_results({}, measured)
    extra = [arm.name for arm in measured["more_backbones"].arms]
    return modules.page.page(modules.data.read_claims(), results, modules.data.read_tables(), extra)


def verdicts(text):
    """The last cell of each row of a table of verdicts."""
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| ")]
    return [re.split(r"[:|]", row[-1])[0].strip() for row in rows if len(row) == 5]


def test_every_table_and_row_of_the_paper_is_on_the_page(modules, empty):
    for table, methods in modules.data.read_tables().items():
        assert f"(`{table}`)" in empty
        part = empty.partition(f"(`{table}`)")[2].partition("###")[0]
        for method in methods:
            assert f"\n| {method} |" in part


def test_every_claim_of_the_paper_is_on_the_page(modules, empty):
    for section in modules.data.read_claims().sections:
        assert f"### {section.title}" in empty
        for claim in section.claims:
            assert f"| {claim.where} | {claim.says} |" in empty


def test_the_page_makes_no_claim_without_runs(empty):
    found = verdicts(empty)
    # What follows from the paper's own tables needs no run.
    assert found.count("does not hold") == 1 and "from the paper's own tables" in empty
    assert not {"holds", "inconclusive"} & set(found)
    assert found.count("not run") > 60
    assert re.search(r"\*\*0 of \d+ runs have finished\.\*\*", empty)


def test_every_tested_row_names_its_command(modules, empty):
    scripts = re.findall(r"`python benchmarks/paper\.py run --only ([\w,]+)`", empty)
    names = {name for script in scripts for name in script.split(",")}
    assert names <= set(modules.data.read_plan().grids)
    assert names >= {"views", "pairing", "operators", "variants", "groupings", "backbones"}


def test_claims_name_arms_that_exactly_one_grid_defines(modules, measured):
    homes = [arm.name for grid in measured.values() for arm in grid.arms]
    assert len(set(homes)) == len(homes)
    named = {arm for check in modules.data.read_claims().checks() for arm in check.arms}
    named |= set(modules.page.WATCHED)
    named |= {arm for arms in modules.page.EQUAL.values() for arm in arms}
    named |= set(modules.data.read_plan().best_of.candidates)
    assert named <= set(homes)


def test_every_arm_of_the_grids_is_on_the_page(modules, measured):
    named = {arm for check in modules.data.read_claims().checks() for arm in check.arms}
    homes = {a.name for n, g in measured.items() if n != "more_backbones" for a in g.arms}
    assert homes <= named


def test_every_learning_rate_comes_from_a_tuned_arm(modules, grids):
    plan = modules.data.read_plan()
    tuned = {arm.name for arm in grids[plan.tuning].arms}
    assert set(plan.rates.values()) <= tuned
    like = plan.best_of.scaffold_like.values()
    assert {arm for arms in like for arm in arms.values()} <= tuned
    assert set(grids[plan.tuning].seeds).isdisjoint(
        seed for name in plan.grids for seed in grids[name].seeds
    )


def test_the_grids_of_the_paper_need_at_most_twelve_core_hours(modules, grids):
    plan, total = modules.data.read_plan(), 0.0
    for name, grid in grids.items():
        cells = len(grid.scenes) * len(grid.seeds)
        values = 3 if name == plan.tuning else modules.data.BEST if "more" in name else 1
        for arm in grid.arms:
            total += cells * values * modules.paper.run_seconds({**grid.base, **arm.settings})
    assert total <= 12 * 3600


def test_runs_are_shown_per_scene_and_over_training(modules, planted, grid_of):
    arms = {"one view, 1x": 0.0, "one view, 2x stretched": 0.5, "two random views": 0.5}
    sweep = planted("views", {**arms, "symmetric": 0.5})
    figures = {
        "conflict_rate": 0.5, "ratio_of_means": 2.0, "sigma_w2": 4.0, "sigma_b2": 0.2,
        "rho": 0.05, "rho_low": 0.0, "rho_high": 0.11, "exponent_depth": 1.5,
    }  # fmt: skip
    blocks = ("means", "opacities+f_dc", "all")
    write_probes(sweep, {(m, b): figures for m in ("plain", "adam") for b in blocks})
    results = modules.runs.read_results({"views": sweep}, {"views": grid_of([*arms, "symmetric"])})
    text = modules.page.page(modules.data.read_claims(), results, modules.data.read_tables())
    assert "**48 of 48 runs have finished.**" in text
    assert re.search(r"\| city \| equal steps \| \+0\.\d+ dB .*n = 3.*\| different \|", text)
    assert re.search(r"\| town \| equal views \| .*n = 3.*\| equivalent \|", text)
    assert re.search(r"\| wood \| equal seconds \|  \|  \| not run: in no grid \|", text)
    row = "| one view, 2x stretched | field | 20 | 0.5 (0.5) | 2 | 2 | 4 | 0.2 | 0.05 (0 to 0.11) |"
    assert row in text
    assert "Two views per step beat one at equal steps." in text
    (line,) = [x for x in text.splitlines() if "beat one at equal steps. |" in x and "At" not in x]
    assert line.endswith("| holds |")


@pytest.mark.parametrize(("low", "high"), [("", ""), (0.0, 0.0)], ids=["now", "before"])
def test_an_estimate_below_zero_without_an_interval_is_marked(modules, planted, grid_of, low, high):
    sweep = planted("below", {"symmetric": 0.0})
    figures = {"sigma_w2": 4.0, "sigma_w2_low": 3.0, "sigma_w2_high": 5.0, "rho": -0.0105}
    figures |= {"rho_low": low, "rho_high": high, "sigma_b2": -0.042, "conflict_rate": 0.5}
    figures |= {"sigma_b2_low": 0.0, "sigma_b2_high": 0.1, "exponent_depth": 1.0}
    write_probes(sweep, {(m, "all"): figures for m in ("plain", "adam")})
    results = modules.runs.read_results({"x": sweep}, {"x": grid_of(["symmetric"])})
    text = modules.page.page(modules.data.read_claims(), results, modules.data.read_tables())
    none = "-0.0105 (none, the estimate is below 0)"
    assert f"| 4 (3 to 5) | -0.042 (0 to 0.1) | {none} | {none} |" in text


def test_machines_are_listed_with_their_commits(modules, planted, grid_of):
    sweeps = {
        name: planted(name, {name: 0.0}, environment={"commit": commit})
        for name, commit in (("symmetric", "bbbbbbb"), ("near-far", "aaaaaaa"))
    }
    grid = grid_of(list(sweeps))
    results = modules.runs.read_results(sweeps, {"x": grid})
    text = modules.page.page(modules.data.read_claims(), results, modules.data.read_tables())
    assert "Machines: A Processor, crossgrad 0.2.0 (commits: aaaaaaa, bbbbbbb). " in text


@pytest.mark.slow
def test_the_same_results_give_the_same_page(modules, planted, grid_of):
    sweep = planted("again", {"symmetric": 0.0, "near-far": 0.0})
    pages = []
    for _ in range(2):
        found = modules.runs.read_results({"x": sweep}, {"x": grid_of(["symmetric", "near-far"])})
        pages.append(
            modules.page.page(modules.data.read_claims(), found, modules.data.read_tables())
        )
    assert pages[0] == pages[1]


def test_claims_with_contradictory_or_missing_data_are_refused(modules):
    data = modules.data
    pairing = {"first": "a", "second": "b"}
    for wrong in (
        {}, {"test": pairing}, {"test": pairing, "expected": "better", "none": "why"},
        {"probe": {"arm": "a", "first": {"column": "rho", "block": "all"}}},
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"must have|needs"):
            data.Check.model_validate(wrong)
    assert set(OUTCOMES) == {each.value for each in modules.verdicts.Outcome}
