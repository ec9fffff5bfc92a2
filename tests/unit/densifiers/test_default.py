"""The densifier of a run that names none."""

import pytest

from crossgrad_core.commands import configured
from crossgrad_core.config import RunConfig
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.registry.entries import load
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.decisions import table_of
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_plugins.recipes import auto as chosen

USUAL = {
    "a short run": ({}, "absgrad"),
    "views": ({"steps": None, "max_views": 2000}, "absgrad"),
    "seconds": ({"steps": None, "seconds": 60}, "absgrad"),
    "as long as published": ({"steps": 30_000}, "adc"),
    "no length": ({"steps": None}, "adc"),
    "the recipe": ({"recipe": {"name": "published"}}, "adc"),
    "absolute": ({"schedule": "absolute"}, "adc"),
    "of another length": ({"schedule": "absolute", "schedule_length": 2000}, "absgrad"),
    "counted in steps": ({"schedule_unit": "steps"}, "adc"),
    "free growth": ({"growth": "unbounded"}, "adc"),
    "a bound": ({"max_gaussians": 500}, "adc"),
    "a bound and a curve to it": ({"max_gaussians": 500, "growth": "budget"}, "absgrad"),
    "anchors": ({"backbone": {"name": "scaffold"}}, "anchor"),
    "a densifier of its own": ({"backbone": {"name": "pixel"}}, "pixel"),
    "a filter": ({"backbone": {"name": "mip"}}, "adc"),
    "means over pixels": ({"backbone": {"name": "analytic"}}, "adc"),
    "named": ({"densifier": {"name": "mcmc"}}, "mcmc"),
    "left open": ({"densifier": {"name": "auto"}}, "absgrad"),
    "options alone": ({"densifier": {"name": "auto", "abs_threshold": 1e-4}}, "absgrad"),
    "fewer steps than published, but not views": ({"steps": 20_000, "views_per_step": 2}, "adc"),
    "as many views in fewer steps": (
        {"steps": None, "max_views": 40_000, "views_per_step": 2},
        "adc",
    ),
    "of a length without a budget": (
        {"schedule": "absolute", "schedule_length": 40_000},
        "adc",
    ),
    "the processor by number": ({"device": "cpu:0"}, "absgrad"),
    "a rasterizer that says where pixels pull": ({"rasterizer": {"name": "torch"}}, "absgrad"),
}


@pytest.fixture(autouse=True)
def few_are_many(monkeypatch):
    """Scenes of tests have a few photos."""
    monkeypatch.setattr(chosen, "MANY_PHOTOS", 2)


@pytest.mark.parametrize("case", USUAL)
def test_absgrad_is_the_default_in_short_runs_of_plain_gaussians(case):
    settings, expected = USUAL[case]
    given = {"steps": 2000, "plan": "off", **settings}
    setup = assemble(RunConfig.model_validate(given), sample_scene(), "none")
    assert setup.selection.names["densifier"] == expected
    told = [row for row in setup.decisions if row.setting == "densifier" and row.override]
    assert len(told) == (expected == "absgrad")


def test_a_scene_with_few_photos_uses_the_published_densifier(monkeypatch):
    monkeypatch.undo()
    assert chosen.MANY_PHOTOS == 100
    scene = sample_scene()
    for photos, expected in ((0, "absgrad"), (1, "adc")):
        monkeypatch.setattr(chosen, "MANY_PHOTOS", len(scene.train_views) + photos)
        setup = assemble(RunConfig(steps=2000), scene, "none")
        assert setup.selection.names["densifier"] == expected


def default_of(**settings):
    return table_of(configured(settings), sample_scene())["densifier"].value


@pytest.mark.parametrize("name", ["auto", "numba"])
def test_without_absolute_gradients_the_default_densifier_is_adc(name, monkeypatch):
    given = {"steps": 2000, "rasterizer": {"name": name}}
    assert default_of(**given) == "absgrad"
    numba = load(Rasterizer, "numba")
    monkeypatch.setattr(numba, "provides", numba.provides - {"abs_gradient"})
    assert default_of(**given) == "adc"
    setup = assemble(RunConfig.model_validate(given), sample_scene(), "none")
    assert (setup.selection.names["rasterizer"], setup.selection.names["densifier"]) == (
        "numba",
        "adc",
    )


def test_the_default_densifier_on_cuda_is_adc():
    assert default_of(steps=2000, device="cuda") == "adc"
