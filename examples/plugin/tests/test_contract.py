"""The contract checks of each slot, with two lines per plugin."""

import pytest
from crossgrad_example.borrowed import Borrowed
from crossgrad_example.charbonnier import Charbonnier
from crossgrad_example.clip import Clip
from crossgrad_example.coarse_first import CoarseFirst
from crossgrad_example.count_views import count_views
from crossgrad_example.equal_length import EqualLength
from crossgrad_example.faint import Faint
from crossgrad_example.gain import Gain
from crossgrad_example.gentle import Gentle
from crossgrad_example.jitter import Jitter
from crossgrad_example.largest_error import LargestError
from crossgrad_example.least_seen import LeastSeen
from crossgrad_example.median_distance import MedianDistance
from crossgrad_example.poses import Poses
from crossgrad_example.sky import Sky
from crossgrad_example.spheres import Spheres
from crossgrad_example.xyz import Xyz

from crossgrad_core.testing.checking import AnyCheck, checks_of

PLUGINS = {
    "backbones": Spheres,
    "samplers": LeastSeen,
    "groupings": MedianDistance,
    "operators": EqualLength,
    "densifiers": Faint,
    "rasterizers": Borrowed,
    "losses": Charbonnier,
    "exposures": Gain,
    "initializers": Sky,
    "resolutions": CoarseFirst,
    "readers": Poses,
    "exporters": Xyz,
    "metrics": LargestError,
    "observers": Clip,
    "recipes": Gentle,
    "rules": Jitter,
    "commands": count_views,
}
CASES = [(slot, check) for slot in PLUGINS for check in checks_of(slot)]


@pytest.mark.parametrize(("slot", "check"), CASES)
def test_it_keeps_the_contract(slot: str, check: AnyCheck) -> None:
    check(PLUGINS[slot])
