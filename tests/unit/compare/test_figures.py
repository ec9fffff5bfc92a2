"""Legends and titles fit into figures; arms look different."""

import warnings

import pytest

from crossgrad_plugins.compare.figures.style import (
    PAGE,
    drawn,
    legend,
    looks,
    new_figure,
    panel_title,
    styled,
)

WORDS, WIDE = "ochota_kap_hybrid, gain ", "W"


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("length", "letters", "share"),
    [
        (1, WORDS, 1.0),
        (1, WIDE, 0.62),
        (8, WORDS, 0.62),
        (20, WIDE, 1.0),
        (45, WORDS, 1.0),
        (45, WIDE, 0.62),
        (200, WORDS, 0.62),
        (200, WIDE, 1.0),
    ],
)
def test_a_legend_fits_its_figure_for_labels_of_any_length(length, letters, share):
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


@pytest.mark.sampled(7)
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
def test_each_arm_has_its_own_color_dash_and_marker(arms):
    found = list(looks([f"arm {index}" for index in range(arms)]).values())
    assert len({(look.color, str(look.dash)) for look in found}) == arms
    assert len({(look.color, look.marker) for look in found}) == arms


@pytest.mark.sampled(1)
@pytest.mark.parametrize("arms", [2, 8, 14, 28])
def test_a_legend_of_many_arms_does_not_shrink_the_panels(arms):
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
