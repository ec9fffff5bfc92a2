"""What came from elsewhere has names of its own in a run's folder."""

from crossgrad_core.run.results.sources import FILE, name_for


def test_scenes_with_the_same_name_get_permanent_numbers(tmp_path):
    places = [tmp_path / where / "scene" for where in "abc"]
    names = [name_for(tmp_path, "scene", place) for place in (*places, *places)]
    assert names == ["scene", "scene-2", "scene-3"] * 2


def test_the_reserved_name_zoom_is_not_given_to_a_file(tmp_path):
    assert name_for(tmp_path, "zoom", tmp_path / "zoom.json") == "zoom-2"


def test_a_damaged_list_of_sources_is_created_again(tmp_path):
    for content in ("[1]", '{"scene": 3}', "{"):
        (tmp_path / FILE).write_text(content)
        assert name_for(tmp_path, "scene", tmp_path / "scene") == "scene"
