"""Every component that ships keeps the contract of its slot; a new one is covered without a line.

Ours are taken by distribution: somebody else's plugin in this environment is not our test.
"""

import pytest

from crossgrad_core.registry import entries as registry
from crossgrad_core.registry.slots import GROUPS
from crossgrad_core.testing.checking import checks_of

CASES = [
    pytest.param(entry, check, id=f"{entry.slot}-{entry.name}-{check.__name__}")
    for slot in GROUPS
    for entry in registry.offers(slot)
    if entry.distribution == "crossgrad"
    for check in checks_of(slot)
]


@pytest.mark.parametrize(("entry", "check"), CASES)
def test_every_component_keeps_the_contract_of_its_slot(entry, check):
    check(registry.load(entry.slot, entry.name))
