"""Options of engines are refused before anything begins."""

import pytest

from crossgrad_core.commands import UserError
from crossgrad_plugins.sweep.engines import ENGINES, check_options


@pytest.mark.parametrize("name", ENGINES)
def test_an_unknown_option_of_an_engine_is_refused(name):
    check_options(name, ())
    with pytest.raises(
        UserError, match=f"the engine {name} (has no options|does not have this option)"
    ) as caught:
        check_options(name, ["adress"])
    assert caught.value.found == "adress"
    # One without options lists none.
    assert ("address" in caught.value.expected) == (name == "ray")


def test_known_options_of_an_engine_are_accepted():
    check_options("ray", ["address"])
    check_options("slurm", ["time", "cluster"])
