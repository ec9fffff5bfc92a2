"""One pixel of each 2 x 2 for most of the run, all of them at its end."""

from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import Camera, Field
from crossgrad_plugins.resolutions.octaves import Octaves


class Interlaced(Octaves):
    """Draws one pixel of each 2 x 2 up to a share of the run, another one in each step.

    Photos are not reduced: what is drawn is what the full render has at these pixels, so that the
    gradients of an error by pixels are right in the mean. Ours.
    """

    interlaced: ClassVar[bool] = True

    quarter_until: float = Field(
        0.0, ge=0, lt=1, description="share of the run with one pixel of each 4 x 4; 0: none"
    )
    half_until: float = Field(
        0.8, ge=0, lt=1, description="share of the run after which all pixels are drawn"
    )

    @override
    def of_photo(self, camera: Camera, scale: float) -> float:
        side = min(camera.width, camera.height)
        return 1.0 / max(1, min(round(1.0 / scale), side // self.smallest))
