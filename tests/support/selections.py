"""Selections of components, in which only what a test asks about was chosen."""

from typing import Any

from crossgrad_core.contract.selection import Selection
from crossgrad_core.registry.entries import build
from crossgrad_core.wording import plural

_USUAL = {
    "backbone": "vanilla",
    "sampler": "random",
    "operator": "sum",
    "densifier": "none",
    "rasterizer": "torch",
    "loss": "l1-ssim",
    "exposure": "none",
    "initializer": "points",
    "resolution": "full",
    "exporter": "ply",
}


def selection_of(**chosen: Any) -> Selection:
    """A selection with these fields; components that are not given are usual ones."""
    built = {
        slot: build(plural(slot), name, {}) for slot, name in _USUAL.items() if slot not in chosen
    }
    names = {**_USUAL, **chosen.pop("names", {})}
    return Selection(
        **{"views_per_step": 2, "device": "cpu", "metrics": {}, **built, **chosen, "names": names}
    )
