"""What figures are drawn with: letters of a small font, legends that a page has room for."""

import tempfile
import warnings

import matplotlib
import pytest
from matplotlib.font_manager import fontManager

from crossgrad_plugins.compare.figures.fonts import FULL, SMALL, family
from crossgrad_plugins.compare.figures.style import (
    PAGE,
    drawn,
    legend,
    looks,
    new_figure,
    panel_title,
    styled,
)


def text_of(figure, word):
    return next(text for text in figure.texts if text.get_text() == word)


def test_signs_that_the_small_font_lacks_come_from_the_full_one():
    with styled(), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        figure = new_figure(3.0, 1.0)
        figure.text(0.1, 0.1, "Zażółć ±3 dB")
        figure.text(0.1, 0.5, "Ωμέγα")
        made = drawn(figure, "name", "title", "caption")
    assert not [warning for warning in caught if "Glyph" in str(warning.message)]
    assert text_of(figure, "Zażółć ±3 dB").get_fontfamily() == [SMALL]
    assert text_of(figure, "Ωμέγα").get_fontfamily() == [SMALL, FULL]
    assert "Ωμέγα" in made.svg


@pytest.fixture
def cached(tmp_path, monkeypatch):
    """The folder that a process which has no font yet finds them in."""
    monkeypatch.setattr(matplotlib, "get_cachedir", lambda: str(tmp_path))
    monkeypatch.setattr(fontManager, "ttflist", list(fontManager.ttflist))
    family.cache_clear()
    yield tmp_path
    family.cache_clear()


def test_the_small_font_is_made_once_and_nothing_else_is_left(cached, monkeypatch):
    elsewhere = cached / "temporary"
    elsewhere.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))
    assert family() == SMALL
    made = {path: path.stat().st_mtime_ns for path in cached.glob("*.ttf")}
    family.cache_clear()
    assert family() == SMALL
    assert {path: path.stat().st_mtime_ns for path in cached.iterdir()} == {
        **made,
        elsewhere: elsewhere.stat().st_mtime_ns,
    }
    assert len(made) == 2
    assert not list(elsewhere.iterdir())


def test_where_it_cannot_be_kept_figures_are_drawn_in_the_full_font(cached, monkeypatch):
    monkeypatch.setattr(matplotlib, "get_cachedir", lambda: str(cached / "missing"))
    assert family() == FULL


@pytest.mark.parametrize("weight", ["normal", "bold"])
def test_a_file_that_is_no_font_is_not_drawn_with(cached, weight):
    family()
    for path in cached.glob(f"*{weight}.ttf"):
        path.write_bytes(b"no font")
    family.cache_clear()
    assert family() == FULL


@pytest.mark.parametrize("share", [1.0, 0.62])
@pytest.mark.parametrize("letters", ["ochota_kap_hybrid, gain ", "W"])
@pytest.mark.parametrize("length", [1, 8, 20, 45, 200])
def test_a_legend_fits_its_figure_whatever_its_labels(length, letters, share):
    labels = [f"{number} {letters * 200}"[:length] for number in range(9)]
    with styled(), warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = new_figure(PAGE * share, 2.0)
        ax = figure.subplots()
        for label in labels:
            ax.plot([0], [0], label=label)
        legend(figure, ax, labels)
        drawn(figure, "name", "title", "caption")
        (box,) = (each.get_window_extent() for each in figure.legends)
        texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert box.x0 >= 0.0 and box.x1 <= figure.bbox.width + 1.0
    assert box.y1 <= figure.bbox.height + 1.0
    assert [text.replace("\n", "") for text in texts] == labels


@pytest.mark.parametrize("beside", [1, 2, 3, 4])
@pytest.mark.parametrize(
    "scene", ["city", "ochota_kap_hybrid_gain", "a b c" * 30, "x" * 90, "_", "$y_$", "城" * 5]
)
def test_a_title_fits_its_panel_and_keeps_every_letter(beside, scene):
    with styled():
        figure = new_figure(PAGE, 2.0)
        ax = figure.subplots(1, beside, squeeze=False)[0, 0]
        panel_title(ax, scene)
        figure.get_layout_engine().execute(figure)
        title = ax.get_title(loc="left")
    assert title.replace("\n", "").strip("'") == scene.strip("'")
    assert all(len(line) <= 110 // beside - 8 + 1 for line in title.split("\n"))


@pytest.mark.parametrize("arms", [1, 7, 14, 28])
def test_arms_look_different(arms):
    found = list(looks([f"arm {index}" for index in range(arms)]).values())
    assert len({(look.color, str(look.dash)) for look in found}) == arms
    assert len({(look.color, look.marker) for look in found}) == arms


@pytest.mark.parametrize("arms", [2, 8, 14, 28])
def test_a_legend_of_many_arms_leaves_the_panels_their_room(arms):
    names = [f"two views, equal views, statistics of one view, {index}" for index in range(arms)]
    with styled(), warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = new_figure(PAGE, 2.4)
        ax = figure.subplots()
        for name in names:
            ax.plot([0, 1], [0, 1], label=name)
        legend(figure, ax, names)
        drawn(figure, "name", "title", "caption")
        below = ax.get_tightbbox().y1
        (box,) = (each.get_window_extent() for each in figure.legends)
    assert box.y0 >= below
    assert box.y1 <= figure.bbox.height + 1.0
    assert ax.bbox.height > 1.0 * figure.dpi
