"""A clock that jumps by days: the run ends as it would have, with the same bits."""

import pytest
from crossgrad_faults import laws


@pytest.mark.slow
@pytest.mark.parametrize("at", [2, 9])
def test_a_run_survives_jumps_of_the_system_clock(reference, tmp_path, at):
    folder = tmp_path / "run"
    fault = {"below": str(folder), "at": at, "what": "jump"}
    end = reference.nursery.run(*reference.command(folder), fault=fault)
    assert end.code == 0, end.said
    laws.parses(folder)
    laws.same_bits(reference.folder, folder)
