"""Ctrl-C and SIGTERM at any phase: a quiet end, the right exit code, and the same bits later."""

import json
import random
import signal

import pytest

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("number", CODES)
def test_a_signal_at_any_instant_leaves_a_run_that_can_be_resumed(
    reference, thorough, tmp_path, number
):
    draw = random.Random(4)
    for index in range(max(2, thorough // 4)):
        folder = tmp_path / str(index)
        instant = draw.uniform(0.05, reference.seconds)
        end = reference.nursery.run(*reference.command(folder), signals=[(instant, number)])
        assert "Traceback" not in end.said, end.said
        assert end.code in {0, CODES[number]}, end.said
        reference.recovers(folder)


def _finished(folder):
    summary = folder / "summary.json"
    return summary.is_file() and json.loads(summary.read_text())["status"] == "finished"


def test_two_signals_in_short_order_end_the_run(reference, thorough, tmp_path):
    draw = random.Random(5)
    for index in range(max(2, thorough // 10)):
        folder = tmp_path / str(index)
        first = draw.uniform(0.3, 0.9) * reference.seconds
        both = [(first, signal.SIGINT), (first + 0.05, signal.SIGINT)]
        end = reference.nursery.run(*reference.command(folder), signals=both)
        assert "Traceback" not in end.said, end.said
        assert end.code in {0, 130}, end.said
        # Where the second one met a run that had all its results, there is nothing to go on with.
        if end.code == 130 and (folder / "config.yaml").is_file() and not _finished(folder):
            assert f"crossgrad run --resume {folder}" in end.said
        reference.recovers(folder)
