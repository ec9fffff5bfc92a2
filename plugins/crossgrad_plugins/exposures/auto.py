"""A gain per photo where SfM tracks say that photos differ in exposure."""

from collections.abc import Mapping

from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Exposure, Fitted, Scene
from crossgrad_plugins.exposures.gain import Gain
from crossgrad_plugins.exposures.none import NoExposure
from crossgrad_plugins.exposures.tracks.gains import LEAST_REDUCTION, LEAST_SPREAD, training_gains


class Auto(Exposure):
    """Takes `gain` where the brightness of SfM tracks calls for it, and `none` elsewhere.

    On where the gains that explain the brightness of the training photos at SfM points have a
    standard deviation of at least 0.2 stops, and take at least 15 % off the deviation.
    """

    @override
    def fitted_to(self, scene: Scene) -> Fitted:
        gains = training_gains(scene)
        if gains.differ:
            # Its remarks have the evidence.
            return Fitted(Gain(), "gain", ("exposure auto: gain",))
        rule = f"less than {LEAST_SPREAD} stops or {100 * LEAST_REDUCTION:.0f} %"
        why = gains.evidence if not gains.known.any() else f"{gains.evidence}; {rule}"
        return Fitted(NoExposure(), "none", (f"exposure auto: none; {why}",))

    @override
    def exposed(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        return image
