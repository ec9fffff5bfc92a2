"""Targets of the views of a step: cameras, photos, weights of pixels, backgrounds."""

from dataclasses import dataclass
from functools import partial, reduce
from math import inf
from time import perf_counter, thread_time
from typing import Any

import numpy as np
import torch
from pluggy import HookCaller
from torch import Tensor

from crossgrad_core.contract.contexts import PixelContext
from crossgrad_core.contract.scene import Camera, View
from crossgrad_core.errors import UserError
from crossgrad_core.training.scaled_photos import Pair, on_device
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.strided_rendering import camera_of, corner_of, pixels_of, stride_of
from crossgrad_core.wording import listed


@dataclass(frozen=True, eq=False)
class Target:
    """The camera of a render of a view, and the photo it is compared with.

    Attributes:
        camera: The camera to render with.
        scale: Its sides over those of the view's own.
        photo: [H, W, 3] uint8.
        mask: [H, W] bool; None where every pixel counts.
        stride: n where it is one pixel of each n x n of the photo.
    """

    camera: Camera
    scale: float
    photo: Tensor
    mask: Tensor | None
    stride: int = 1


def target_at(setup: Setup, state: TrainState, index: int, scale: float, slot: int = 0) -> Target:
    """Camera and photo of a training view at a scale in (0, 1].

    Args:
        setup: The run.
        state: Its state.
        index: The training view.
        scale: The scale.
        slot: The place of the view in the draw, which has a part in the lot that decides on the
            pixels of an strided view.
    """
    view = setup.train_views[index]
    stride, camera = _stride_at(setup, view, scale), photo_camera(setup, view, scale)
    pair = setup.scaled_photos.get(view, camera, partial(_decoded, state))
    if stride > 1:
        corner = corner_of(state.step, slot, stride)
        camera, pair = camera_of(camera, stride, corner), pixels_of(pair, stride, corner)
    return Target(camera, scale, *pair, stride)


def photo_camera(setup: Setup, view: View, scale: float) -> Camera:
    """The camera of the photo that a view of that scale takes its pixels from."""
    return view.camera if _stride_at(setup, view, scale) > 1 else camera_at(view.camera, scale)


def _stride_at(setup: Setup, view: View, scale: float) -> int:
    return stride_of(scale, view.camera) if setup.selection.resolution.strided else 1


def weights_of(setup: Setup, state: TrainState, index: int, target: Target) -> Tensor | None:
    """[H, W], how much each pixel counts; None where all count alike."""
    if not setup.weighs:
        return None
    context = PixelContext(
        **context_fields(setup, state, "regularize"),
        index=index,
        view=setup.train_views[index],
        camera=target.camera,
        scale=target.scale,
        target=target.photo,
        mask=target.mask,
    )
    hook = setup.hook.crossgrad_pixel_weights
    factors: list[object] = hook(context=context)
    fitting = [_fitting(each, context, hook) for each in factors]
    return reduce(torch.mul, fitting) if fitting else None


def _fitting(weights: object, context: PixelContext, hook: HookCaller) -> Tensor:
    """Pixel weights, if a loss can use them; of a GPU, which would be waited for, their shape."""
    shape = context.target.shape[:2]
    found, least = type(weights).__name__, ""
    if isinstance(weights, Tensor):
        found = f"{list(weights.shape)} of {weights.dtype}"
        if weights.shape == shape and weights.is_floating_point():
            if not weights.is_cpu or bool(((weights >= 0) & (weights < inf)).all()):
                return weights
            least = f", the least {float(weights.min()):g}"
    who = listed(each.plugin_name for each in hook.get_hookimpls())
    raise UserError(
        "a plugin weighs pixels in a way that no loss can use",
        where=f"hook crossgrad_pixel_weights of {who}, photo {context.view.name}",
        expected=f"finite numbers of 0 or more, floating point, {list(shape)}",
        found=f"{found}{least}",
        todo="repair the plugin, or run without it",
    )


def camera_at(camera: Camera, scale: float) -> Camera:
    """The camera in `scale` times its size, rounded to whole pixels; itself at scale 1."""
    width = max(1, round(camera.width * scale))
    height = max(1, round(camera.height * scale))
    if (width, height) == (camera.width, camera.height):
        return camera
    return camera.resized(width, height)


def context_fields(setup: Setup, state: TrainState, stream: str) -> dict[str, Any]:
    """The fields that the contexts of all hooks of a step share."""
    return {
        "step": state.step,
        "schedule": setup.schedule,
        "scene": setup.scene,
        "states": state.states,
        "rng": state.rngs[stream],
        "photo": partial(photo_of, setup, state),
    }


def photo_of(setup: Setup, state: TrainState, view: View) -> Pair:
    """The decoded photo and mask of a view on the run's device; decoding counts as loading."""
    return on_device(_decoded(state, view), setup.device)


def _decoded(state: TrainState, view: View) -> Pair:
    """The decoded photo and mask of a view in the machine's memory, where they are decoded."""
    start, cpu = perf_counter(), thread_time()
    image, mask = view.photo.image(), view.photo.mask()
    seconds = perf_counter() - start
    state.clock.load += seconds
    state.laps.leave_out(seconds, thread_time() - cpu)
    return image, mask


def background_of(setup: Setup, state: TrainState) -> Tensor:
    """[3] RGB that the next training view is drawn over."""
    if setup.config.background == "random":
        rgb = state.rngs["background"].random(3).astype(np.float32)
        return torch.from_numpy(rgb).to(setup.device, non_blocking=True)
    return eval_background(setup)


def eval_background(setup: Setup) -> Tensor:
    """[3] RGB that evaluated views are drawn over: the run's own, black where that is random."""
    name = setup.config.background
    named = {"black": (0.0, 0.0, 0.0), "random": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
    rgb = named[name] if name in named else tuple(float(part) for part in name.split(","))
    return torch.tensor(rgb, dtype=torch.float32).to(setup.device, non_blocking=True)
