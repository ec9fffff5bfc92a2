"""A note for users whose grouping splits values that form a single cluster."""

import numpy as np

from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.slots.grouping import Grouping
from crossgrad_core.defaults import SAMPLER
from crossgrad_core.scene.bimodality import ONE_MODE, bimodality


def mode_note(name: str, grouping: Grouping, scene: Scene) -> tuple[str, ...]:
    """Return a note if the values that the grouping splits form a single cluster, else no note.

    The test compares the bimodality coefficient with `ONE_MODE`. Small samples use plain moments
    instead of the finite-sample form.

    Args:
        name: Name of the grouping, for the note.
        grouping: The grouping.
        scene: The scene.
    """
    quantity = grouping.quantity(scene, scene.train_views)
    if quantity is None:
        return ()
    measured = bimodality(quantity.values[np.isfinite(quantity.values)])
    figure = measured.deciding
    # The coefficient is NaN if all values are equal or the number of values is too small.
    if not figure < ONE_MODE:
        return ()
    return (
        (
            f"grouping {name} splits values that form only one group: the bimodality of "
            f"{quantity.name} is {figure:.2f} over {measured.size} training views (below "
            f"{ONE_MODE}), so that the split is arbitrary; sampler {SAMPLER} needs no "
            "groups"
        ),
    )
