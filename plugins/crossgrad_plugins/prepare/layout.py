"""The folder of a prepared scene: its files, and a check that `prepare` made the folder."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Final

from crossgrad_core.commands import (
    UserError,
    check_folder,
    clear_half_written,
    disk_errors,
    is_leftover,
)
from crossgrad_plugins.prepare.pycolmap_calls import is_whole

#: The folder of intermediate files, and the file that shows that `prepare` made the folder.
WORK: Final = "prepare"
PLAN: Final = "plan.json"


@dataclass(frozen=True)
class Layout:
    """The paths in a scene folder. A file or folder gets its final name only after it is complete.

    Attributes:
        scene: The scene's folder.
    """

    scene: Path

    @property
    def work(self) -> Path:
        """The folder of intermediate files."""
        return self.scene / WORK

    @property
    def plan(self) -> Path:
        """The photos and settings of the scene. This file shows that `prepare` made the folder."""
        return self.work / PLAN

    @property
    def database(self) -> Path:
        """Cameras, features and matches, as a COLMAP database."""
        return self.work / "database.db"

    @property
    def features(self) -> Path:
        """Number of features of each photo, written after all features have been found."""
        return self.work / "features.json"

    @property
    def links(self) -> Path:
        """Pairs of photos with verified matches.

        The file is written after all pairs have been compared.
        """
        return self.work / "links.json"

    @property
    def models(self) -> Path:
        """One folder for each model of the distorted photos.

        The folder gets its name after mapping is finished.
        """
        return self.work / "models"

    @property
    def misplaced(self) -> Path:
        """The photos that were removed from models, written after mapping is finished."""
        return self.work / "misplaced.json"

    @property
    def placed(self) -> Path:
        """The model of the scene, georegistered if its position on Earth is known."""
        return self.work / "placed"

    @property
    def undistorted(self) -> Path:
        """The undistorted photos before they are moved to the final folder.

        Only the scratch folder of this path is created.
        """
        return self.work / "undistorted"

    @property
    def images(self) -> Path:
        """The undistorted photos."""
        return self.scene / "images"

    @property
    def masks(self) -> Path:
        """The undistorted masks."""
        return self.scene / "masks"

    @property
    def model(self) -> Path:
        """The model of the undistorted photos.

        The folder gets its name after the scene is complete.
        """
        return self.scene / "sparse" / "0"

    @property
    def georef(self) -> Path:
        """The position of the scene on Earth."""
        return self.scene / "georef.json"

    @property
    def report(self) -> Path:
        """The report as data, which is written last."""
        return self.scene / "report.json"

    @property
    def is_ready(self) -> bool:
        """True if the scene is complete and no file has to be written."""
        return self.report.is_file() and self.model.is_dir() and self.images.is_dir()

    @property
    def is_whole(self) -> bool:
        """True if all files exist that record how a finished scene was made."""
        files, folders = (self.plan, self.features, self.links), (self.models, self.placed)
        return all(path.is_file() for path in files) and all(path.is_dir() for path in folders)


def check_ours(layout: Layout, photos: Path) -> None:
    """Refuse a folder that `prepare` did not make, and a folder inside the folder of photos.

    Raises:
        UserError: The folder is refused; the message says what to do.
    """
    scene = layout.scene
    if layout.is_ready:
        _check_whole(layout)
        return
    check_folder(scene)
    inside = scene.resolve()
    if inside == photos.resolve() or photos.resolve() in inside.parents:
        raise UserError(
            "the output folder is inside the photo folder",
            where=scene,
            expected=f"a folder outside {photos}",
            todo=f"name another folder, such as {photos.resolve()}-scene",
        )
    if layout.plan.is_file() or not scene.is_dir():
        return
    # Continue only if all files in the folder are a lock file or temporary plan files of a killed
    # process.
    left = [path for path in scene.iterdir() if path.name not in {WORK, "run.lock"}]
    if left or (layout.work.is_dir() and any(not _is_hidden(p) for p in layout.work.iterdir())):
        raise UserError(
            "the folder contains files that do not belong to a scene of `crossgrad prepare`",
            where=scene,
            expected="a new or empty folder, or a folder that `crossgrad prepare` made",
            found=", ".join(sorted(path.name for path in scene.iterdir())[:5]),
            todo="choose another folder, or remove it",
        )


def _check_whole(layout: Layout) -> None:
    """Refuse a finished scene with a missing or truncated part."""
    if not layout.is_whole:
        raise UserError(
            "the scene is ready, but the records of `crossgrad prepare` are missing",
            where=layout.work,
            expected="the complete folder of records",
            found="a part of the records" if layout.work.is_dir() else "no such folder",
            todo=f"train on the scene unchanged: crossgrad run {quote(str(layout.scene))} "
            "--plan auto; or choose another folder and prepare the photos again",
        )
    for made in (layout.models, layout.placed, layout.model):
        if not _is_sound(layout, made):
            raise UserError(
                "a model of the scene is incomplete, for example because the disk was full",
                where=made,
                todo=f"remove {layout.report} and run the same command again",
            )


def _is_hidden(path: Path) -> bool:
    return path.name.startswith(".")


def emptied(folder: Path) -> Path:
    """Return an empty folder; create the folder if it is missing.

    Raises:
        UserError: The disk is full, or the folder is not writable.
    """
    with disk_errors(folder):
        _delete(folder)
        folder.mkdir(parents=True)
    return folder


def clear_leftovers(layout: Layout) -> None:
    """Delete unfinished files of a killed process.

    This is safe because only one process works in the folder. Other hidden files and folders, such
    as version control, belong to the user and are kept.
    """
    for made in (layout.undistorted, layout.placed, layout.models):
        _delete(scratch_of(made))
    for folder in (layout.work, layout.scene):
        clear_half_written(folder)
    for path in layout.masks.rglob(".*.tmp*"):
        if is_leftover(path):
            path.unlink()


def clear_damaged(layout: Layout) -> None:
    """Delete truncated models, and everything that was made from them."""
    damaged = False
    for made in (layout.models, layout.placed, layout.model):
        damaged = damaged or not _is_sound(layout, made)
        if damaged:
            _delete(made)


def _is_sound(layout: Layout, made: Path) -> bool:
    """Return True if the models of a stage are complete, or if they do not exist yet."""
    models = models_in(made) if made == layout.models else [made]
    return not made.is_dir() or all(is_whole(model) for model in models)


def models_in(folder: Path) -> list[Path]:
    """Return the folders of the models that mapping found, sorted by number."""
    models = [path for path in folder.glob("*") if path.name.isdecimal()]
    return sorted(models, key=lambda path: int(path.name))


def _delete(path: Path) -> None:
    if path.is_symlink():
        path.unlink()
    elif path.exists():
        shutil.rmtree(path)


def scratch_of(path: Path) -> Path:
    """Return the scratch path where a folder is made before it gets its final name."""
    return path.with_name(f".{path.name}.tmp")
