"""Photos of cameras with equal labels, distinguished by folder, sensor or camera group."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from crossgrad_core.plugin import UserError
from crossgrad_core.scene.photos.file_names import FileNames
from crossgrad_core.scene.photos.headers import read_header
from crossgrad_core.scene.wording import name_some


@dataclass(frozen=True)
class Labelled:
    """A camera as a file describes it.

    Attributes:
        label: Label of the camera; it may contain folders, and may lack the photo's suffix.
        group: Label of the camera's group; empty without a group.
        sensor: Label of the camera's sensor.
        size: Width and height of the sensor's photos, in pixels.
    """

    label: str
    group: str
    sensor: str
    size: tuple[int, int]

    @property
    def text(self) -> str:
        """The camera as shown in messages."""
        group = f", group {self.group}" if self.group else ""
        return f"{self.label} (sensor {self.sensor or 'without a label'}{group})"


def paired(
    cameras: Sequence[Labelled], photos: FileNames, folder: Path
) -> tuple[list[str], list[str]]:
    """Return for each camera its photo, or its label if the photo is missing, and notes.

    A label can match photos in several folders. Of these photos, one is chosen by the folders in
    the label, by the label of the group, and by the label of the sensor. If several photos are
    left, the size of the photo and the photos of other cameras are compared. If still several are
    left, groups or sensors are paired with folders by their order, which needs equal numbers of
    both.

    Args:
        cameras: All cameras, in the order of the file.
        photos: Photo names relative to `folder`.
        folder: Folder of the photos.

    Raises:
        UserError: Some cameras still match several photos, or two cameras match one photo.
    """
    fits = [_candidates(camera, photos, folder) for camera in cameras]
    _leave_to_others(cameras, fits)
    notes = _by_order(cameras, fits)
    unclear = [c.text for c, names in zip(cameras, fits, strict=True) if len(names) > 1]
    counts = Counter(names[0] for names in fits if len(names) == 1)
    twice = [
        camera.text
        for camera, names in zip(cameras, fits, strict=True)
        if len(names) == 1 and counts[names[0]] > 1
    ]
    if unclear or twice:
        photo_names = next(names for names in fits if len(names) > 1) if unclear else sorted(counts)
        raise UserError(
            "several cameras or photos have the same label"
            if unclear
            else "several cameras refer to the same photo",
            where=name_some(unclear or twice),
            expected="labels that include the folders of the photos, or sensors or groups named "
            "after these folders",
            found=f"photos {name_some(photo_names)}",
            todo="name the sensors or camera groups after the folders of their photos, and "
            "export the cameras again",
        )
    labels = Counter(camera.label for camera in cameras)
    missing = [
        camera.label if labels[camera.label] == 1 else f"{camera.label} (camera {number})"
        for number, camera in enumerate(cameras, 1)
    ]
    return [names[0] if names else name for names, name in zip(fits, missing, strict=True)], notes


def _candidates(camera: Labelled, photos: FileNames, folder: Path) -> list[str]:
    """Return the photos that match the label, its folder names and the photo size."""
    names = photos.fitting(camera.label)
    for hints in (PurePosixPath(camera.label).parts[:-1], (camera.group,), (camera.sensor,)):
        names = _in_folders(names, hints) or names
    if len(names) > 1:
        names = [name for name in names if _size_of(folder / name) == camera.size] or names
    return names


def _in_folders(names: Sequence[str], hints: Sequence[str]) -> list[str]:
    """Return the names whose folders contain all hints."""
    wanted = {hint.casefold() for hint in hints}
    return [
        name
        for name in names
        if wanted <= {folder.casefold() for folder in PurePosixPath(name).parts[:-1]}
    ]


def _size_of(photo: Path) -> tuple[int, int]:
    header = read_header(photo)
    return header.width, header.height


def _leave_to_others(cameras: Sequence[Labelled], fits: list[list[str]]) -> None:
    """If a photo belongs to a camera, remove it from other cameras with the same label."""
    alike: defaultdict[str, set[int]] = defaultdict(set)
    for index, camera in enumerate(cameras):
        alike[PurePosixPath(camera.label).name].add(index)
    for indices in alike.values():
        waiting = set(indices)
        single = Counter(fits[i][0] for i in waiting if len(fits[i]) == 1)
        decided = {
            i
            for i in waiting
            if len(fits[i]) == 1 and (single[fits[i][0]] == 1 or _is_sure(cameras[i], fits[i][0]))
        }
        while decided:
            taken = {fits[i][0] for i in decided}
            waiting -= decided
            for i in waiting:
                fits[i] = [name for name in fits[i] if name not in taken]
            decided = {i for i in waiting if len(fits[i]) == 1}


def _is_sure(camera: Labelled, name: str) -> bool:
    """Return True if the folder of a photo is named by the label, the group or the sensor."""
    hints = (PurePosixPath(camera.label).parts[:-1], (camera.group,), (camera.sensor,))
    return camera.label == name or any(
        hint and all(hint) and _in_folders([name], hint) for hint in hints
    )


def _by_order(cameras: Sequence[Labelled], fits: list[list[str]]) -> list[str]:
    """Pair groups or sensors with folders by their order; return a note if this was needed."""
    unclear = [i for i, names in enumerate(fits) if len(names) > 1]
    folders = sorted({_folder(name) for i in unclear for name in fits[i]})
    for of in ("group", "sensor"):
        owners = list(dict.fromkeys(getattr(cameras[i], of) for i in unclear))
        if not unclear or len(owners) != len(folders):
            continue
        folder_of: Mapping[str, str] = dict(zip(owners, folders, strict=True))
        chosen = {
            i: [n for n in fits[i] if _folder(n) == folder_of[getattr(cameras[i], of)]]
            for i in unclear
        }
        if all(len(names) == 1 for names in chosen.values()):
            for i, names in chosen.items():
                fits[i] = names
            pairs = ", ".join(f"{owner or 'none'} {folder}" for owner, folder in folder_of.items())
            return [
                (f"photos with equal labels are paired by the order of {of}s and folders: {pairs}")
            ]
    return []


def _folder(name: str) -> str:
    return str(PurePosixPath(name).parent)
