"""Constants of the rule set that all rasterizers share (docs/rasterizers.md)."""

from typing import Final

#: A Gaussian touches a pixel where its alpha reaches this value.
ALPHA_THRESHOLD: Final = 1.0 / 255.0
#: Compositing stops before a blend that would bring the transmittance below this value.
TRANSMITTANCE_STOP: Final = 1e-4
#: The Jacobian is evaluated inside the image plus this share of half its extent on either side.
JACOBIAN_MARGIN: Final = 0.3
