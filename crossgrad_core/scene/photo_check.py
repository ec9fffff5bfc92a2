"""Decoding every photo once, early: a damaged one is found before it costs training."""

import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from threading import Event, Thread, get_native_id

from crossgrad_core.contract.scene import Scene, View
from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos import FilePhoto
from crossgrad_core.scene.wording import name_some

_LOG = logging.getLogger(__name__)
#: Photos that are decoded at once before training; more of them would take memory.
_AT_ONCE = 2
#: Seconds that the end of a run waits for the photo that is being decoded beside it.
_PATIENCE = 5.0
_LEAST_URGENT = 19


def fits(scene: Scene, mib: int) -> bool:
    """Whether all decoded photos of a scene fit into so much memory: then none is decoded twice."""
    pixels = sum(view.camera.width * view.camera.height for view in scene.views)
    return 4 * pixels <= mib * 2**20  # RGB and a mask


def check_photos(views: Sequence[View], *, keep: bool) -> None:
    """Decodes the photos and masks of some views.

    Args:
        views: The views.
        keep: Whether there is room to keep what is decoded; else it is only tried whether files can
            be decoded, JPEG files at an eighth of their size.

    Raises:
        UserError: Some cannot be decoded; names them.
    """
    if not views:
        return
    _LOG.info("decoding %d held-out photos", len(views))
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        errors = [e for e in pool.map(lambda view: _error_of(view, keep=keep), views) if e]
    if len(errors) > 1:
        raise UserError(
            f"{len(errors)} held-out photos cannot be decoded",
            where=name_some([error.where for error in errors]),
            found=errors[0].found,
            todo=errors[0].todo,
        ) from errors[0]
    if errors:
        raise errors[0]


@contextmanager
def checked_meanwhile(
    views: Sequence[View], report: Callable[[Exception], None], *, keep: bool
) -> Iterator[None]:
    """Decodes the photos of some views beside the block, one after the other.

    Args:
        views: The views.
        report: Told the first error, from another thread; nothing is decoded after it.
        keep: As in `check_photos`.
    """
    over = Event()

    def check() -> None:
        _give_way()
        for view in views:
            if over.is_set():
                return
            try:
                _decode(view, keep=keep)
            except MemoryError:
                return  # Training needs it more.
            except Exception as error:  # Third-party photos may raise anything.
                report(error)
                return

    thread = Thread(target=check, name="crossgrad-photos", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(_PATIENCE)


def _error_of(view: View, *, keep: bool) -> UserError | None:
    try:
        _decode(view, keep=keep)
    except UserError as error:
        return error
    return None


def _decode(view: View, *, keep: bool) -> None:
    photo = view.photo
    if keep or not isinstance(photo, FilePhoto):
        photo.image()
        photo.mask()
    else:
        photo.source.try_out()


def _give_way() -> None:
    """Lets training have the processor, where a thread can have a priority of its own."""
    if sys.platform == "linux":
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, get_native_id(), _LEAST_URGENT)
