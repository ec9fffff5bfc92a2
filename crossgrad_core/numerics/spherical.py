"""Constants of the real spherical harmonics that carry view-dependent colour."""

from typing import Final

#: Band 0 of the real spherical harmonics: 1 / (2 sqrt(pi)).
SH_C0: Final = 0.28209479177387814

#: Number of coefficients up to and including each degree.
COEFFICIENTS: Final = (1, 4, 9, 16)
