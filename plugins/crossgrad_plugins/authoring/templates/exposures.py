"""An exposure: between the render and the photo of a camera."""

from collections.abc import Mapping

from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Exposure, Field


class Template(Exposure):
    """One brightness for all photos."""

    gain: float = Field(1.0, gt=0.0, description="factor of every render")

    @override
    def apply(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        return image * self.gain
