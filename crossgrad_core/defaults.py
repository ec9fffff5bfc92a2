"""The plugins that the core names: what a run takes where the user names none, and examples.

No other file of the core names a plugin.
"""

from typing import Final

#: What a run takes where the user names nothing.
BACKBONE: Final = "vanilla"
SAMPLER: Final = "epoch"
OPERATOR: Final = "sum"
LOSS: Final = "l1-ssim"
#: The start of published runs, and of those that begin with points of their own: it adds nothing.
BARE_START: Final = "points"
#: The start that has points for a scene without any: a hint.
START_ALONE: Final = "triangulated"
RESOLUTION: Final = "full"
#: Also reads the file of `--init FILE.ply`.
EXPORTER: Final = "ply"
METRICS: Final = "psnr+ssim+ssim-skimage+psnr-track+psnr-cc+lpips"
#: The densifier of a backbone that names none.
DENSIFIER: Final = "adc"
#: The reader that says what is missing in a folder that no reader accepts.
READER: Final = "colmap"
#: The reader of `--prepare`, which finds the cameras of a folder of photos.
PREPARING_READER: Final = "photos-alone"
#: The operator that runs the links of `--operator a+b`.
CHAIN: Final = "chain"
#: The recipe that decides what the user does not set.
RECIPE: Final = "auto"
#: The planner of `--plan`.
PLANNER: Final = "scene"
#: The observer that every run has.
PROGRESS: Final = "progress"

#: What contract checks draw with, and the densifier that they switch edits off with.
REFERENCE_RASTERIZER: Final = "torch"
NO_DENSIFIER: Final = "none"

#: A sampler that draws from groups, an operator and a chain: examples in help and in hints.
GROUP_SAMPLER: Final = "near-far"
EXAMPLE_OPERATOR: Final = "symmetric"
EXAMPLE_CHAIN: Final = "preconditioner+symmetric"
