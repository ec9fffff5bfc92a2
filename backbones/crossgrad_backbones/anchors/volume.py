"""The volume regularisation of neural Gaussians."""

from torch import Tensor

from crossgrad_core.plugin import Gaussians


def mean_volume(gaussians: Gaussians) -> Tensor:
    """Mean over the Gaussians of the product of their three scales; 0 where there are none.

    Source: Scaffold-GS, section 3.4.
    """
    return gaussians.scales.prod(1).sum() / max(1, len(gaussians))
