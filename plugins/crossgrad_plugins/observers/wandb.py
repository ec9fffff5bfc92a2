"""An observer that sends numbers, images and the configuration of a run to Weights & Biases."""

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr
from typing_extensions import override

from crossgrad_core.plugin import RunInfo
from crossgrad_plugins.observers.tracker import Tracker


class WandB(Tracker):
    """Sends a run to Weights & Biases: numbers and images with the tags of gsplat, configuration.

    With `mode: offline`, the record stays in RUN/wandb, and `wandb sync` sends it later.
    """

    package: ClassVar[str] = "wandb"

    project: str = Field("crossgrad", description="project of Weights & Biases")
    mode: Literal["online", "offline"] | None = Field(
        None, description="default: the environment variable WANDB_MODE, else online"
    )

    # The record of the run, an object of the package.
    _record: Any = PrivateAttr(default=None)

    @override
    def open(self, run: RunInfo) -> None:
        import wandb

        self._record = wandb.init(
            project=self.project,
            name=run.folder.name if run.folder else None,
            dir=run.folder,
            config=dict(run.config),
            mode=self.mode,
        )

    @override
    def send(self, numbers: dict[str, float], step: int) -> None:
        self._record.log(numbers, step=step)

    @override
    def send_image(self, tag: str, image: NDArray[np.uint8], step: int) -> None:
        import wandb

        self._record.log({tag: wandb.Image(image)}, step=step)

    @override
    def close(self, status: str) -> None:
        self._record.finish(exit_code=0 if status == "finished" else 1)
