"""A run that ends below its best evaluation says so, and what to do."""

from math import nan

import pytest

from crossgrad_core.run.finish import WORSE, overdone


def rows_of(*figures):
    return [
        {"step": 100 * k, "train_seconds": 12.4 * k, "psnr": psnr, "ssim": 0.5}
        for k, psnr in enumerate(figures, 1)
    ]


def test_a_better_earlier_evaluation_is_reported_with_step_and_time():
    (line,) = overdone(rows_of(18.0, 19.07, 18.12))
    assert line.startswith("the last evaluation is 0.95 dB lower than at step 200 (19.07 dB after ")
    assert "25 s of training" in line and "--max-views" in line


@pytest.mark.parametrize(
    "figures",
    [(), (19.0,), (18.0, 19.0), (19.0, 19.0 - WORSE + 1e-9), (None, None), (19.0, None), (nan, 9.0),
     (19.0, nan)],
)  # fmt: skip
def test_a_final_evaluation_near_the_best_or_without_metrics_is_not_reported(figures):
    assert overdone(rows_of(*figures)) == []
