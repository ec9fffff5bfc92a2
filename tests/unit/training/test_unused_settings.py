"""What the user sets and what would do nothing is refused, with the reason; defaults never are."""

from pathlib import Path

import pytest
from support.scenes import write_tiny_scene

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.objections import set_for_nothing
from crossgrad_core.errors import IncompatibleSelectionError, UserError
from crossgrad_core.recipe.table import open_again
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.run.app import run
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.export import export_scene
from crossgrad_core.run.load_run import set_up
from crossgrad_core.run.resolve import resolved
from crossgrad_core.run.unused_settings import refuse_settings_for_nothing
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.start import first_state

#: SH bands above the first learn in one of two steps.
SECOND = {"sparse-sh": {"every": 2}}
IDLE = [
    (
        {"operator": {"name": "chain", "links": ["mean"], "granularity": "kind"}},
        "operator.granularity",
    ),
    ({"operator": {"name": "cagrad", "c": 0, "granularity": "kind"}}, "operator.granularity"),
    ({"operator": {"name": "cagrad", "c": 0, "rescale": "1+c"}}, "operator.rescale"),
    ({"operator": {"name": "soft", "strength": 0, "threshold": 0.5}}, "operator.threshold"),
    ({"operator": {"name": "confgate", "tau": 0.8, "variant": "low"}}, "operator.variant"),
    (
        {
            "operator": {"name": "gradnorm", "alpha": 0, "decay": 0.5},
            "sampler": {"name": "near-far"},
        },
        "operator.decay",
    ),
    (
        {"operator": {"name": "dispatch", "rules": {"means": "sum"}, "granularity": "kind"}},
        "operator.rules",
    ),
    ({"operator": {"name": "dispatch", "neutral": "geometry"}}, "operator.neutral"),
    (
        {"operator": {"name": "dispatch", "rules": {"opacities": "sum"}, "opacity": "geometry"}},
        "operator.opacity",
    ),
    (
        {
            "operator": {
                "name": "dispatch",
                "rules": {"geometry": "symmetric", "appearance": "sum"},
                "variant": "geometry-projection",
            }
        },
        "operator.variant",
    ),
    (
        {"operator": [{"name": "soft", "strength": 0, "threshold": 0.5}, {"name": "mean"}]},
        "operator.soft.threshold",
    ),
    (
        {
            "operator": {
                "name": "chain",
                "links": [{"name": "soft", "strength": 0, "threshold": 0.5}, "symmetric"],
            }
        },
        "operator.links",
    ),
    ({"sampler": {"name": "near-far", "order": "distinct"}}, "sampler.order"),
    ({"sampler": {"name": "random-split", "order": "distinct"}}, "sampler.order"),
    ({"sampler": {"name": "three-way", "order": "distinct"}}, "sampler.order"),
    ({"sampler": {"name": "random", "distinct": True}, "views": 1}, "sampler.distinct"),
    ({"sampler": {"name": "horizon", "coarse_share": 0, "coarse": [3, 1]}}, "sampler.coarse"),
    ({"sampler": {"name": "horizon", "coarse_share": 1, "fine": [3, 1]}}, "sampler.fine"),
    ({"grouping": {"name": "radial"}}, "grouping"),
    ({"grouping": {"name": "radial"}, "sampler": {"name": "random-split"}}, "grouping"),
    ({"densifier": {"name": "none"}, "densify_every": 10}, "densify_every"),
    ({"densifier": {"name": "none"}, "max_gaussians": "auto"}, "max_gaussians"),
    ({"densifier": {"name": "none"}, "growth": "budget"}, "growth"),
    ({"densifier": {"name": "none"}, "reset_every": 10}, "reset_every"),
    ({"densifier": {"name": "mcmc"}, "reset_every": 10}, "reset_every"),
    ({"densifier": {"name": "adc", "prune_scale": 0.3}}, "densifier.prune_scale"),
    ({"densifier": {"name": "dc4gs", "reset_opacity": 0.3}}, "densifier.reset_opacity"),
    ({"backbone": {"name": "scaffold"}, "rules": SECOND}, "rules.sparse-sh"),
    ({"backbone": {"name": "vanilla", "sh_degree": 0}, "rules": SECOND}, "rules.sparse-sh"),
    (
        {"densifier": {"name": "absgrad", "criterion": "gsplat", "abs_threshold": 1e-3}},
        "densifier.abs_threshold",
    ),
    (
        {
            "backbone": {"name": "scaffold"},
            "densifier": {"name": "anchor", "levels": 1, "refinement": 2},
        },
        "densifier.refinement",
    ),
    ({"backbone": {"name": "vanilla", "sh_degree": 0, "lr_f_rest": 0.1}}, "backbone.lr_f_rest"),
    ({"backbone": {"name": "scaffold", "lr_bank": 0.1}}, "backbone.lr_bank"),
    ({"backbone": {"name": "scaffold", "lr_appearance": 0.1}}, "backbone.lr_appearance"),
    (
        {"backbone": {"name": "octree", "progressive": False, "init_level": 1}},
        "backbone.init_level",
    ),
    (
        {"backbone": {"name": "octree", "base_layer": 5, "middle_cell": 0.1}},
        "backbone.middle_cell",
    ),
    (
        {
            "backbone": {
                "name": "distance",
                "condition_scales": False,
                "condition_opacities": False,
                "condition_colors": False,
                "l2_weight": 0.5,
            }
        },
        "backbone.l2_weight",
    ),
    (
        {"backbone": {"name": "mip"}, "rasterizer": {"name": "torch", "dilation": 0.1}},
        "rasterizer.dilation",
    ),
    ({"data": {"split": "none", "test_every": 4}}, "data.test_every"),
    ({"clock": "cpu"}, "clock"),
    ({"stop_after": 11}, "stop_after"),
    ({"min_refinements": 6, "schedule_unit": "steps"}, "min_refinements"),
    ({"min_refinements": 6, "densify_until": 600}, "min_refinements"),
    ({"min_refinements": 6, "densify_from": 0, "densify_every": 9}, "min_refinements"),
    ({"min_refinements": 6, "schedule": "absolute", "schedule_unit": "views"}, "min_refinements"),
    (
        {
            "backbone": {
                "name": "scaffold",
                **dict.fromkeys(("lr_features_final", "lr_scales_final", "lr_cov_final"), 1e-5),
            },
            "rules": {"lr-tail": {}},
        },
        "rules.lr-tail",
    ),
]
#: The same settings where they do something.
AT_WORK = [
    {"operator": {"name": "symmetric", "granularity": "gaussian"}},
    {"operator": {"name": "chain", "links": ["mean", "nash"], "granularity": "kind"}},
    {"operator": {"name": "dispatch", "rules": {"geometry": "nash"}, "granularity": "kind"}},
    {"sampler": {"name": "near-far", "order": "distinct"}, "views": 4},
    {"sampler": {"name": "near-far", "order": "epoch"}},
    {"grouping": {"name": "gmm"}, "sampler": {"name": "near-far"}},
    {"grouping": {"name": "gmm"}, "operator": {"name": "gradnorm"}},
    {"grouping": {"name": "gmm"}, "observers": [{"name": "diagnostics"}]},
    {"densifier": {"name": "adc"}, "densify_every": 10, "reset_every": 10, "max_gaussians": 10},
    {"densifier": {"name": "none"}, "max_gaussians": 10},
    {"densifier": {"name": "adc", "prune_scale": 0.3}, "reset_every": 10},
    {"backbone": {"name": "vanilla", "sh_degree": 1}, "rules": SECOND},
    {"backbone": {"name": "scaffold"}, "rules": {"sparse-sh": False}},
    {"max_gaussians": "auto", "growth": "budget"},
    {"densifier": {"name": "adc"}, "growth": "budget"},
    {"rasterizer": {"name": "torch", "dilation": 0.1}},
    {"min_refinements": 6},
    {"min_refinements": 6, "schedule": "absolute", "schedule_length": 600},
    {"seconds": 9.0, "clock": "cpu"},
    {"stop_after": 10},
    {"steps": None, "seconds": 9.0, "stop_after": 40_000},
    {"rules": {"lr-tail": {"share": 0.5, "factor": 0.5}}},
    {"rules": {"lr-tail": {"factor": 0.5}}, "recipe": {"name": "published"}},
    {"backbone": {"name": "scaffold"}, "rules": {"lr-tail": {"share": 0.5}}},
    # A value that is the default is never refused.
    {"operator": {"name": "chain", "links": ["mean"], "granularity": "block"}},
    {"backbone": {"name": "scaffold", "lr_bank": 0.01}},
]


def refusal(settings):
    config = RunConfig.model_validate({"steps": 10, "data": {"init": "random"}, **settings})
    setup = assemble(config, sample_scene(), "none")
    refuse_settings_for_nothing(config, setup)
    return setup


@pytest.mark.parametrize(("settings", "name"), IDLE, ids=lambda value: str(value)[:60])
def test_a_setting_without_an_effect_is_refused_with_the_reason(settings, name):
    with pytest.raises(UserError) as caught:
        refusal(settings)
    assert caught.value.where == name
    assert caught.value.found.startswith(f"{name}: ")
    assert "leave" in f"{caught.value.found} {caught.value.todo}"


@pytest.mark.parametrize("settings", AT_WORK, ids=lambda value: str(value)[:60])
def test_settings_with_an_effect_are_accepted(settings):
    setup = refusal({"plan": "off", **settings})
    # What a run wrote down repeats it.
    config = resolved(setup)
    setup = assemble(config, sample_scene(), "none")
    refuse_settings_for_nothing(open_again(config), setup)
    assert resolved(setup).model_dump(exclude={"reader"}) == config.model_dump(exclude={"reader"})


def test_max_gaussians_does_not_limit_a_ply_start(tmp_path):
    setup = assemble(RunConfig(steps=4), sample_scene(), "none")
    export_scene(setup, first_state(setup), tmp_path / "start.ply")
    settings = {"data": {"init": str(tmp_path / "start.ply")}, "max_gaussians": 10}
    refusal(settings)
    with pytest.raises(UserError) as caught:
        refusal({**settings, "densifier": {"name": "none"}})
    assert caught.value.where == "max_gaussians"
    assert "the Gaussians of a PLY file are used unchanged" in caught.value.found


@pytest.mark.parametrize("slot", ["backbones", "samplers", "operators", "rasterizers"])
def test_defaults_are_never_refused_as_unused(slot):
    selection = assemble(RunConfig(steps=10), sample_scene(), "none").selection
    for name in entries(slot):
        assert not set_for_nothing(build(slot, name, {}), selection)


def test_split_lists_make_test_every_unused(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    names = sorted(path.name for path in (scene / "images").iterdir())
    (scene / "test_list.txt").write_text(names[0])
    settings = {"scene": str(scene), "steps": 10, "out": str(tmp_path / "run")}
    with pytest.raises(UserError, match=r"test_list\.txt determine"):
        run({**settings, "data": {"test_every": 4}}, dry_run=True)
    assert run({**settings, "data": {"test_every": 4, "split": "every"}}, dry_run=True) == 0


LABELS = [
    ({"operator": {"name": "anchors"}, "sampler": {"name": "near-far"}}, "near (operator.near)"),
    ({"operator": {"name": "anchors"}, "sampler": {"name": "random"}}, "makes aerial, street"),
    (
        {
            "operator": {"name": "dispatch", "rules": {"geometry": "anchors"}},
            "sampler": {"name": "near-far"},
        },
        "operator anchors needs views",
    ),
    ({"sampler": {"name": "three-way"}}, "3 groups"),
    ({"sampler": {"name": "anchors-30"}}, "near and far"),
]


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> Path:
    return write_tiny_scene(tmp_path_factory.mktemp("scene"), folders=("street", "aerial"))


@pytest.mark.parametrize(("settings", "reason"), LABELS, ids=lambda value: str(value)[:60])
def test_labels_that_no_view_has_are_refused_before_compilation(
    settings, reason, folders, tmp_path
):
    given = {
        "scene": str(folders),
        "steps": 10,
        "out": str(tmp_path / "run"),
        "grouping": {"name": "lists"},
    }
    with pytest.raises(IncompatibleSelectionError) as caught:
        run({**given, **settings}, dry_run=True)
    assert reason in caught.value.found


def test_labels_of_lists_can_be_selected(folders, tmp_path):
    operator = {"name": "anchors", "near": "street", "far": "aerial"}
    settings = {"sampler": {"name": "near-far"}, "grouping": {"name": "lists"}}
    given = {"scene": str(folders), "steps": 10, "out": str(tmp_path / "run")}
    assert run({**given, **settings, "operator": operator}, dry_run=True) == 0


def test_a_resumed_run_with_unused_settings_is_accepted(folders):
    """Runs of earlier versions continue with their settings."""
    config = RunConfig.model_validate(
        {
            "scene": str(folders),
            "steps": 10,
            "operator": {"name": "cagrad", "c": 0, "rescale": "1+c"},
        }
    )
    set_up(config, -1)


@pytest.mark.parametrize("name", ["sum", "mean", "graddrop", "preconditioner"])
def test_operators_without_gramians_have_no_option_granularity(name):
    with pytest.raises(UserError, match="has no option 'granularity'"):
        build("operators", name, {"granularity": "gaussian"})
