"""The photometric training loss of 3D Gaussian Splatting: 0.8 * L1 + 0.2 * (1 - SSIM)."""
