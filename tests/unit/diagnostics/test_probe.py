"""Probes: right dot products in both metrics, nothing changed, views and rows chosen well."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from crossgrad_core.commands import write_table
from crossgrad_core.contract.blocks import AdamRule, AdamState
from crossgrad_core.contract.contexts import Model
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build
from crossgrad_core.testing.fixtures import sample_phase, sample_scene
from crossgrad_core.training.adam.adam import adam_step
from crossgrad_plugins.diagnostics import probe
from crossgrad_plugins.diagnostics.plan import labelled, plan_probe
from crossgrad_plugins.diagnostics.probe import ModelProbe, measure
from crossgrad_plugins.diagnostics.report import read_probes
from crossgrad_plugins.diagnostics.table import ALL, table
from crossgrad_plugins.diagnostics.watch import Watch, camera_rows, distances_of, grouping_rows
from crossgrad_plugins.losses.l1_ssim import photometric_loss

VIEWS = (0, 2, 5, 8)


@pytest.fixture
def model():
    scene, backbone = sample_scene(), build("backbones", "vanilla", {})
    parameters = backbone.create(scene, np.random.default_rng(0))
    parameters = {name: tensor.requires_grad_() for name, tensor in parameters.items()}
    adam = AdamState()
    rng = torch.Generator().manual_seed(0)
    for _ in range(3):
        grads = {n: torch.randn(t.shape, generator=rng) * 1e-3 for n, t in parameters.items()}
        adam_step(parameters, grads, adam, dict.fromkeys(parameters, 1e-3))
    return Model(
        phase=sample_phase(),
        scene=scene,
        backbone=backbone,
        rasterizer=build("rasterizers", "torch", {}),
        parameters=parameters,
        adam=adam,
        background=torch.zeros(3),
        loss=build("losses", "l1-ssim", {}),
        groups=None,
    )


def gradients(model, view):
    """By way of backward passes and `.grad`, unlike the probe."""
    one = model.scene.train_views[view]
    leaves = {n: t.detach().clone().requires_grad_() for n, t in model.parameters.items()}
    gaussians = model.backbone.decode(leaves, one.camera, model.phase)
    image = model.rasterizer.render(gaussians, one.camera, model.background).image
    photometric_loss(image, one.photo.image(), None, 0.2).backward()
    return {name: tensor.grad for name, tensor in leaves.items()}


def test_gramians_contain_the_dot_products_of_the_gradients_of_each_view(model):
    found = measure(model, VIEWS, np.random.default_rng(0))
    each = [gradients(model, view) for view in VIEWS]
    assert found.views == VIEWS
    assert found.share == 1.0
    for place, name in enumerate(found.blocks):
        rows = np.stack([g[name].double().numpy().ravel() for g in each])
        expected = rows @ rows.T
        np.testing.assert_allclose(found.plain[place], expected, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("rule", [AdamRule(), AdamRule((0.9, 0.98)), AdamRule.for_views(4, 0.7)])
def test_adams_metric_divides_by_the_root_that_the_next_step_would_use(model, rule):
    model, beta2 = replace(model, rule=rule), rule.betas[1]
    found = measure(model, VIEWS, np.random.default_rng(0))
    each = [gradients(model, view) for view in VIEWS]
    for place, name in enumerate(found.blocks):
        rows = np.stack([g[name].double().numpy().ravel() for g in each])
        before = model.adam.exp_avg_sq[name].double().numpy().ravel()
        second = beta2 * before + (1 - beta2) * (rows**2).mean(axis=0)
        rows = rows / (np.sqrt(second / (1 - beta2 ** (4 * rule.age))) + rule.eps)
        np.testing.assert_allclose(found.adam[place], rows @ rows.T, rtol=1e-3, atol=1e-8)


def test_the_adam_metric_is_missing_before_the_first_step(model):
    model.adam.exp_avg_sq.clear()
    assert measure(model, VIEWS, np.random.default_rng(0)).adam is None


def test_a_gradient_probe_does_not_change_the_model(model):
    before = {name: tensor.detach().clone() for name, tensor in model.parameters.items()}
    moments = {name: tensor.clone() for name, tensor in model.adam.exp_avg_sq.items()}
    measure(model, VIEWS, np.random.default_rng(0))
    assert all(torch.equal(model.parameters[name], before[name]) for name in before)
    assert all(torch.equal(model.adam.exp_avg_sq[name], moments[name]) for name in moments)
    assert all(tensor.grad is None for tensor in model.parameters.values())


def made_up(monkeypatch, model, change=lambda view, gradients: gradients):
    """Replaces the gradients by random ones that are the same each time."""

    def gradient(_, view, names):
        index = model.scene.train_views.index(view)
        rng = torch.Generator().manual_seed(index)
        made = {n: torch.randn(model.parameters[n].shape, generator=rng) + 0.5 for n in names}
        return change(index, made)

    monkeypatch.setattr(probe, "view_gradients", gradient)


def test_a_random_subset_of_primitives_is_unbiased(model, monkeypatch):
    made_up(monkeypatch, model)
    whole = measure(model, VIEWS, np.random.default_rng(0))
    row = sum(model.parameters[n][:1].nbytes for n in model.parameters)
    monkeypatch.setattr(probe, "MEMORY", 10 * row * len(VIEWS))
    rng = np.random.default_rng(1)
    parts = [measure(model, VIEWS, rng) for _ in range(60)]
    assert {part.share for part in parts} == {10 / 40}
    for metric in ("plain", "adam"):
        mean = np.mean([getattr(part, metric) for part in parts], axis=0)
        full = getattr(whole, metric)
        scale = np.sqrt(np.einsum("bi,bj->bij", *[np.einsum("bii->bi", full)] * 2))
        assert np.abs(mean - full).max() < 0.15 * scale.max()
        np.testing.assert_allclose(mean / scale, full / scale, atol=0.15)


def test_a_view_with_a_non_finite_gradient_is_left_out(model, monkeypatch):
    def spoil(view, made):
        if view == 2:
            made["scales"][0, 0] = float("nan")
        return made

    made_up(monkeypatch, model, spoil)
    found = measure(model, VIEWS, np.random.default_rng(0))
    assert found.views == (0, 5, 8)
    assert found.dropped == (sample_scene().train_views[2].name,)
    assert found.plain.shape[1:] == (3, 3)
    full = ModelProbe(model, np.random.default_rng(0)).gramians(VIEWS)
    assert (full[:, 1] == 0.0).all()
    assert (full[:, 0, 0] > 0.0).all()


def test_a_view_without_a_gradient_has_zero_dot_products(model, monkeypatch):
    made_up(monkeypatch, model, lambda view, made: {} if view == 5 else made)
    found = measure(model, VIEWS, np.random.default_rng(0))
    assert (found.plain[:, 2] == 0.0).all()
    assert not found.overlap[:, 2].any()


def plan(per_group=12, seed=0, grouping="radial"):
    labels, _ = labelled(sample_scene(), grouping, seed)
    return plan_probe(sample_scene(), grouping, labels, per_group, seed)


def test_the_plan_of_a_gradient_probe_samples_equally_many_near_and_far_views():
    found = plan(3)
    assert len(found.views) == 6
    assert found.near(found.views).sum() == 3
    assert found.views == plan(3).views
    assert len({plan(3, seed).views for seed in range(8)}) > 1


def test_the_plan_of_a_gradient_probe_distinguishes_near_from_far_for_any_labels():
    scene = sample_scene()
    labels = tuple("b" if view.regime == "near" else "a" for view in scene.train_views)
    found = plan_probe(scene, "lists", labels, 12, 0)
    assert (found.near_label, found.far_label) == ("b", "a")


@pytest.mark.parametrize(
    "labels", [("all",) * 9, ("near",) * 8 + ("far",)], ids=["one group", "one view"]
)
def test_the_plan_of_a_gradient_probe_needs_two_groups_of_two_views(labels):
    with pytest.raises(UserError, match="two"):
        plan_probe(sample_scene(), "lists", labels, 12, 0)


def test_the_table_of_a_gradient_probe_has_a_row_per_metric_and_block(model):
    measurement = measure(model, plan().views, np.random.default_rng(0))
    rows = table(measurement, plan(), distances_of(model.scene), 0)
    blocks = [*measurement.blocks, "opacities+f_dc", ALL]
    assert [row["block"] for row in rows] == 2 * blocks
    assert [row["metric"] for row in rows] == ["plain"] * len(blocks) + ["adam"] * len(blocks)
    whole = rows[len(blocks) - 1]
    assert whole["sigma_w2_low"] <= whole["sigma_w2"] <= whole["sigma_w2_high"]
    parts = sum(float(row["sigma_w2"]) for row in rows[: len(measurement.blocks)])
    assert whole["sigma_w2"] == pytest.approx(parts)


@pytest.mark.slow
def test_a_repeated_gradient_probe_gives_the_same_table(model):
    def rows():
        measurement = measure(model, plan().views, np.random.default_rng(0))
        return table(measurement, plan(), distances_of(model.scene), 0)

    assert str(rows()) == str(rows())


def test_one_gradient_probe_is_evaluated_for_every_grouping(model):
    measurement = measure(model, plan().views, np.random.default_rng(0))
    rows = grouping_rows(model.scene, measurement, 0)
    read = {row["grouping"] for row in rows if not row["note"]}
    assert {"regime", "radial", "altitude", "footprint"} <= read
    first = next(row for row in rows if row["grouping"] == "radial")
    own = table(measurement, plan(), distances_of(model.scene), 0)[0]
    assert first["block"] == own["block"]
    assert first["ratio_of_means"] == own["ratio_of_means"]
    assert first["rho"] == own["rho"]


def test_camera_quantities_are_reported_with_the_number_of_views():
    rows = camera_rows(sample_scene())
    assert [str(row["quantity"]).split(" ")[0] for row in rows] == ["height", "log", "log"]
    assert {row["views"] for row in rows} == {len(sample_scene().train)}
    distances = distances_of(sample_scene())["radial"]
    expected = distances.var() / distances.mean() ** 2
    assert rows[1]["relative_variance"] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("every", "total", "expected"),
    [(5, 20, [5, 10, 15, 20]), (5, 22, [5, 10, 15, 22]), (7, 20, [7, 20]), (30, 20, [20])],
)
def test_gradient_probes_are_evenly_spaced_and_the_last_is_at_the_end_of_the_run(
    every, total, expected
):
    watch = Watch(plan(), every, total, 0)
    assert [step for step in range(1, total + 1) if watch.due(step)] == expected


def test_a_report_is_refused_if_gradients_were_never_probed():
    with pytest.raises(UserError, match="never probed"):
        Watch(plan(), 5, 20, 0).report(sample_scene(), "nothing")


def test_tables_of_gradient_probes_are_read_back_as_written(tmp_path):
    rows = [{"step": 1, "b": 0.25, "c": "x"}, {"step": 2, "b": float("inf"), "d": "y"}]
    write_table(tmp_path / "t.csv", rows)
    found = read_probes(tmp_path / "t.csv")
    assert found[0] == {**rows[0], "d": pytest.approx(float("nan"), nan_ok=True)}
    assert found[1]["b"] == float("inf")
    assert read_probes(tmp_path / "none.csv") == []


@pytest.mark.parametrize("line", ["1,2,3", "1", "x,2", ",2", '1,"2', "\0"])
def test_a_damaged_table_of_gradient_probes_gives_one_error(line, tmp_path):
    (tmp_path / "t.csv").write_text(f"step,a\n{line}\n")
    with pytest.raises(UserError, match=r"table of probes cannot be read(?s:.*)to do"):
        read_probes(tmp_path / "t.csv")


def test_a_report_is_drawn_even_if_values_are_missing(model, monkeypatch, tmp_path):
    made_up(monkeypatch, model, lambda view, made: {"means": made["means"]} if view else {})
    watch = Watch(plan(2), 1, sample_phase().step, 0)
    watch.crossgrad_model_ready(model)
    report = watch.report(model.scene, "a model of which little is known")
    report.write(tmp_path)
    text = "\n".join(report.lines())
    assert (tmp_path / "diagnostics.png").stat().st_size > 0
    assert "means" in text
    assert "opacities " not in text
