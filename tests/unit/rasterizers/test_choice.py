"""`--rasterizer auto` asks every installed rasterizer how fast it is, third parties' too."""

import sys

import pytest
from support.distributions import write_distribution

from crossgrad_core.errors import UserError
from crossgrad_core.run.rasterizers import Wanted, choose_rasterizer

FAST = """
from crossgrad_core.plugin import Rasterizer

class Fast(Rasterizer):
    devices = frozenset({"cpu", "cuda"})

    @classmethod
    def speed(cls, device):
        return 1000.0

    def render(self, gaussians, camera, background, outputs=frozenset()):
        raise NotImplementedError

class Shy(Fast):
    @classmethod
    def speed(cls, device):
        return 0.0

class Broken(Fast):
    no_such_thing
"""
PLAIN = Wanted("cpu", "plain")


@pytest.fixture
def install(tmp_path, monkeypatch):
    def put(source=FAST, **plugins):
        write_distribution(
            tmp_path, "made-up", {"rasterizers": plugins}, {"made_up_rasterizer": source}
        )
        monkeypatch.syspath_prepend(tmp_path)

    yield put
    sys.modules.pop("made_up_rasterizer", None)


SOUND = FAST.partition("class Broken")[0]


def test_bundled_rasterizers_are_chosen_by_device():
    assert choose_rasterizer("auto", PLAIN)[0] == "numba"
    # Those that were made for it have tests of their own, and may not be installed here.
    assert choose_rasterizer("auto", Wanted("cuda", "analytic"))[0] == "torch"


def test_a_named_rasterizer_is_used_as_given():
    assert choose_rasterizer("torch", PLAIN) == ("torch", ("rasterizer torch: chosen by the user",))


def test_a_faster_third_party_rasterizer_is_chosen(install):
    install(SOUND, fast="made_up_rasterizer:Fast")
    name, notes = choose_rasterizer("auto", PLAIN)
    assert name == "fast"
    assert notes == ("rasterizer fast: the fastest of 3 usable rasterizers on cpu",)


def test_a_rasterizer_of_speed_zero_is_never_chosen(install):
    install(SOUND, aaa="made_up_rasterizer:Shy")
    assert choose_rasterizer("auto", PLAIN)[0] == "numba"


@pytest.mark.parametrize(
    "wanted",
    [
        Wanted("cpu", "analytic"),
        Wanted("cpu", "plain", outputs=frozenset({"pixels"})),
        Wanted("cpu", "plain", options=frozenset({"footprint"})),
    ],
    ids=["response", "output", "option"],
)
def test_a_faster_rasterizer_without_a_needed_feature_is_skipped(install, wanted):
    install(SOUND, fast="made_up_rasterizer:Fast")
    assert choose_rasterizer("auto", wanted)[0] == "numba"


def test_the_fastest_rasterizer_is_chosen_if_none_provides_the_outputs(install):
    install(SOUND, fast="made_up_rasterizer:Fast")
    wanted = Wanted("cpu", "plain", outputs=frozenset({"no such output"}))
    assert choose_rasterizer("auto", wanted)[0] == "fast"


def test_a_rasterizer_that_cannot_be_imported_is_left_out_with_a_note(install):
    install(broken="made_up_rasterizer:Broken")
    name, notes = choose_rasterizer("auto", PLAIN)
    assert name == "numba"
    assert notes[0].startswith(
        "rasterizer broken is not used: rasterizer broken cannot be imported"
    )


def test_a_device_without_a_rasterizer_is_refused():
    with pytest.raises(UserError, match="no installed rasterizer runs on device mps"):
        choose_rasterizer("auto", Wanted("mps", "plain"))
