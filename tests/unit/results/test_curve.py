"""curve.png: what is drawn, for one evaluation and for many."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from crossgrad_core.run.results.curve import draw_curve
from crossgrad_core.run.results.metrics_csv import Row


def make_rows(count: int, regimes: tuple[str, ...] = ("far", "near")) -> list[Row]:
    rows = []
    for i in range(1, count + 1):
        row: Row = {"step": i, "views": 200 * i, "train_seconds": 1.5 * i, "loss": 1 / i}
        for column in ("", *(f"_{regime}" for regime in regimes)):
            row[f"psnr{column}"] = 20.0 + len(column) - 1 / i
            row[f"ssim{column}"] = 0.9 - 0.3 / i
        rows.append(row)
    return rows


@pytest.fixture(name="figures")
def _figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that were saved, to be asked what is in them."""
    saved: list[Figure] = []
    savefig = Figure.savefig

    def record(self: Figure, *args: object, **kwargs: object) -> None:
        saved.append(self)
        savefig(self, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", record)
    return saved


@pytest.mark.sampled(1)
@pytest.mark.parametrize("count", [1, 2, 100])
def test_the_curve_shows_psnr_and_ssim_overall_and_per_regime(tmp_path: Path, figures, count: int):
    path = draw_curve(tmp_path, make_rows(count), "title", {"overall": 3, "near": 1, "far": 2})
    with Image.open(path) as image:
        assert image.format == "PNG"
        assert image.width > 800
    psnr, ssim = figures[0].axes
    assert (psnr.get_ylabel(), ssim.get_ylabel()) == ("PSNR (dB)", "SSIM")
    assert "training seconds" in ssim.get_xlabel()
    for ax in (psnr, ssim):
        assert len(ax.get_lines()) == 3
        for line in ax.get_lines():
            np.testing.assert_array_equal(line.get_xdata(), 1.5 * np.arange(1, count + 1))
    labels = [text.get_text() for text in figures[0].legends[0].get_texts()]
    assert [label.split(":")[0] for label in labels] == [
        "overall (3 views)",
        "far (2 views)",
        "near (1 view)",
    ]


def test_lines_differ_in_more_than_colour(tmp_path: Path, figures):
    draw_curve(tmp_path, make_rows(5, ("a", "b", "c")), "title", {"a": 1, "b": 1, "c": 1})
    lines = figures[0].axes[0].get_lines()
    assert len({line.get_color() for line in lines}) == 4
    assert len({line.get_marker() for line in lines}) == 4


def test_rendered_views_are_marked_at_the_time_they_were_reached(tmp_path: Path, figures):
    draw_curve(tmp_path, make_rows(10), "title", {"far": 1, "near": 1})
    above = figures[0].axes[0].child_axes[0]
    ticks = {
        tick.get_text(): place
        for tick, place in zip(above.get_xticklabels(), above.get_xticks(), strict=True)
    }
    assert ticks["0"] == 0.0
    assert ticks["2,000"] == pytest.approx(15.0)
    assert ticks["800"] == pytest.approx(6.0)


def test_the_curve_of_a_single_regime_is_not_drawn_twice(tmp_path: Path, figures):
    draw_curve(tmp_path, make_rows(3, ("far",)), "title", {"far": 1})
    assert len(figures[0].axes[0].get_lines()) == 1


def test_the_loss_is_drawn_if_there_are_no_held_out_views(tmp_path: Path, figures):
    rows = [{**row, "psnr": None, "ssim": None} for row in make_rows(4, ())]
    draw_curve(tmp_path, rows, "title")
    (ax,) = figures[0].axes
    assert ax.get_ylabel() == "training loss"
    np.testing.assert_array_equal(ax.get_lines()[0].get_ydata(), [1.0, 1 / 2, 1 / 3, 1 / 4])


@pytest.mark.parametrize("rows", [[], [{**make_rows(1)[0], "psnr": float("inf")}]])
def test_a_curve_without_data_is_not_an_error(tmp_path: Path, rows: list[Row]):
    assert draw_curve(tmp_path, rows, "title").is_file()


def test_scene_and_regime_names_are_drawn_without_interpretation_as_formulas(
    tmp_path: Path, figures
):
    draw_curve(tmp_path, make_rows(2, ("_raw", "a$b$")), "scene $x_1$", {"_raw": 1, "a$b$": 1})
    labels = [text.get_text().split(":")[0] for text in figures[0].legends[0].get_texts()]
    assert labels == ["overall", "'_raw' (1 view)", r"a\$b\$ (1 view)"]
