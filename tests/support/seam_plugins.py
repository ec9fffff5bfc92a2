"""Small plugins that use the contracts of the training seams for real."""

import torch

from crossgrad_core.plugin import (
    Compared,
    Exposure,
    Field,
    Figure,
    LearningRate,
    Loss,
    Metric,
    PerPhoto,
    PixelContext,
    Resolution,
    hookimpl,
    photometric_loss,
)


class NearAtHalf(Resolution):
    """Near photos at half scale, but every fifth step, whose views are all at full size."""

    def scales(self, context, state):
        if context.step % 5 == 0:
            return (1.0,) * len(context.views), state
        return tuple(0.5 if view.regime == "near" else 1.0 for view in context.views), state


class GainPerPhoto(Exposure):
    """One gain per photo, in stops, whose mean over the photos stays zero."""

    lr: float = Field(0.05, gt=0, description="learning rate, stops")

    def per_photo(self, scene):
        return {"stops": PerPhoto(torch.zeros(len(scene.train_views)), LearningRate(self.lr))}

    def exposed(self, image, values):
        return image * torch.exp2(values["stops"])

    def projected(self, values):
        return {"stops": values["stops"] - values["stops"].mean()}


class CentreWeighted(Loss):
    """L1 and SSIM, weighted by what plugins say and by its own hook: the centre counts more."""

    def loss(self, render, photo, mask, weights):
        return photometric_loss(render, photo, mask, 0.2, weights)

    @hookimpl
    def crossgrad_pixel_weights(self, context: PixelContext):
        rows = torch.linspace(-1, 1, context.camera.height)[:, None]
        columns = torch.linspace(-1, 1, context.camera.width)[None, :]
        return torch.exp(-(rows**2 + columns**2))


class BrightnessError(Metric):
    """How much brighter the render is than the photo, grey levels."""

    figure = Figure("psnr_cc", "brightness", form=".1f", per_regime=True, definition="mean error")

    def measure(self, compared: Compared):
        difference = compared.render.float() - compared.photo.float()
        if compared.mask is not None:
            difference = difference[compared.mask]
        return float(difference.mean()) if difference.numel() else None
