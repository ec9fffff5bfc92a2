"""The exposure slot: a component models the camera's exposure of each photo."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from crossgrad_core.contract.blocks import LearningRate
from crossgrad_core.contract.component import Component
from crossgrad_core.contract.scene import Scene, View


@dataclass(frozen=True, eq=False)
class PerPhoto:
    """A parameter with one value per training photo.

    Attributes:
        start: [P, ...] float32, the initial values in the order of `scene.train_views`; or a
            function that computes the values, if the computation takes long. A resumed run does not
            call this function.
        lr: Learning rate of the parameter.
    """

    start: Tensor | Callable[[], Tensor]
    lr: LearningRate

    def first(self) -> Tensor:
        """Return the initial values."""
        return self.start if isinstance(self.start, Tensor) else self.start()


@dataclass(frozen=True)
class Fitted:
    """The exposure that was chosen for a scene, with the reasons.

    Attributes:
        exposure: The exposure that the run uses.
        name: Installed name of `exposure`; None if the run uses the configured exposure.
        notes: The decision on the exposure, and the evidence for it.
    """

    exposure: "Exposure"
    name: str | None = None
    notes: tuple[str, ...] = ()


class Exposure(Component):
    """A model that turns a render into the image that the camera of one photo would have taken.

    The parameters of an exposure belong to photos, not to the scene, so operators do not receive
    their gradients. After each step, the values of each photo in this step are updated by a
    separate Adam step with its own step count. The separate step is the same for any number of
    views and every backbone. After the separate step, `project` limits the values of all photos.
    Checkpoints contain the values.
    """

    slot: ClassVar[str] = "exposures"

    def fitted_to(self, scene: Scene) -> Fitted:
        """Return the exposure that was chosen for the scene; by default this exposure.

        The result is written to config.yaml, and a resumed run uses the stored exposure.
        """
        return Fitted(self)

    def messages(self, scene: Scene, known: Mapping[str, Tensor]) -> tuple[str, ...]:
        """Return messages about this exposure and the scene; called for new runs only.

        `known` contains the initial values [P, ...] by name if the user gives a file; else it is
        empty.
        """
        return ()

    def per_photo(self, scene: Scene) -> Mapping[str, PerPhoto]:
        """Return the parameters by name; by default there are none."""
        return {}

    @abstractmethod
    def apply(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        """Return the exposed image, differentiable in the render and in the values.

        Args:
            image: [H, W, 3] the render, of any size and not clamped.
            values: Name -> the photo's own value [...], on the image's device.
        """

    def project(self, values: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
        """Return all values [P, ...] after a step, projected to their valid range.

        By default the values are returned unchanged. For example, gains projected to a mean of zero
        do not change the brightness of the scene.
        """
        return values

    def shift(self, name: str, values: Tensor, start: Tensor, end: Tensor) -> Tensor:
        """Return the values [P, ...] of a parameter, shifted by the change from `start` to `end`.

        By default `end - start` is added to every value, so the differences between photos do not
        change. The shift adapts the values of all photos to values that the user gives in a file.
        """
        return values + (end - start)

    def predict_unseen(
        self, view: View, scene: Scene, values: Mapping[str, Tensor]
    ) -> Mapping[str, Tensor]:
        """Return the exposure values of a view without a training photo; do not read its pixels.

        By default, each value is the mean over the training photos of the view's regime. If the
        regime contains no training photo, the mean is over all training photos.

        Args:
            view: The view.
            scene: The scene.
            values: Name -> values [P, ...] of the training photos.
        """
        regimes = [photo.regime for photo in scene.train_views]
        rows = [row for row, regime in enumerate(regimes) if regime == view.regime]
        return {name: of_all[rows or slice(None)].mean(dim=0) for name, of_all in values.items()}
