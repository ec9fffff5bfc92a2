"""Names of plugins in the core: the defaults of a run, and examples in help texts and messages.

No other file of the core contains names of plugins.
"""

from typing import Final

#: Default component of each slot.
BACKBONE: Final = "vanilla"
SAMPLER: Final = "epoch"
OPERATOR: Final = "sum"
LOSS: Final = "l1-ssim"
#: Initializer that adds no points, for published runs and for runs whose points come from a file.
PLAIN_INITIALIZER: Final = "points"
#: Initializer that finds points for a scene without points. Messages to users contain the name of
#: this initializer.
INITIALIZER_WITHOUT_POINTS: Final = "triangulated"
RESOLUTION: Final = "full"
EXPORTER: Final = "ply"
#: Exporter of the page that shows a small scene in a browser.
PAGE_EXPORTER: Final = "html"
METRICS: Final = "psnr+ssim+ssim-skimage+psnr-track+psnr-cc+lpips"
#: Densifier of backbones that define no default densifier.
DENSIFIER: Final = "adc"
#: If no reader accepts a folder, the error message of this reader explains what is missing.
READER: Final = "colmap"
#: Reader of `--prepare`, which estimates the camera poses of a folder of photos.
PREPARING_READER: Final = "photos-alone"
#: Operator that runs the operators of a chain, `--operator a+b`.
CHAIN: Final = "chain"
#: Recipe that decides the settings that the user does not set.
RECIPE: Final = "auto"
#: Planner of `--plan`.
PLANNER: Final = "scene"
#: Observer of every run.
PROGRESS: Final = "progress"
#: Observer of `crossgrad run --view`.
VIEWER: Final = "view"
#: Observers that only show the run to the user. They belong to the command, so that config.yaml
#: does not name them.
DISPLAYS: Final = frozenset({PROGRESS, VIEWER})

#: The rasterizer that checks of plugins use, and the densifier that makes no edits.
REFERENCE_RASTERIZER: Final = "torch"
NO_DENSIFIER: Final = "none"

#: Examples in help and in messages: a sampler that draws from groups, an operator and a chain.
GROUP_SAMPLER: Final = "near-far"
EXAMPLE_OPERATOR: Final = "symmetric"
EXAMPLE_CHAIN: Final = "preconditioner+symmetric"
