"""The default exposure of a run."""

import pytest
from support.grey_scene import grey_scene

from crossgrad_core.commands import configured
from crossgrad_core.run.assemble import assemble

DIFFERENT, EQUAL = [0.1, 0.2, 0.4, 0.2], [0.2, 0.2, 0.2, 0.2]


def taken(lights, **given):
    """The exposure of a run on photos of these brightnesses, and what its notes say of it."""
    asked = configured({"scene": "x", "steps": 100, "plan": "off", **given})
    run = assemble(asked, grey_scene(lights), "colmap")
    return run.selection.names["exposure"], [note for note in run.notes if "exposure" in note]


@pytest.mark.parametrize(("lights", "name"), [(DIFFERENT, "gain"), (EQUAL, "none")])
def test_exposure_auto_decides_by_the_photos_and_reports_the_reason(lights, name):
    found, notes = taken(lights)
    assert found == name
    assert any(note.startswith(f"exposure auto: {name}") for note in notes)


@pytest.mark.parametrize(
    "given", [{"exposure": {"name": "none"}}, {"recipe": {"name": "published"}}], ids=str
)
def test_no_gain_is_chosen_for_a_named_exposure_or_the_published_recipe(given):
    assert taken(DIFFERENT, **given)[0] == "none"


def test_exposure_auto_can_be_requested_with_the_published_recipe():
    assert taken(DIFFERENT, recipe={"name": "published"}, exposure={"name": "auto"})[0] == "gain"
