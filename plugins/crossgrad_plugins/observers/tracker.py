"""The common part of observers that send numbers and images of a run to another program."""

import logging
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr
from torch import Tensor

from crossgrad_core.plugin import (
    EvaluationReport,
    Observer,
    RunInfo,
    Selection,
    StepRecord,
    View,
    hookimpl,
    to_uint8,
)

_LOG = logging.getLogger(__name__)

#: Column of metrics.csv -> tag of the trainer of gsplat.
_TAGS = {"primitives": "num_GS", "step": None, "loss": None, "peak_memory_mib": None}


class Tracker(Observer):
    """An observer with the tags of gsplat's trainer: `train/loss`, `val/psnr` and so on.

    Attributes:
        package: The package of the other program, which is also the name of crossgrad's extra.
    """

    package: ClassVar[str]

    every: int = Field(100, ge=1, description="steps between two numbers of the training")
    images: int = Field(
        2, ge=0, description="held-out views whose photo and render are stored at each evaluation"
    )

    _run: RunInfo | None = PrivateAttr(default=None)

    @hookimpl
    def crossgrad_validate_selection(self, selection: Selection) -> list[str] | None:
        """Refuse the run if the package is missing."""
        if find_spec(self.package) is not None:
            return None
        return [
            f"observer {self.package} needs the package {self.package}, which is not installed: "
            f"pip install 'crossgrad[{self.package}]'"
        ]

    @hookimpl
    def crossgrad_run_start(self, run: RunInfo) -> None:
        """Open the record of the run, with its configuration; without a folder nothing is sent."""
        self._run = run if run.folder is not None and find_spec(self.package) else None
        self._attempt(partial(self.open, run))

    @hookimpl
    def crossgrad_step_end(self, record: StepRecord) -> None:
        """Send loss and number of Gaussians at intervals."""
        if record.step % self.every == 0 or record.step == 1:
            numbers = {
                "train/loss": sum(record.losses) / max(1, len(record.losses)),
                "train/num_GS": float(record.primitives),
            }
            self._attempt(partial(self.send, numbers, record.step))

    @hookimpl
    def crossgrad_evaluation(self, report: EvaluationReport) -> None:
        """Send the metrics, and photo and render of some held-out views."""
        row, numbers = report.row, dict[str, float]()
        for name, value in row.items():
            tag = _TAGS.get(name, name)
            if tag is not None and isinstance(value, int | float):
                numbers[f"val/{tag}"] = float(value)
        memory = row.get("peak_memory_mib")
        if isinstance(memory, int | float):
            numbers["train/mem"] = memory / 1024
        self._attempt(partial(self.send, numbers, report.step))
        if report.render is not None and self._run is not None:
            for view in self._run.scene.test_views[: self.images]:
                self._attempt(partial(self._send_view, view, report.render, report.step))

    def _send_view(self, view: View, render: Callable[[View], Tensor], step: int) -> None:
        with torch.no_grad():
            sides = [view.photo.image().cpu(), to_uint8(render(view))]
        self.send_image(f"val/{view.name}", torch.cat(sides, 1).numpy(), step)

    @hookimpl
    def crossgrad_run_end(self, status: str) -> None:
        """Close the record."""
        self._attempt(partial(self.close, status))
        self._run = None

    def _attempt(self, action: Callable[[], None]) -> None:
        """Call a function; after a failure, report it and send nothing more."""
        if self._run is None:
            return
        try:
            action()
        except Exception as error:  # Packages and networks may raise anything.
            self._run = None
            text = " ".join(f"{type(error).__name__}: {error}".split())
            _LOG.warning("observer %s records nothing more: %s", self.package, text)

    @abstractmethod
    def open(self, run: RunInfo) -> None:
        """Open the record of a run that has a folder."""

    @abstractmethod
    def send(self, numbers: dict[str, float], step: int) -> None:
        """Send numbers by tag."""

    @abstractmethod
    def send_image(self, tag: str, image: NDArray[np.uint8], step: int) -> None:
        """Send an image [H, W, 3]."""

    @abstractmethod
    def close(self, status: str) -> None:
        """Close the record of a run that ended as `status`."""
