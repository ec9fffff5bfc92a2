"""An exposure with one gain per photo."""

from collections.abc import Mapping

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Exposure, Field, LearningRate, PerPhoto, Scene


class Gain(Exposure):
    """An exposure that multiplies the render by 2^stops; the mean of all stops is zero."""

    lr: float = Field(0.01, gt=0, description="learning rate, stops")

    @override
    def per_photo(self, scene: Scene) -> Mapping[str, PerPhoto]:
        start = torch.zeros(len(scene.train_views))
        return {"stops": PerPhoto(start, LearningRate(self.lr))}

    @override
    def apply(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        return image * torch.exp2(values["stops"])

    @override
    def project(self, values: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
        return {"stops": values["stops"] - values["stops"].mean()}
