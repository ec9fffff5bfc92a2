"""PSNR after the render gets the view's exposure, which is estimated at SfM points."""

from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Compared, Figure, Metric, psnr
from crossgrad_plugins.exposures.srgb import encoded, with_gain
from crossgrad_plugins.exposures.tracks.gains import LEAST
from crossgrad_plugins.exposures.tracks.observations import light_at

#: Step sizes, in stops, of the search for a gain around the first estimate, from coarse to fine.
_STEPS = (0.1, 0.01)
_TRIED = 15


class TrackExposedPSNR(Metric):
    """PSNR of the render after one gain in linear light, estimated from SfM observations.

    The gain minimises the difference of render and photo at the SfM points that the photo observed.
    The metric uses the photo only at these points, from which SfM also estimated the photo's pose.
    """

    figure: ClassVar[Figure] = Figure(
        name="psnr_track",
        label="PSNR (track)",
        form=".2f",
        per_regime=True,
        definition="dB; PSNR of the render with one gain in linear light, which brings it closest "
        "to the photo at the SfM points that the view observed (3 x 3 means, least squares of sRGB "
        "values)",
        undefined=f"no held-out view has {LEAST} SfM observations that are neither too dark nor "
        "saturated",
    )

    @override
    def measure(self, compared: Compared) -> float | None:
        if not len(compared.points):
            return None
        drawn = compared.render / 255.0 if compared.drawn is None else compared.drawn
        stops = _closest(drawn, compared)
        if stops is None:
            return None
        exposed = with_gain(drawn.float(), torch.tensor(stops))
        return psnr(exposed, compared.photo, compared.mask)


def _closest(drawn: Tensor, compared: Compared) -> float | None:
    """Return the gain in stops, or None if too few observations are usable."""
    camera = compared.view.camera
    of_photo = light_at(compared.photo, compared.mask, camera, compared.points)
    if np.count_nonzero(of_photo.usable) < LEAST:
        return None
    wanted = of_photo.brightness[of_photo.usable]
    of_render = light_at(drawn, compared.mask, camera, compared.points)
    light = np.maximum(of_render.brightness[of_photo.usable], 0.0)
    lit = light > 0.0
    if not lit.any():
        return 0.0
    # Use the median, because one light source far brighter than white would dominate a sum.
    stops = float(np.log2(np.median(wanted[lit] / light[lit])))
    for step in _STEPS:
        tried = stops + step * np.arange(-_TRIED, _TRIED + 1)
        distances = _distances(light * 2.0 ** tried[:, None], wanted)
        stops = float(tried[np.argmin(distances)])
    return stops


def _distances(lights: NDArray[np.float64], wanted: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean squared sRGB differences of lights [L, N] from the photo's light [N].

    Values above white are clipped to white, as in the comparison of render and photo.
    """
    srgb_lights, srgb_wanted = (
        encoded(torch.from_numpy(brightness)).clamp(max=1.0) for brightness in (lights, wanted)
    )
    return (srgb_lights - srgb_wanted).square().mean(dim=1).numpy()
