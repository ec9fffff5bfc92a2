"""Notes on what was done to the photos of a scene."""

import os
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.scene import pillow
from crossgrad_core.scene.decode import RESIZE_FILTER
from crossgrad_core.scene.file_kinds import PHOTO, kind_of
from crossgrad_core.scene.headers import PhotoHeader
from crossgrad_core.scene.photo_files import PhotoFolder
from crossgrad_core.scene.photos import PhotoSource
from crossgrad_core.scene.wording import count, megapixels, name_some
from crossgrad_core.wording import listed

_MIB = 2**20
_SHOWN_SIZES = 3
#: Undistortion of ordinary lenses loses less than this share of the pixels.
_WORTH_A_NOTE = 0.1

Sources = Mapping[str, PhotoSource]


def note_pairing(
    folder: PhotoFolder, paths: Mapping[str, Path], names: Sequence[str], used: Collection[Path]
) -> list[str]:
    """Posed images without a photo, photos without a pose, and pairs that differ in spelling."""
    absent = [name for name in names if name not in paths]
    known = frozenset(used)
    others = [name for name in folder.names if folder.path / name not in known]
    spare = [name for name in others if kind_of(name) is PHOTO]
    renamed = [name for name, path in paths.items() if path != folder.path / name]
    told = (
        (absent, "posed image", "left out, the photo is missing"),
        (spare, "photo", "without a pose left out"),
        (renamed, "photo", "paired by a name that differs in suffix or case"),
    )
    return [
        f"photos: {count(len(which), noun)} {what}: {name_some(which)}"
        for which, noun, what in told
        if which
    ]


def note_links(root: Path, sources: Sources) -> list[str]:
    """Where photos and masks lie that are no part of the scene's folder."""
    home = os.path.join(os.path.realpath(root), "")
    files = [file for each in sources.values() for file in (each.path, each.mask) if file]
    outside = [file for file in files if not os.path.realpath(file).startswith(home)]
    if not outside:
        return []
    first = min(outside)
    return [
        f"photos: {count(len(outside), 'file')} outside the scene's folder, such as {first}, "
        f"which is {os.path.realpath(first)}"
    ]


def note_undistortion(sources: Sources) -> list[str]:
    """How many photos are undistorted, from which camera models."""
    models = Counter(s.distorted.model for s in sources.values() if s.distorted is not None)
    if not models:
        return []
    kinds = ", ".join(f"{number} {model}" for model, number in sorted(models.items()))
    total = count(models.total(), "photo")
    return [f"photos: {total} undistorted to PINHOLE with pycolmap ({kinds})", *_costs(sources)]


def _costs(sources: Sources) -> list[str]:
    """What undistortion loses of lenses that fold over or see far more than a pinhole camera."""
    lenses = [source.distorted for source in sources.values() if source.distorted is not None]
    found = [(lens, cost) for lens in lenses if (cost := lens.cost) is not None]
    folded = [(lens.model, cost.beyond) for lens, cost in found if cost.beyond > 0.0]
    wide = [cost for _, cost in found if cost.lost >= _WORTH_A_NOTE]
    notes = []
    if folded:
        models = listed(sorted({model for model, _ in folded}))
        notes.append(
            f"photos: camera model {models} folds over inside the frame of "
            f"{count(len(folded), 'photo')}; {_percent([share for _, share in folded])} of the "
            "undistorted pixels lie beyond the fold and do not count"
        )
    if wide:
        notes.append(
            f"photos: the lens of {count(len(wide), 'photo')} sees "
            f"{_degrees([cost.seen for cost in wide])} degrees across; undistortion keeps "
            f"{_degrees([cost.kept for cost in wide])} of these and loses "
            f"{_percent([cost.lost for cost in wide])} of the pixels"
        )
    return notes


def _percent(shares: Sequence[float]) -> str:
    return f"{_degrees([100.0 * share for share in shares])} %"


def _degrees(values: Sequence[float]) -> str:
    """Whole numbers from the least to the most."""
    low, high = (f"{value:.0f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def note_sizes(
    folder: str, sources: Sources, calibrated: Mapping[str, tuple[int, int]]
) -> list[str]:
    """Sizes as trained, the folder that they come from, and the resize filter."""
    sizes = Counter(source.target for source in sources.values()).most_common()
    shown = [f"{width} x {height} px ({number})" for (width, height), number in sizes]
    text = ", ".join(shown[:_SHOWN_SIZES])
    if len(shown) > _SHOWN_SIZES:
        text += f" and {len(shown) - _SHOWN_SIZES} more sizes"
    resized = sum(source.target != source.undistorted_size for source in sources.values())
    how = f"{resized} resized ({RESIZE_FILTER})" if resized else "not resized"
    notes = [f"photos: {text} from {folder}/, {how}"]
    scaled = sum(calibrated[n] != (s.width, s.height) for n, s in sources.items())
    if scaled:
        notes.append(f"photos: {scaled} of another size than their camera, which was scaled")
    return notes


def note_reductions(sources: Sources) -> list[str]:
    """How many photos are so large that they are decoded at a reduced size."""
    reduced = [s.reduction for s in sources.values() if s.reduction > 1]
    if not reduced:
        return []
    how = ", ".join(f"1/{size}" for size in sorted(set(reduced)))
    which = f"{count(len(reduced), 'photo')} above {megapixels(pillow.MOST_PIXELS)}"
    return [f"photos: {which} decoded at {how} of their width and height"]


def note_kinds(
    sources: Sources,
    headers: Mapping[str, PhotoHeader],
    background: tuple[float, float, float] | None,
) -> list[str]:
    """Turned, transparent, grey and masked photos."""
    total = len(sources)
    over = f"blended over RGB {background}" if background else "alpha < 0.5 does not count"
    told = (
        (sum(s.orientation != 1 for s in sources.values()), "photos", "turned by EXIF orientation"),
        (sum(header.alpha for header in headers.values()), "photos", f"with transparency: {over}"),
        (sum(header.grey for header in headers.values()), "photos", "grey: three equal channels"),
        (sum(s.mask is not None for s in sources.values()), "masks", "have one: white counts"),
    )
    bare = [name for name, source in sorted(sources.items()) if source.mask is None]
    missing = f"{len(bare)} of {total} have none, all of their pixels count: {name_some(bare)}"
    return [
        *(f"{topic}: {number} of {total} {what}" for number, topic, what in told if number),
        *([f"masks: {missing}"] if bare and len(bare) < total else []),
    ]


def note_memory(sources: Sources, options: SceneOptions) -> list[str]:
    """Says so when the decoded photos do not fit into the memory set aside for them."""
    need = sum(3 * s.target[0] * s.target[1] for s in sources.values()) / _MIB
    if need <= options.cache_mib:
        return []
    return [
        f"photos: {need:.0f} MiB when decoded, of which {options.cache_mib} MiB are kept; the "
        "others are decoded again whenever they are drawn (more memory: --set data.cache_mib=N; "
        "smaller photos: --max-size N)"
    ]
