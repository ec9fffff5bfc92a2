"""Decoding every photo once, early: a damaged one is found before it costs training."""

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from crossgrad_core.contract.scene import Scene, View
from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos import FilePhoto
from crossgrad_core.scene.photos_ahead import AT_ONCE, decode
from crossgrad_core.scene.wording import name_some

_LOG = logging.getLogger(__name__)


def fits(scene: Scene, mib: int) -> bool:
    """Whether all decoded photos of a scene fit into so much memory: then none is decoded twice."""
    pixels = sum(view.camera.width * view.camera.height for view in scene.views)
    return 4 * pixels <= mib * 2**20  # RGB and a mask


def check_photos(views: Sequence[View], *, keep: bool, whole: bool = False) -> None:
    """Decodes the photos and masks of some views.

    Args:
        views: The views.
        keep: Whether there is room to keep what is decoded.
        whole: Whether they are decoded whole even where there is none; else it is only tried
            whether files can be decoded, JPEG files at an eighth of their size.

    Raises:
        UserError: Some cannot be decoded; names them.
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
