"""Constants of the rasterization rules (docs/rasterizers.md) and of spherical harmonics."""

from typing import Final

#: A Gaussian affects a pixel if its alpha at the pixel is at least this value.
ALPHA_THRESHOLD: Final = 1.0 / 255.0
#: Compositing of a pixel stops before the transmittance would fall below this value.
TRANSMITTANCE_STOP: Final = 1e-4
#: The Jacobian is evaluated at the Gaussian's centre, clamped to the image plus a margin on each
#: side. The margin is this factor times half the image size.
JACOBIAN_MARGIN: Final = 0.3
#: Value of the constant spherical harmonic (degree 0): 1 / (2 sqrt(pi)).
SH_C0: Final = 0.28209479177387814
#: Number of spherical harmonics coefficients up to degree 0, 1, 2 and 3.
COEFFICIENTS: Final = (1, 4, 9, 16)
