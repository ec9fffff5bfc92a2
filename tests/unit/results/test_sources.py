"""What came from elsewhere has names of its own in a run's folder."""

from crossgrad_core.run.results.sources import FILE, name_for


def test_scenes_of_one_name_get_numbers_and_keep_them(tmp_path):
    places = [tmp_path / where / "scene" for where in "abc"]
    names = [name_for(tmp_path, "scene", place) for place in (*places, *places)]
    assert names == ["scene", "scene-2", "scene-3"] * 2


def test_the_name_of_the_path_that_comes_from_no_file_is_taken(tmp_path):
    assert name_for(tmp_path, "zoom", tmp_path / "zoom.json") == "zoom-2"


def test_a_damaged_list_is_begun_again(tmp_path):
    for content in ("[1]", '{"scene": 3}', "{"):
        (tmp_path / FILE).write_text(content)
        assert name_for(tmp_path, "scene", tmp_path / "scene") == "scene"
