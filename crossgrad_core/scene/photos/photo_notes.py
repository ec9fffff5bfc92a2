"""Write notes on the photos of a scene, the processing of photos, and unused files."""

import os
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Final

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.scene.photos import pillow
from crossgrad_core.scene.photos.decode import RESIZE_FILTER
from crossgrad_core.scene.photos.file_names import COPY, DEPTH, MASK, PHOTO, POINTS, RAW, kind_of
from crossgrad_core.scene.photos.headers import PhotoHeader
from crossgrad_core.scene.photos.photo_files import PhotoFolder, walked
from crossgrad_core.scene.photos.photos import PhotoSource
from crossgrad_core.scene.raw import RawScene
from crossgrad_core.scene.wording import count, megapixels, name_some
from crossgrad_core.wording import listed

_MIB = 2**20
_SHOWN_SIZES = 3
#: Lenses without a wide angle lose less than this share of the pixels by undistortion.
_WORTH_A_NOTE = 0.1
Sources = Mapping[str, PhotoSource]
#: Names of files that crossgrad writes. A folder with a file of the first set was written by a run
#: or by `prepare`, and is skipped.
_OWN_FOLDERS: Final = frozenset({"config.yaml", "plan.json"})
_OWN_FILES: Final = frozenset({"report.png"})
#: Maximum number of groups of unused files that get a note of their own.
_MOST: Final = 8


def note_pairing(
    folder: PhotoFolder, paths: Mapping[str, Path], names: Sequence[str], used: Collection[Path]
) -> list[str]:
    """Note posed images without a photo and photos without a pose.

    Note photos whose names differ in suffix or letter case.
    """
    absent = [name for name in names if name not in paths]
    used_paths = frozenset(used)
    others = [name for name in folder.names if folder.path / name not in used_paths]
    spare = [name for name in others if kind_of(name) is PHOTO]
    renamed = [name for name, path in paths.items() if path != folder.path / name]
    groups = (
        (absent, "posed image", "left out, because the photo is missing"),
        (spare, "photo", "left out (no pose)"),
        (renamed, "photo", "matched with a photo whose suffix or case differs"),
    )
    return [
        f"photos: {count(len(which), noun)} {what}: {name_some(which)}"
        for which, noun, what in groups
        if which
    ]


def note_links(root: Path, sources: Sources) -> list[str]:
    """Note photos and masks whose files are outside the scene's folder."""
    home = os.path.join(os.path.realpath(root), "")
    files = [file for source in sources.values() for file in (source.path, source.mask) if file]
    outside = [file for file in files if not os.path.realpath(file).startswith(home)]
    if not outside:
        return []
    first = min(outside)
    return [
        (
            f"photos: {count(len(outside), 'file')} outside the scene folder, such as "
            f"{first}, which is {os.path.realpath(first)}"
        )
    ]


def note_undistortion(sources: Sources) -> list[str]:
    """Note how many photos of each camera model are undistorted."""
    models = Counter(s.distorted.model for s in sources.values() if s.distorted is not None)
    if not models:
        return []
    kinds = ", ".join(f"{number} {model}" for model, number in sorted(models.items()))
    total = count(models.total(), "photo")
    return [f"photos: {total} undistorted to PINHOLE with pycolmap ({kinds})", *_costs(sources)]


def _costs(sources: Sources) -> list[str]:
    """Note lenses whose model folds over, and lenses that lose many pixels by undistortion."""
    lenses = [source.distorted for source in sources.values() if source.distorted is not None]
    lens_costs = [(lens, cost) for lens in lenses if (cost := lens.cost) is not None]
    folded = [(lens.model, cost.beyond) for lens, cost in lens_costs if cost.beyond > 0.0]
    wide = [cost for _, cost in lens_costs if cost.lost >= _WORTH_A_NOTE]
    notes = []
    if folded:
        models = listed(sorted({model for model, _ in folded}))
        notes.append(
            f"photos: the distortion of camera model {models} is not invertible inside "
            f"the frame of {count(len(folded), 'photo')}; "
            f"{_percent([share for _, share in folded])} of the undistorted pixels are "
            "outside the valid range and are ignored"
        )
    if wide:
        notes.append(
            f"photos: the lens of {count(len(wide), 'photo')} has a field of view of "
            f"{_degrees([cost.seen for cost in wide])} degrees; undistortion keeps "
            f"{_degrees([cost.kept for cost in wide])} degrees and loses "
            f"{_percent([cost.lost for cost in wide])} of the pixels"
        )
    return notes


def _percent(shares: Sequence[float]) -> str:
    return f"{_degrees([100.0 * share for share in shares])} %"


def _degrees(values: Sequence[float]) -> str:
    """Format the range of the values as whole numbers, such as `3 to 5`."""
    low, high = (f"{value:.0f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def note_sizes(
    folder: str, sources: Sources, calibrated: Mapping[str, tuple[int, int]]
) -> list[str]:
    """Note the sizes of the training photos, their folder, and how they were resized."""
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
        notes.append(f"photos: {scaled} with another size than their camera, which was scaled")
    return notes


def note_reductions(sources: Sources) -> list[str]:
    """Note how many photos are decoded at a reduced size because they are too large."""
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
    """Note how many photos are rotated, transparent, grey or masked."""
    total = len(sources)
    over = f"blended over RGB {background}" if background else "pixels with alpha < 0.5 are ignored"
    counted = (
        (
            sum(s.orientation != 1 for s in sources.values()),
            "photos",
            "rotated as their EXIF orientation says",
        ),
        (sum(header.alpha for header in headers.values()), "photos", f"with transparency: {over}"),
        (
            sum(header.grey for header in headers.values()),
            "photos",
            "grey: copied into three equal channels",
        ),
        (
            sum(s.mask is not None for s in sources.values()),
            "masks",
            "have one: white pixels are used",
        ),
    )
    bare = [name for name, source in sorted(sources.items()) if source.mask is None]
    missing = f"{len(bare)} of {total} have none, and all their pixels are used: {name_some(bare)}"
    return [
        *(f"{topic}: {number} of {total} {what}" for number, topic, what in counted if number),
        *([f"masks: {missing}"] if bare and len(bare) < total else []),
    ]


def note_memory(sources: Sources, options: SceneOptions) -> list[str]:
    """Note if the decoded photos do not fit into the memory of the photo cache."""
    need = sum(3 * s.target[0] * s.target[1] for s in sources.values()) / _MIB
    if need <= options.cache_mib:
        return []
    return [
        (
            f"photos: {need:.0f} MiB when decoded, of which {options.cache_mib} MiB are "
            "kept in memory; the other photos are decoded again for every use (more "
            "memory: --set data.cache_mib=N; smaller photos: --max-size N)"
        )
    ]


def note_unused(raw: RawScene, used: Iterable[Path], masks: Path | None) -> list[str]:
    """Note unused photos, masks, depth maps, points and tables.

    Each folder and reason has its own note.

    Photos without a pose in the photo folder are not included, because `note_pairing` reports them.

    Args:
        raw: The scene from the reader.
        used: Paths of the used files, without the files that the reader used.
        masks: Folder of the masks; None without masks.
    """
    groups = defaultdict[tuple[str, str], list[str]](list)
    for name, reason in _unused(raw, [*used, *raw.files], masks).items():
        path = PurePosixPath(name)
        groups[path.parent.as_posix(), reason].append(path.name)
    listed = sorted(groups.items())
    notes = [
        f"unused: {count(len(names), 'file')} in {_shown(raw, folder)} "
        f"({name_some(sorted(names))}), {reason}"
        for (folder, reason), names in listed[:_MOST]
    ]
    if rest := listed[_MOST:]:
        number = sum(len(names) for _, names in rest)
        folders = sorted({_shown(raw, folder) for (folder, _), _ in rest})
        notes.append(f"unused: {count(number, 'more file')} in {name_some(folders)}")
    return notes


def _unused(raw: RawScene, used: Iterable[Path], masks: Path | None) -> dict[str, str]:
    """Return the files that are used neither directly nor through links, with the reasons."""
    used_paths, home = set(map(os.path.abspath, used)), os.path.abspath(raw.root)
    files = [name for name in _files(raw.root) if os.path.join(home, name) not in used_paths]
    reasons = {name: reason for name in files if (reason := _reason(name, raw, masks))}
    if not reasons:
        return {}
    true = set(map(os.path.realpath, used_paths))
    return {
        name: reason
        for name, reason in reasons.items()
        if os.path.realpath(os.path.join(home, name)) not in true
    }


def _files(root: Path) -> Iterator[str]:
    """Yield the paths of all files below a scene.

    Hidden files and outputs of crossgrad are skipped.
    """
    for below, folders, files in walked(root):
        if below != "." and _OWN_FOLDERS & set(files):
            folders.clear()
            continue
        folders[:] = [name for name in folders if not name.startswith((".", "__"))]
        for name in files:
            if not name.startswith(".") and name not in _OWN_FILES:
                yield name if below == "." else f"{below}/{name}"


def _reason(name: str, raw: RawScene, masks: Path | None) -> str | None:
    """Return why a file is not used.

    Return None for unknown kinds and for files that another note reports.
    """
    kind, path = kind_of(name), raw.root / name
    if kind is None or (kind is PHOTO and path.is_relative_to(raw.images)):
        return None
    if masks is not None and kind in {PHOTO, MASK} and path.is_relative_to(masks):
        return "masks without a used photo"
    if kind is MASK:
        return "files whose names look like masks; use them with --set data.masks=FOLDER"
    if kind is POINTS:
        explanation = (
            "the scene has its own points"
            if len(raw.points)
            else "the reader does not look for this name"
        )
        return f"{explanation}; start from such a file with --points FILE"
    return {
        RAW: "raw files of a camera; save the photos as JPEG or PNG to use them",
        DEPTH: "depth and normal maps are not used",
        COPY: "smaller copies of the photos are read only with --max-size",
        PHOTO: f"outside the photo folder {_shown(raw, os.path.relpath(raw.images, raw.root))}",
    }.get(kind, "the reader does not read this table")


def _shown(raw: RawScene, folder: str) -> str:
    return f"{raw.root.resolve().name}/" if folder == "." else f"{folder}/"
