"""The note on a grouping that splits a distribution with a single mode."""

import numpy as np

from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.slots.grouping import Grouping
from crossgrad_core.defaults import SAMPLER
from crossgrad_core.scene.bimodality import ONE_MODE, bimodality


def mode_note(name: str, grouping: Grouping, scene: Scene) -> tuple[str, ...]:
    """Return a note if the quantity that the grouping splits has a single mode, else no note.

    The finite-sample form of the bimodality coefficient decides; for small samples, the form with
    plain moments is used.

    Args:
        name: Name of the grouping.
        grouping: The grouping.
        scene: The scene.
    """
    quantity = grouping.quantity(scene, scene.train_views)
    if quantity is None:
        return ()
    measured = bimodality(quantity.values[np.isfinite(quantity.values)])
    figure = measured.deciding
    # The coefficient is NaN if all values are equal or there are too few values.
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
