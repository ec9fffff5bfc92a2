"""Small plugins that use the contracts of the training hooks for real."""

import torch

from crossgrad_core.plugin import (
    NO_EDIT,
    Compared,
    Densifier,
    Edit,
    Exposure,
    Field,
    Figure,
    LearningRate,
    Loss,
    Metric,
    PerPhoto,
    PixelContext,
    PluginState,
    Resolution,
    Sampler,
    ViewSample,
    hookimpl,
)
from crossgrad_plugins.losses.l1_ssim import photometric_loss


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

    def apply(self, image, values):
        return image * torch.exp2(values["stops"])

    def project(self, values):
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


class PrunesTheUnseen(Densifier):
    """At each edit, prunes what no pixel of two extra renders shows; half of it at most."""

    def densify(self, context, state):
        if not context.schedule.densifies(context.step):
            return NO_EDIT, state
        seen = torch.zeros(context.parameters["means"].shape[0], dtype=torch.bool)
        views = context.rng.choice(len(context.scene.train_views), 2, replace=False)
        losses = []
        for view in views:
            with torch.no_grad():
                drawn = context.render(int(view), 0.5, frozenset({"pixels"}))
            seen |= drawn.render.screen.pixels > 0
            losses.append(float(drawn.loss))
        kept = seen | (torch.arange(len(seen)) % 2 == 0)
        told = [*state.values.get("losses", []), losses]
        return Edit(source=kept.nonzero().squeeze(1)), PluginState({"losses": told})


class OneThenTwo(Sampler):
    """One view in every odd step, two in every even one."""

    default_views = 2

    def counts(self, views):
        return frozenset({1, views})

    def sample(self, context, state):
        count = context.views_per_step if context.step % 2 == 0 else 1
        drawn = context.rng.choice(len(context.centers), count, replace=False)
        labels = None if context.groups is None else tuple(context.groups[view] for view in drawn)
        return ViewSample(tuple(int(view) for view in drawn), labels), state


class BrightnessError(Metric):
    """How much brighter the render is than the photo, grey levels."""

    figure = Figure("psnr_cc", "brightness", form=".1f", per_regime=True, definition="mean error")

    def measure(self, compared: Compared):
        difference = compared.render.float() - compared.photo.float()
        if compared.mask is not None:
            difference = difference[compared.mask]
        return float(difference.mean()) if difference.numel() else None
