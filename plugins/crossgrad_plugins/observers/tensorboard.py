"""An observer that writes event files for TensorBoard."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import PrivateAttr
from typing_extensions import override

from crossgrad_core.plugin import RunInfo
from crossgrad_plugins.observers.tracker import Tracker

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

#: Folder of the event files in the folder of the run, as in gsplat.
FOLDER = "tb"


class TensorBoard(Tracker):
    """Writes RUN/tb for TensorBoard: numbers and images with the tags of gsplat, configuration.

    `tensorboard --logdir RUN/tb` shows them.
    """

    package: ClassVar[str] = "tensorboard"

    _writer: "SummaryWriter | None" = PrivateAttr(default=None)

    @override
    def open(self, run: RunInfo) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(Path(run.folder or "") / FOLDER))
        text = json.dumps(dict(run.config), indent=2, default=str)
        # TensorBoard shows indented lines of Markdown as they are.
        self._writer.add_text("config", "\n".join(f"    {line}" for line in text.splitlines()))

    @override
    def send(self, numbers: dict[str, float], step: int) -> None:
        if self._writer is not None:
            for tag, number in numbers.items():
                self._writer.add_scalar(tag, number, step)
            self._writer.flush()

    @override
    def send_image(self, tag: str, image: NDArray[np.uint8], step: int) -> None:
        if self._writer is not None:
            self._writer.add_image(tag, image, step, dataformats="HWC")
            self._writer.flush()

    @override
    def close(self, status: str) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None
