"""Photos reduced by an area filter, in a cache of limited memory."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from threading import Event, Thread

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.contract.scene import Camera, Scene, View

#: A photo [H, W, 3] uint8, and its mask [H, W] bool (None if all pixels are valid).
Pair = tuple[Tensor, Tensor | None]
#: Width and height in pixels.
_Size = tuple[int, int]


class ScaledPhotos:
    """A cache of reduced photos.

    The cache stores the last requested size of each photo, and a copy from which nearby sizes are
    made.

    The copy is halved repeatedly, but is at least as large as the requested size. If the requested
    size changes in small steps, the halved copy is made only once.

    Args:
        mib: Memory for reduced photos, in MiB. Photos that do not fit are computed again for each
            step.
    """

    def __init__(self, mib: int) -> None:
        self._room = mib * 2**20
        self._kept: dict[str, dict[_Size, Pair]] = {}

    def holds(self, view: View, camera: Camera) -> bool:
        """Return True if the photo in the camera's size can be made without the full-size photo."""
        kept = self._kept.get(view.name, {})
        return any(size in kept for size in _sizes(view.camera, camera))

    def get(self, view: View, camera: Camera, full: Callable[[View], Pair]) -> Pair:
        """Return the photo and the mask of a view in the camera's size.

        The cache shares the photo and the mask with its callers, so callers must not change them.

        Args:
            view: The view.
            camera: A camera whose image is at most as large as the image of the view's camera.
            full: Function that returns the full-size photo and mask of a view.
        """
        sizes, before = _sizes(view.camera, camera), self._kept.pop(view.name, {})
        self._room += _bytes(before)
        made = {size: before[size] for size in sizes if size in before}
        smallest = next(reversed(made), None)
        pair = full(view) if smallest is None else made[smallest]
        for size in sizes[0 if smallest is None else sizes.index(smallest) + 1 :]:
            pair = made[size] = reduced(*pair, *size)
        if made and _bytes(made) <= self._room:
            self._kept[view.name] = made
            self._room -= _bytes(made)
        return pair


class DevicePhotos:
    """A cache of photos on a GPU as uint8: for each view, the photo in the last requested size.

    Args:
        scaled: The cache of reduced photos in host memory.
        device: The GPU.
        mib: GPU memory for photos, in MiB. Photos that do not fit are copied to the GPU again for
            each step.
    """

    def __init__(self, scaled: ScaledPhotos, device: torch.device, mib: int) -> None:
        self._scaled, self._device = scaled, device
        self._room = mib * 2**20
        self._kept: dict[str, tuple[_Size, Pair]] = {}

    def holds(self, view: View, camera: Camera) -> bool:
        """Return True if the photo is cached on the GPU, or if `ScaledPhotos.holds` is True."""
        held = self._kept.get(view.name)
        here = held is not None and held[0] == (camera.width, camera.height)
        return here or self._scaled.holds(view, camera)

    def get(self, view: View, camera: Camera, full: Callable[[View], Pair]) -> Pair:
        """Return the photo and the mask of a view on the GPU, in the camera's size.

        `full` returns photo and mask in host memory and full size.
        """
        size = camera.width, camera.height
        held = self._kept.get(view.name)
        if held is not None and held[0] == size:
            return held[1]
        if held is not None:
            del self._kept[view.name]
            self._room += _bytes({size: held[1]})
        pair = on_device(self._scaled.get(view, camera, full), self._device)
        if _bytes({size: pair}) <= self._room:
            self._kept[view.name] = size, pair
            self._room -= _bytes({size: pair})
        return pair


def on_device(pair: Pair, device: torch.device) -> Pair:
    """Return a photo and its mask on a device."""
    image, mask = pair
    moved = None if mask is None else mask.to(device, non_blocking=True)
    return image.to(device, non_blocking=True), moved


def _sizes(full: Camera, wanted: Camera) -> list[_Size]:
    """Return the sizes to compute, from the largest to the wanted size.

    The full size is not included.

    One intermediate size is possible: the smallest halved size that is not below the wanted size. A
    wanted size that is itself a halved size is made directly from the full photo. The result
    therefore does not depend on earlier requests.
    """
    halved, size = (full.width, full.height), (full.width, full.height)
    wanted_size = (wanted.width, wanted.height)
    while size[0] >= wanted.width and size[1] >= wanted.height and halved != wanted_size:
        halved, size = size, ((size[0] + 1) // 2, (size[1] + 1) // 2)
    sizes = dict.fromkeys([halved, wanted_size])
    return [size for size in sizes if size != (full.width, full.height)]


def _bytes(made: dict[_Size, Pair]) -> int:
    return sum(tensor.nbytes for pair in made.values() for tensor in pair if tensor is not None)


def reduced(image: Tensor, mask: Tensor | None, width: int, height: int) -> Pair:
    """Return image and mask reduced by area. Each new pixel is the mean of an area of the image.

    Masked pixels are left out of the means. A new pixel is valid if at least half of its area is
    valid. A single thread computes all sums in a fixed order, so that the result is repeatable.

    Args:
        image: [H, W, 3] uint8 photo.
        mask: [H, W] bool, True for valid pixels; None if all pixels are valid.
        width: New width, at most W.
        height: New height, at most H.
    """
    from crossgrad_core.training.numba_kernels.areas import reduce_by_area

    kept = np.empty((0, 0), np.bool_) if mask is None else mask.cpu().contiguous().numpy()
    rows = image.cpu().contiguous().numpy().reshape(image.shape[0], -1)
    small, counts = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.bool_)
    reduce_by_area(rows, kept, small, counts)
    small_image = torch.from_numpy(small).to(image.device)
    return small_image, None if counts.all() else torch.from_numpy(counts).to(image.device)


@contextmanager
def decoded_meanwhile(scene: Scene) -> Iterator[None]:
    """Decode the scene's photos in a thread while the block runs.

    Held-out photos are decoded first.

    Decoded photos stay in the photo cache if the cache is large enough. A photo that cannot be
    decoded is skipped here. The next access to the photo raises the error.
    """
    over = Event()
    thread = Thread(target=_decode, args=(scene, over), name="crossgrad-photos", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _decode(scene: Scene, over: Event) -> None:
    for view in (*scene.test_views, *scene.train_views):
        if over.is_set():
            return
        with suppress(Exception):
            view.photo.image()
