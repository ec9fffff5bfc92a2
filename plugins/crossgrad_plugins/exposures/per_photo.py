"""Base class of exposures with values per photo: start, learning rates, held-out photos."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Exposure, LearningRate, PerPhoto, Scene, Selection, View
from crossgrad_plugins.exposures.exif import exposure_values
from crossgrad_plugins.exposures.initial_values import Start, neighbours_of, outliers, starts_of


class ExposurePerPhoto(Exposure):
    """An exposure with one parameter that has a value for every training photo.

    The initial values follow from SfM tracks or EXIF; the values have separate learning rates. The
    mean of the values over the training photos is kept neutral, so that brightness and colours of
    the scene do not drift.

    Attributes:
        parameter: Name of the parameter.
    """

    parameter: ClassVar[str]

    rate: float = Field(
        0.002, ge=0, description="learning rate at the start of the run; 0 keeps the initial values"
    )
    decay: float = Field(0.01, gt=0, le=1, description="factor of the learning rate at the end")
    start: Start = Field(
        "auto",
        description="initial values: tracks (SfM observations), exif, none (neutral), or auto: "
        "tracks, else EXIF",
    )

    @abstractmethod
    def of_stops(self, stops: Tensor) -> Tensor:
        """Return the values [..., V] that correspond to gains of so many stops [...]."""

    @abstractmethod
    def in_stops(self, values: Tensor) -> Tensor:
        """Return the stops [...] or [..., 3] by which values [..., V] brighten white."""

    @abstractmethod
    def beside(self, values: Tensor, stops: Tensor) -> Tensor:
        """Return the values [P, V] of photos that are brighter than `values` by stops [P]."""

    @abstractmethod
    def neutral(self) -> Tensor:
        """Return the neutral values, which are the mean over the training photos."""

    @override
    def per_photo(self, scene: Scene) -> Mapping[str, PerPhoto]:
        def start() -> Tensor:
            stops = torch.from_numpy(starts_of(scene, self.start).stops)
            return self._centred(self.of_stops(stops))

        return {self.parameter: PerPhoto(start, LearningRate(self.rate, self.rate * self.decay))}

    @override
    def messages(self, scene: Scene, known: Mapping[str, Tensor]) -> tuple[str, ...]:
        if not known:
            return starts_of(scene, self.start).messages
        names = [view.name for view in scene.train_views]
        stops = self.in_stops(known[self.parameter]).abs().reshape(len(names), -1)
        return tuple(outliers(names, stops.amax(dim=1).tolist()))

    @override
    def project(self, values: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
        return {name: self._centred(value.double()) for name, value in values.items()}

    def _centred(self, values: Tensor) -> Tensor:
        """Shift the values [P, V] to a neutral mean in float64; return them in float32."""
        neutral = self.neutral().to(values, non_blocking=True)
        return self.shift(self.parameter, values, values.mean(dim=0), neutral).float()

    @override
    def predict_unseen(
        self, view: View, scene: Scene, values: Mapping[str, Tensor]
    ) -> Mapping[str, Tensor]:
        """Predict the values of a photo that was not trained.

        EXIF data are used if this photo and the training photos have them; else neighbours or the
        regime. Neighbours are the training photos nearest in pose. Neighbours are used if they
        predict each other better than the mean of a regime does.
        """
        exif = exposure_values(scene)
        trained = values[self.parameter]
        rows = [row for row, photo in enumerate(scene.train_views) if photo.name in exif]
        if view.name in exif and rows:
            # Use only photos of the same regime, because regimes are often taken with different
            # sensors.
            rows = [row for row in rows if scene.train_views[row].regime == view.regime] or rows
            stops = [exif[view.name] - exif[scene.train_views[row].name] for row in rows]
            shift = self.beside(trained[rows], torch.tensor(stops).to(trained))
            return {self.parameter: shift.mean(dim=0)}
        neighbours = neighbours_of(scene)
        if not neighbours.tell(trained.detach().cpu().double().reshape(len(trained), -1).numpy()):
            return super().predict_unseen(view, scene, values)
        near, weights = neighbours.rows_and_weights(view.camera)
        shares = torch.from_numpy(weights).to(trained)
        return {self.parameter: torch.tensordot(shares, trained[torch.from_numpy(near)], dims=1)}

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Report `decay` as unused if the learning rate is 0."""
        if self.rate:
            return {}
        return {"decay": "exposure.rate is 0: the values do not change"}
