"""A file of Gaussians that is drawn instead of the model of a run."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from torch import Tensor

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Camera, View
from crossgrad_core.registry.entries import find, resolve_entry
from crossgrad_core.registry.file_formats import exporter_for
from crossgrad_core.registry.slots import VIEWERS
from crossgrad_core.run.export import check_frame, plain_drawer
from crossgrad_core.system.checksums import warn_if_changed
from crossgrad_core.training.per_image_params import apply
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

#: A function that returns the image [H, W, 3] of Gaussians on black.
Viewer = Callable[[Gaussians, Camera], Tensor]


@dataclass(frozen=True)
class DrawnFile:
    """A file of Gaussians, and the rules by which it is drawn.

    Attributes:
        path: The file, in the coordinates of the scene's input; any program may have written it.
        viewer: Name of the program whose rules are followed; None for the rules of the run.
    """

    path: Path
    viewer: str | None = None

    @property
    def manner(self) -> str:
        """The rules by which the file is drawn, for a message."""
        return "as viewers do" if self.viewer is None else f"by the rules of {self.viewer}"

    def gaussians(self, setup: Setup) -> Gaussians:
        """Return the Gaussians of the file in the local frame of a run's scene.

        Raises:
            UserError: The file cannot be read, or its name shows no format of Gaussians.
        """
        exporter = exporter_for(self.path, "--file")
        check_frame(self.path)
        warn_if_changed(self.path)
        return exporter.read(self.path, setup.scene.similarity)

    def drawer(
        self, setup: Setup, gaussians: Gaussians, state: TrainState | None
    ) -> Callable[[View], Tensor]:
        """Return a function that renders the Gaussians for a view, on black.

        Args:
            setup: The run.
            gaussians: The Gaussians of the file.
            state: The state whose exposures are applied; None applies no exposure.

        Raises:
            UserError: There is no viewer of that name.
        """
        plain = plain_drawer(setup, gaussians)
        if self.viewer is not None:
            viewer = cast("Viewer", resolve_entry(find(VIEWERS, self.viewer)))
            moved = gaussians.mapped(lambda tensor: tensor.to(setup.device))
            plain = lambda view: viewer(moved, view.camera)  # noqa: E731
        if state is None:
            return plain
        return lambda view: apply(setup, state, view, plain(view))
