"""The plugins that the core names: the defaults of a run, and examples in help texts and messages.

No other file of the core names a plugin.
"""

from typing import Final

#: The component of a slot if the user names none.
BACKBONE: Final = "vanilla"
SAMPLER: Final = "epoch"
OPERATOR: Final = "sum"
LOSS: Final = "l1-ssim"
#: The initializer of published runs, and of runs whose points come from a file: it adds nothing.
PLAIN_INITIALIZER: Final = "points"
#: The initializer that finds points for a scene without any; messages name it.
INITIALIZER_WITHOUT_POINTS: Final = "triangulated"
RESOLUTION: Final = "full"
#: Also reads the file of `--init FILE.ply`.
EXPORTER: Final = "ply"
METRICS: Final = "psnr+ssim+ssim-skimage+psnr-track+psnr-cc+lpips"
#: The densifier of a backbone that names none.
DENSIFIER: Final = "adc"
#: The reader whose error says what is missing if no reader accepts a folder.
READER: Final = "colmap"
#: The reader of `--prepare`, which finds the cameras of a folder of photos.
PREPARING_READER: Final = "photos-alone"
#: The operator that runs the links of `--operator a+b`.
CHAIN: Final = "chain"
#: The recipe that decides what the user does not set.
RECIPE: Final = "auto"
#: The planner of `--plan`.
PLANNER: Final = "scene"
#: The observer of every run.
PROGRESS: Final = "progress"

#: The rasterizer of contract checks, and the densifier that makes no edits.
REFERENCE_RASTERIZER: Final = "torch"
NO_DENSIFIER: Final = "none"

#: Examples in help and in messages: a sampler that draws from groups, an operator and a chain.
GROUP_SAMPLER: Final = "near-far"
EXAMPLE_OPERATOR: Final = "symmetric"
EXAMPLE_CHAIN: Final = "preconditioner+symmetric"
