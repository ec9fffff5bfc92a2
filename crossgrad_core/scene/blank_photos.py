"""Training photos of which no pixel counts: they would be rendered for nothing and are left out."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from crossgrad_core.errors import UserError
from crossgrad_core.scene.decode import decode_mask, decode_photo
from crossgrad_core.scene.photos import PhotoSource
from crossgrad_core.scene.split import Split
from crossgrad_core.scene.wording import count, name_some

#: A photo of whose stored pixels at least this share counts keeps some whatever is done to it.
#: Undistorting and resizing could take the last ones of others, so these are decoded.
_SURE = 0.05
_HALF = 128


def without_blank_photos(split: Split, sources: Mapping[str, PhotoSource], root: Path) -> Split:
    """The split without training photos that are masked as a whole; a note names them.

    Masks are read for it, and photos with transparency decoded. Held-out photos stay: their
    figures say that they have no pixel.

    Raises:
        UserError: No training photo has a pixel that counts.
    """
    doubtful = [name for name in split.train if _can_be_blank(sources[name])]
    with ThreadPoolExecutor() as pool:
        found = list(pool.map(_is_blank, [sources[name] for name in doubtful]))
    blank = [name for name, is_blank in zip(doubtful, found, strict=True) if is_blank]
    if not blank:
        return split
    if len(blank) == len(split.train):
        raise _all_blank(blank, root)
    train = tuple(name for name in split.train if name not in set(blank))
    what = f"{count(len(blank), 'training photo')} left out, masked as a whole: {name_some(blank)}"
    return replace(split, train=train, notes=(*split.notes, f"masks: {what}"))


def _can_be_blank(source: PhotoSource) -> bool:
    return source.mask is not None or (source.alpha and source.background is None)


def _is_blank(source: PhotoSource) -> bool:
    if min(_counting_shares(source)) >= _SURE:
        return False
    keep = source.decode()[1]
    return keep is not None and not bool(keep.any())


def _counting_shares(source: PhotoSource) -> list[float]:
    """Shares of the stored pixels that count, by the mask and by transparency."""
    shares = [1.0]
    if source.mask is not None:
        shares.append(float((decode_mask(source.mask) > 0).mean()))
    if source.alpha and source.background is None:
        alpha = decode_photo(source.path)[1]
        shares.append(1.0 if alpha is None else float((alpha >= _HALF).mean()))
    return shares


def _all_blank(names: Sequence[str], root: Path) -> UserError:
    return UserError(
        "every pixel of every training photo is masked",
        where=root,
        expected="white in a mask, or opaque in a photo with transparency, where a pixel counts",
        found=f"no such pixel in {name_some(names)}",
        todo="invert the masks if black is meant to count, or rename their folder to train without",
    )
