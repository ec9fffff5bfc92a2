"""The photometric training loss of 3D Gaussian Splatting: 0.8 * L1 + 0.2 * (1 - SSIM)."""

from crossgrad_core.photometric.loss import photometric_loss
from crossgrad_core.photometric.reference import l1_ssim_loss, ssim_map

__all__ = ["l1_ssim_loss", "photometric_loss", "ssim_map"]
