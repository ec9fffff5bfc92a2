"""Gaussians with spherical harmonics as arrays, in the units of the files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.numerics.elementwise import sigmoid
from crossgrad_core.numerics.raster_constants import SH_C0
from crossgrad_core.plugin import Gaussians, Similarity

#: Number of coefficients of bands 1 to 3.
REST = 15

_SMALLEST_SCALE = float(np.finfo(np.float32).tiny)
#: With this margin, the logit of an opacity of exactly 0 or 1 is finite. 1 minus the margin is the
#: largest float32 number below 1.
_OPACITY_MARGIN = 2.0**-24

#: How viewers should draw the Gaussians: as 3DGS does, or antialiased as Mip-Splatting does.
RenderMode = Literal["default", "mip"]


@dataclass(frozen=True, eq=False)
class SplatCloud:
    """N Gaussians in file units.

    Attributes:
        means: [N, 3] float64 centres.
        log_scales: [N, 3] float32 natural logarithms of the standard deviations.
        quats: [N, 4] float32 rotations wxyz, not necessarily normalised.
        logit_opacities: [N] float32.
        sh_dc: [N, 3] float32, band 0.
        sh_rest: [N, 15, 3] float32, bands 1 to 3; zero for bands that are not in use.
        render_mode: The mode in which viewers should draw the Gaussians.
    """

    means: NDArray[np.float64]
    log_scales: NDArray[np.float32]
    quats: NDArray[np.float32]
    logit_opacities: NDArray[np.float32]
    sh_dc: NDArray[np.float32]
    sh_rest: NDArray[np.float32]
    render_mode: RenderMode = "default"

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """The highest degree with a non-zero coefficient."""
        for degree in (3, 2, 1):
            if np.any(self.sh_rest[:, degree**2 - 1 : (degree + 1) ** 2 - 1]):
                return degree
        return 0

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians) -> "SplatCloud":
        """Return the Gaussians of a backbone; bands above their active degree become zero."""
        opacities = _array(gaussians.opacities).reshape(-1)
        opacities = np.clip(opacities, _OPACITY_MARGIN, 1.0 - _OPACITY_MARGIN)
        scales = np.maximum(_array(gaussians.scales), _SMALLEST_SCALE)
        return cls(
            means=_array(gaussians.means),
            log_scales=np.log(scales).astype(np.float32),
            quats=_array(gaussians.quats).astype(np.float32),
            logit_opacities=(np.log(opacities) - np.log1p(-opacities)).astype(np.float32),
            sh_dc=_constant_band(gaussians).astype(np.float32),
            sh_rest=_higher_bands(gaussians),
            render_mode="mip" if gaussians.response == "antialiased" else "default",
        )

    def to_gaussians(self) -> Gaussians:
        """Return float32 Gaussians on the CPU with the bands that are in use.

        Map a georeferenced cloud with `to_local` first, because float32 cannot represent map
        coordinates.
        """
        degree = self.sh_degree
        return Gaussians(
            means=torch.from_numpy(self.means.astype(np.float32)),
            quats=torch.tensor(self.quats),
            scales=torch.exp(torch.tensor(self.log_scales)).clamp_min(_SMALLEST_SCALE),
            opacities=sigmoid(torch.tensor(self.logit_opacities)),
            sh_dc=torch.tensor(self.sh_dc[:, None, :]),
            sh_rest=torch.tensor(self.sh_rest[:, : (degree + 1) ** 2 - 1]) if degree else None,
            sh_degree=degree,
            response="antialiased" if self.render_mode == "mip" else "plain",
        )

    def to_input(self, similarity: Similarity) -> "SplatCloud":
        """Map a cloud of the local frame to the input frame."""
        return self._mapped(similarity.to_input(self.means), -log(similarity.scale))

    def to_local(self, similarity: Similarity) -> "SplatCloud":
        """Map a cloud of the input frame to the local frame."""
        return self._mapped(similarity.to_local(self.means), log(similarity.scale))

    def selected(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "SplatCloud":
        """Return the Gaussians that are marked in `rows` [N] bool, or that have these numbers."""
        return replace(
            self,
            means=self.means[rows],
            log_scales=self.log_scales[rows],
            quats=self.quats[rows],
            logit_opacities=self.logit_opacities[rows],
            sh_dc=self.sh_dc[rows],
            sh_rest=self.sh_rest[rows],
        )

    @classmethod
    def joined(cls, clouds: "Sequence[SplatCloud]") -> "SplatCloud":
        """Return the Gaussians of all clouds, at least one, with the mode of the first."""
        names = ("means", "log_scales", "quats", "logit_opacities", "sh_dc", "sh_rest")
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(each, name) for each in clouds]) for name in names
        }
        return replace(clouds[0], **arrays)

    def _mapped(self, means: NDArray[np.float64], log_scale: float) -> "SplatCloud":
        # The similarity has no rotation, so quaternions and spherical harmonics do not change.
        log_scales = (self.log_scales.astype(np.float64) + log_scale).astype(np.float32)
        return replace(self, means=means, log_scales=log_scales)


def _array(tensor: Tensor) -> NDArray[np.float64]:
    array: NDArray[np.float64] = tensor.detach().cpu().double().numpy()
    return array


def _constant_band(gaussians: Gaussians) -> NDArray[np.float64]:
    """Return [N, 3] band 0; RGB colours are equal in all directions and need no other band."""
    if gaussians.colors is not None:
        return (_array(gaussians.colors) - 0.5) / SH_C0
    if gaussians.sh_dc is None:
        message = "the Gaussians contain neither colors nor sh_dc"
        raise ValueError(message)
    return _array(gaussians.sh_dc)[:, 0]


def _higher_bands(gaussians: Gaussians) -> NDArray[np.float32]:
    rest = np.zeros((len(gaussians), REST, 3), dtype=np.float32)
    if gaussians.sh_rest is not None and gaussians.colors is None:
        active = (gaussians.sh_degree + 1) ** 2 - 1
        bands = gaussians.sh_rest[:, :active].detach().cpu()
        rest[:, : bands.shape[1]] = bands.numpy()
    return rest
