"""Photos in a smaller size, by an area filter, in a bounded amount of memory."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from threading import Event, Thread

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.contract.scene import Camera, Scene, View

#: Photo [H, W, 3] uint8 and mask [H, W] bool, None where every pixel counts.
Pair = tuple[Tensor, Tensor | None]
#: Width and height, pixels.
_Size = tuple[int, int]


class ScaledPhotos:
    """Reduced photos: of each view the size that was asked for last, and what it was made from.

    That is the photo, halved as often as it stays larger than what was asked for: where the size
    changes step by step, most of the work is done once.

    Args:
        mib: Memory in MiB; what does not fit is made again.
    """

    def __init__(self, mib: int) -> None:
        self._room = mib * 2**20
        self._kept: dict[str, dict[_Size, Pair]] = {}

    def holds(self, view: View, camera: Camera) -> bool:
        """Whether a photo in the size of a camera can be had without the view's own."""
        kept = self._kept.get(view.name, {})
        return any(size in kept for size in _sizes(view.camera, camera))

    def get(self, view: View, camera: Camera, full: Callable[[View], Pair]) -> Pair:
        """The photo and mask of a view in the size of a camera; shared, so never to be written to.

        Args:
            view: The view.
            camera: At most as large as the view's own.
            full: Gives the photo and the mask as trained.
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
    """Photos on a GPU, as uint8: of each view the size that was asked for last.

    Args:
        scaled: Makes the photos, in the machine's memory.
        device: The GPU.
        mib: Its memory for them in MiB; what does not fit is copied there again for each step.
    """

    def __init__(self, scaled: ScaledPhotos, device: torch.device, mib: int) -> None:
        self._scaled, self._device = scaled, device
        self._room = mib * 2**20
        self._kept: dict[str, tuple[_Size, Pair]] = {}

    def holds(self, view: View, camera: Camera) -> bool:
        """See `ScaledPhotos.holds`."""
        held = self._kept.get(view.name)
        here = held is not None and held[0] == (camera.width, camera.height)
        return here or self._scaled.holds(view, camera)

    def get(self, view: View, camera: Camera, full: Callable[[View], Pair]) -> Pair:
        """See `ScaledPhotos.get`; `full` gives the photo in the machine's memory."""
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
    """A photo and its mask on a device."""
    image, mask = pair
    moved = None if mask is None else mask.to(device, non_blocking=True)
    return image.to(device, non_blocking=True), moved


def _sizes(full: Camera, wanted: Camera) -> list[_Size]:
    """The sizes from the full one, left out, down to the wanted one.

    At most one lies between them: the smallest of the halved sizes that is not below what is
    wanted. A halved size that is itself wanted is made from the photo too, so that it is the same
    whatever it was made for.
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
    """Image and mask averaged by area: each new pixel is the mean of what it covers.

    Pixels that do not count are left out of the means; a new pixel counts where at least half of
    what it covers does. One thread does it in a fixed order, so that no bit depends on threads.

    Args:
        image: [H, W, 3] uint8.
        mask: [H, W] bool, or None.
        width: At most W.
        height: At most H.
    """
    from crossgrad_core.training.numba_kernels.areas import reduce_by_area

    kept = np.empty((0, 0), np.bool_) if mask is None else mask.cpu().contiguous().numpy()
    rows = image.cpu().contiguous().numpy().reshape(image.shape[0], -1)
    small, counts = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.bool_)
    reduce_by_area(rows, kept, small, counts)
    found = torch.from_numpy(small).to(image.device)
    return found, None if counts.all() else torch.from_numpy(counts).to(image.device)


@contextmanager
def decoded_meanwhile(scene: Scene) -> Iterator[None]:
    """Decodes the scene's photos in a thread as long as the block runs, the held-out ones first.

    They stay where decoded photos are kept, as far as there is room. A photo that cannot be decoded
    is left alone; the next access to it raises the error.
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
