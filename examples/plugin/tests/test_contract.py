"""The contract checks of each slot: two lines per plugin."""

import pytest
from crossgrad_example.clip import Clip
from crossgrad_example.equal_length import EqualLength
from crossgrad_example.least_seen import LeastSeen

from crossgrad_core.plugin import Observer, Operator, Sampler
from crossgrad_core.testing.contract import Check
from crossgrad_core.testing.observers import OBSERVER_CHECKS
from crossgrad_core.testing.operators import OPERATOR_CHECKS
from crossgrad_core.testing.samplers import SAMPLER_CHECKS


@pytest.mark.parametrize("check", OPERATOR_CHECKS)
def test_equal_length(check: Check[Operator]) -> None:
    check(EqualLength)


@pytest.mark.parametrize("check", SAMPLER_CHECKS)
def test_least_seen(check: Check[Sampler]) -> None:
    check(LeastSeen)


@pytest.mark.parametrize("check", OBSERVER_CHECKS)
def test_clip(check: Check[Observer]) -> None:
    check(Clip)
