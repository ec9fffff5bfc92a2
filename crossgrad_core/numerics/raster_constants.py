"""Constants of the rasterization rules (docs/rasterizers.md) and of spherical harmonics."""

from typing import Final

#: A Gaussian touches a pixel if its alpha there reaches this value.
ALPHA_THRESHOLD: Final = 1.0 / 255.0
#: Compositing stops before a blend that would bring the transmittance below this value.
TRANSMITTANCE_STOP: Final = 1e-4
#: The position at which the Jacobian is evaluated is limited to the image plus a margin on each
#: side. The margin is this share of half the image's extent.
JACOBIAN_MARGIN: Final = 0.3
#: Band 0 of the real spherical harmonics: 1 / (2 sqrt(pi)).
SH_C0: Final = 0.28209479177387814
#: Number of coefficients up to and including each degree.
COEFFICIENTS: Final = (1, 4, 9, 16)
