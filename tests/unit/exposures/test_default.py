"""Which exposure a run has that names none."""

import pytest
from support.grey_scene import grey_scene
from support.same_bits import bits
from support.scenes import write_tiny_scene

from crossgrad_core.commands import configured
from crossgrad_core.run import app
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.migration import migrated
from crossgrad_core.run.results.config_file import read_config

DIFFERENT, EQUAL = [0.1, 0.2, 0.4, 0.2], [0.2, 0.2, 0.2, 0.2]


def taken(lights, **given):
    """The exposure of a run on photos of these brightnesses, and what its notes say of it."""
    run = assemble(configured({"scene": "x", "steps": 100, **given}), grey_scene(lights), "colmap")
    return run.selection.names["exposure"], [note for note in run.notes if "exposure" in note]


@pytest.mark.parametrize(("lights", "name"), [(DIFFERENT, "gain"), (EQUAL, "none")])
def test_a_run_decides_by_the_photos_and_says_why(lights, name):
    found, notes = taken(lights)
    assert found == name
    assert any(note.startswith(f"exposure auto: {name}") for note in notes)


@pytest.mark.parametrize("given", [{"exposure": {"name": "none"}}, {"preset": "inria"}], ids=str)
def test_what_is_named_and_published_rules_have_no_gains(given):
    assert taken(DIFFERENT, **given)[0] == "none"


def test_published_rules_have_the_exposure_that_is_named():
    assert taken(DIFFERENT, preset="inria", exposure={"name": "auto"})[0] == "gain"


def test_runs_of_earlier_versions_go_on_without_gains(tmp_path):
    old = {"revisions": [], "steps": 100}
    assert migrated(old, tmp_path)["exposure"] == {"name": "none"}
    kept = {**old, "exposure": {"name": "gain"}}
    assert migrated(kept, tmp_path)["exposure"] == {"name": "gain"}


def test_photos_of_one_exposure_train_to_the_bits_of_none(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene", views=6)
    found = []
    for name, given in (("usual", {}), ("none", {"exposure": {"name": "none"}})):
        out = tmp_path / name
        settings = {"scene": str(scene), "steps": 6, "threads": 1, "out": str(out), **given}
        assert app.run(settings, verbosity=-1) == 0
        assert read_config(out)["exposure"] == {"name": "none"}
        found.append(bits(out))
    assert found[0] == found[1]
