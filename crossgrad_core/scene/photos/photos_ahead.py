"""Threads that decode photos before a step needs them, and a check that decodes each photo once."""

import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from threading import Condition, Thread, get_native_id
from time import thread_time

from crossgrad_core.contract.scene import Scene, View
from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos.photos import FilePhoto
from crossgrad_core.scene.wording import name_some

#: Number of photos that are decoded in parallel. A larger number would need more memory.
AT_ONCE = 2
#: Seconds that the end of a run waits for photos that are still being decoded.
_PATIENCE = 5.0
_LEAST_URGENT = 19
_LOG = logging.getLogger(__name__)


class PhotosAhead:
    """Background threads that decode the photos of the next steps, and all other photos once.

    With enough cores, training never waits for a photo. A damaged photo is found early, before a
    step needs the photo. The order of decoding does not affect the results of a run.
    """

    def __init__(self) -> None:
        self._changed = Condition()
        self._expected: list[FilePhoto] = []
        self._unseen: Iterator[View] = iter(())
        self._report: Callable[[Exception], None] = _ignore
        self._at_work = self._keep = False
        self._cpu = 0.0

    @contextmanager
    def at_work(
        self, views: Sequence[View], report: Callable[[Exception], None], *, keep: bool
    ) -> Iterator[None]:
        """Inside the block, decode photos in background threads.

        Args:
            views: All views of the scene. Each photo is decoded once, even if no step requests the
                photo.
            report: Function that another thread calls with the first error. After the error, the
                remaining photos are not decoded.
            keep: True if all decoded photos fit into memory. If False, photos of no announced view
                are only written to the disk cache, or only tested.
        """
        self._unseen, self._report, self._keep = iter(views), report, keep
        self._at_work = True
        threads = [Thread(target=self._work, name="crossgrad-photos", daemon=True) for _ in "ab"]
        for thread in threads:
            thread.start()
        try:
            yield
        finally:
            with self._changed:
                self._at_work = False
                self._changed.notify_all()
            for thread in threads:
                thread.join(_PATIENCE)

    @property
    def useful(self) -> bool:
        """True if announcing the next views can save time; False after all photos are in memory."""
        return self._at_work

    def expect(self, views: Sequence[View]) -> None:
        """Announce the next views, in the order in which steps use these views.

        The new list of views replaces all earlier announcements.
        """
        photos = [view.photo for view in views if isinstance(view.photo, FilePhoto)]
        if not photos:
            return
        cache, size, fitting = photos[0].cache, 0, list[FilePhoto]()
        for photo in photos:
            size += photo.source.decoded_bytes
            # Leave out further photos, because further photos would remove earlier photos from the
            # cache.
            if size <= cache.limit // 2:
                fitting.append(photo)
        cache.expect(photo.source for photo in fitting)
        with self._changed:
            self._expected = [photo for photo in fitting if not cache.holds(photo.source)]
            self._changed.notify_all()

    def taken_cpu(self) -> float:
        """Return the CPU seconds that the threads spent on decoding since the previous call."""
        with self._changed:
            taken, self._cpu = self._cpu, 0.0
        return taken

    def _work(self) -> None:
        _give_way()
        while (job := self._next()) is not None:
            begun = thread_time()
            job()
            with self._changed:
                self._cpu += thread_time() - begun

    def _next(self) -> Callable[[], None] | None:
        """Return the next job for a thread. Return None if no job is left."""
        with self._changed:
            while self._at_work:
                while self._expected:
                    photo = self._expected.pop(0)
                    if not photo.cache.holds(photo.source):
                        return partial(_get_quietly, photo)
                view = next(self._unseen, None)
                if view is not None:
                    return partial(self._see, view)
                if self._keep:
                    self._at_work = False  # All photos are in memory now.
                    self._changed.notify_all()
                else:
                    self._changed.wait()
        return None

    def _see(self, view: View) -> None:
        try:
            decode(view, keep=self._keep)
        except MemoryError:
            self._unseen = iter(())  # Stop decoding in advance, because training needs the memory.
        except Exception as error:  # The photos of a plugin may raise any exception.
            self._unseen = iter(())
            report, self._report = self._report, _ignore
            report(error)


def decode(view: View, *, keep: bool) -> None:
    """Decode a view's photo into memory.

    Without `keep`, decode the photo into the disk cache, or only test the photo.

    Raises:
        UserError: The photo cannot be decoded.
    """
    photo = view.photo
    if keep or not isinstance(photo, FilePhoto):
        photo.image()
        photo.mask()
    elif not photo.cache.prepare(photo.source):
        photo.source.try_out()


def _get_quietly(photo: FilePhoto) -> None:
    # The training step reports the error when it requests the photo later.
    with suppress(Exception):
        photo.cache.get(photo.source)


def _ignore(error: Exception) -> None:
    """Do nothing, because only the first error is reported."""


def _give_way() -> None:
    """Give this thread a lower priority than training, on systems with priorities for threads."""
    if sys.platform == "linux":
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, get_native_id(), _LEAST_URGENT)


def fits(scene: Scene, mib: int) -> bool:
    """Return True if all decoded photos of a scene fit into memory.

    If all decoded photos fit into memory, no photo is decoded twice.
    """
    pixels = sum(view.camera.width * view.camera.height for view in scene.views)
    return 4 * pixels <= mib * 2**20  # Three bytes for RGB, and one byte for a mask.


def check_photos(views: Sequence[View], *, keep: bool, whole: bool = False) -> None:
    """Decode the photos and masks of some views, to find damaged files.

    Args:
        views: The views whose photos are checked.
        keep: True if the memory suffices to keep the decoded photos.
        whole: True to decode all photos completely, even if the decoded photos cannot be kept in
            memory. If both `whole` and `keep` are False, files are only tested; JPEG files are
            decoded at an eighth of their size.

    Raises:
        UserError: Some photos cannot be decoded. The message names the photos.
    """
    if not views:
        return
    _LOG.info("decoding %d photos", len(views))
    with ThreadPoolExecutor(AT_ONCE) as pool:
        errors = [e for e in pool.map(lambda view: _error_of(view, keep, whole), views) if e]
    if len(errors) > 1:
        raise UserError(
            f"{len(errors)} photos cannot be decoded",
            where=name_some([error.where for error in errors]),
            found=errors[0].found,
            todo=errors[0].todo,
        ) from errors[0]
    if errors:
        raise errors[0]


def _error_of(view: View, keep: bool, whole: bool) -> UserError | None:
    photo = view.photo
    try:
        if keep or whole or not isinstance(photo, FilePhoto):
            decode(view, keep=keep)
        else:
            photo.source.try_out()
    except UserError as error:
        return error
    return None
