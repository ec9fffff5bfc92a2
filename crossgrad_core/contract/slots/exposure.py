"""The exposure slot: what a camera does to light between the render and its photo."""

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
    """A parameter that every training photo has a value of.

    Attributes:
        start: [P, ...] float32, the values at the start, in the order of `scene.train_views`; or
            what works them out, where that takes long: a run that goes on does not ask.
        lr: Its learning rate.
    """

    start: Tensor | Callable[[], Tensor]
    lr: LearningRate

    def first(self) -> Tensor:
        """The values at the start."""
        return self.start if isinstance(self.start, Tensor) else self.start()


@dataclass(frozen=True)
class Fitted:
    """The exposure that a scene calls for, and why.

    Attributes:
        exposure: The exposure that the run takes.
        name: The name under which that one is installed; None where it is the one that was asked.
        notes: What was decided, and on what evidence.
    """

    exposure: "Exposure"
    name: str | None = None
    notes: tuple[str, ...] = ()


class Exposure(Component):
    """Makes of a render the image that the camera of one photo would have taken.

    Its parameters belong to photos, not to the scene: no operator sees their gradients. After each
    step the photos of that step take a step of Adam of their own, with their own count, for any
    number of views and every backbone; then all values are projected. They are part of checkpoints.
    """

    slot: ClassVar[str] = "exposures"

    def fitted_to(self, scene: Scene) -> Fitted:
        """The exposure that the scene calls for; by default this one.

        What a run takes is written to its config.yaml, so a run that goes on asks that one.
        """
        return Fitted(self)

    def messages(self, scene: Scene, known: Mapping[str, Tensor]) -> tuple[str, ...]:
        """What the user should know about this exposure and the scene; asked of new runs only.

        `known` are the values [P, ...] at the start by name, if the user has a file; else empty.
        """
        return ()

    def per_photo(self, scene: Scene) -> Mapping[str, PerPhoto]:
        """The parameters by name; by default there are none."""
        return {}

    @abstractmethod
    def apply(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        """The image as taken, differentiable in the render and in the values.

        Args:
            image: [H, W, 3] the render, of any size and not clamped.
            values: Name -> the photo's own value [...], on the image's device.
        """

    def project(self, values: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
        """All values [P, ...] after a step, brought back to where they must be.

        By default as they are. Gains that are brought back to a mean of zero, say, leave the
        scene its own brightness.
        """
        return values

    def shift(self, name: str, values: Tensor, start: Tensor, end: Tensor) -> Tensor:
        """The values [P, ...] of a parameter, all moved by what makes `end` of `start`.

        By default by a sum. What photos differ by stays, at whatever level a file has them.
        """
        return values + (end - start)

    def predict_unseen(
        self, view: View, scene: Scene, values: Mapping[str, Tensor]
    ) -> Mapping[str, Tensor]:
        """The values of a view that is not trained on, without a look at its pixels.

        By default the mean over the training photos of its regime, over all where it has none.

        Args:
            view: The view.
            scene: The scene.
            values: Name -> [P, ...] of the training photos.
        """
        regimes = [each.regime for each in scene.train_views]
        rows = [row for row, regime in enumerate(regimes) if regime == view.regime]
        return {name: each[rows or slice(None)].mean(dim=0) for name, each in values.items()}
