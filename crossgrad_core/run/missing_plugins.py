"""A run is looked at where packages that trained it are not installed: plain parts stand in.

What trains is not asked again for a picture, a file or a figure; what draws is.
"""

import logging
from typing import Final

from crossgrad_core import defaults
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.registry.slots import LISTS
from crossgrad_core.wording import listed, plural, singular

_LOG = logging.getLogger(__name__)

#: Slot -> what stands in for a part of it.
_PLAIN: Final = {
    "sampler": defaults.SAMPLER,
    "operator": defaults.OPERATOR,
    "densifier": defaults.NO_DENSIFIER,
    "loss": defaults.LOSS,
    # It asks for no points, of which the scene may have none.
    "initializer": defaults.START_ALONE,
    "resolution": defaults.RESOLUTION,
}
#: Slots (singular words) whose components a run can be looked at without.
REPLACEABLE: Final = frozenset({*_PLAIN, *map(singular, LISTS)})


def without_missing(config: RunConfig) -> RunConfig:
    """The configuration with plain parts for those that only train, and are not installed here.

    Metrics and observers that are not are left out.
    """
    update: dict[str, object] = {}
    lacking = []
    for slot, plain in _PLAIN.items():
        chosen = config.operators if slot == "operator" else (getattr(config, slot),)
        if gone := [each.name for each in chosen if each is not None and _is_gone(slot, each)]:
            lacking.append(f"{slot} {listed(gone)}")
            update[slot] = ComponentChoice(name=plain)
    for slot in LISTS:
        known, chosen = entries(slot), getattr(config, slot)
        if gone := [each.name for each in chosen if each.name not in known]:
            lacking.append(f"{slot} {listed(gone)}")
            update[slot] = tuple(each for each in chosen if each.name in known)
    if lacking:
        _LOG.warning("not installed here, and left out: %s", listed(lacking))
    return config.model_copy(update=update)


def _is_gone(slot: str, choice: ComponentChoice) -> bool:
    """Whether a part, or one that its options name, is not installed."""
    if choice.name not in entries(plural(slot)):
        return True
    if slot != "operator":
        return False
    try:
        build(plural(slot), choice.name, choice.options)
    except UserError:
        return True
    return False


def as_it_was(config: RunConfig, trained: RunConfig) -> RunConfig:
    """The configuration with the parts again that trained it."""
    return config.model_copy(update={slot: getattr(trained, slot) for slot in _PLAIN})
