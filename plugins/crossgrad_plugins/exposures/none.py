"""No exposure: photos are compared as they are."""

from collections.abc import Mapping

from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Exposure


class NoExposure(Exposure):
    """Compares renders with photos as they are: all are taken to have the same exposure."""

    @override
    def exposed(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        return image
