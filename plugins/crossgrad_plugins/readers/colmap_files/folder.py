"""Search for the COLMAP models in a scene folder."""

import difflib
import re
from pathlib import Path

from crossgrad_core.plugin import UserError
from crossgrad_plugins.readers.colmap_files.model import count_images, has_model

_PARENTS = ("sparse", "colmap/sparse")


def find_models(scene: Path) -> list[Path]:
    """Return a scene's model folders: `sparse/0`, `sparse/1` ..., `sparse`, or the scene itself.

    Models in the folder `colmap/sparse` are also returned. The models are sorted by number.
    """
    models = []
    for parent in (scene / name for name in _PARENTS):
        if parent.is_dir():
            below = sorted((p for p in parent.iterdir() if p.is_dir()), key=_by_number)
            models += [folder for folder in (*below, parent) if has_model(folder)]
    return models or ([scene] if has_model(scene) else [])


def choose_model(scene: Path, wanted: str | None) -> tuple[Path, list[str]]:
    """Return the model to read, and a note on the other models, if any.

    Args:
        scene: The scene's folder.
        wanted: Folder of the model within the scene; None for the model with most images.

    Raises:
        UserError: There is no model, or the wanted model is missing.
    """
    if wanted is not None:
        if has_model(scene / wanted):
            return scene / wanted, []
        raise UserError(
            "the COLMAP model that reader.model names does not exist",
            where=scene / wanted,
            expected="cameras and images, as .bin or .txt",
            found=", ".join(str(p.relative_to(scene)) for p in find_models(scene)) or "no model",
            todo="name one of the listed models, or leave reader.model out",
        )
    models = find_models(scene)
    if not models:
        raise _no_model(scene)
    counts = {model: count_images(model) for model in models}
    best = max(models, key=lambda model: counts[model])
    if len(models) == 1:
        return best, []
    others = ", ".join(f"{m.relative_to(scene)} {counts[m]}" for m in models if m != best)
    return best, [
        (
            f"COLMAP: {best.relative_to(scene)} is used, because it has the most images "
            f"({counts[best]}); left out: {others}"
        )
    ]


def check_scene_folder(scene: Path) -> None:
    """Refuse an unreadable folder, and the folder of a model in place of a scene.

    Raises:
        UserError: The path is missing, is a file, is not readable, or is inside `sparse`.
    """
    try:
        if scene.is_dir():
            next(scene.iterdir(), None)
            _check_not_within_sparse(scene)
            return
        if scene.exists():
            raise UserError(
                "the scene must be a folder, not a file", where=scene, todo=f"use {scene.parent}"
            )
        near = _similar_folder(scene)
    except OSError as error:
        raise UserError(
            "the scene folder cannot be read",
            where=scene,
            found=str(error),
            todo="check the permissions of the folder",
        ) from error
    check = "check the path (for a resumed run: `scene:` in its config.yaml)"
    hint = f"did you mean {near}?" if near else check
    raise UserError("the scene folder does not exist", where=scene, todo=hint)


def _check_not_within_sparse(scene: Path) -> None:
    folder = scene.absolute()
    within = [parent for parent in (folder, folder.parent) if parent.name == "sparse"]
    if within and not (scene / "images").is_dir():
        raise UserError(
            "the path points to a folder inside a scene",
            where=scene,
            expected="the folder that contains images/ and sparse/",
            todo=f"use {within[0].parent}",
        )


def _similar_folder(scene: Path) -> Path | None:
    parent = scene.absolute().parent
    if not parent.is_dir():
        return None
    names = [path.name for path in parent.iterdir() if path.is_dir()]
    near = difflib.get_close_matches(scene.name, names, n=1)
    return scene.with_name(near[0]) if near else None


def _no_model(scene: Path) -> UserError:
    below = sorted(path.name for path in scene.iterdir())
    return UserError(
        "the scene has no COLMAP model (the files with the camera poses of the photos)",
        where=scene,
        expected="images/ with the photos and sparse/0/ with cameras, images and points3D, as .bin "
        "or .txt",
        found=", ".join(below[:8]) or "an empty folder",
        todo="name the folder that contains sparse/; for photos without poses, `crossgrad "
        "prepare PHOTOS SCENE` makes a scene, and `crossgrad run PHOTOS --prepare` "
        "also trains on it (docs/prepare.md); docs/readers.md lists other pose "
        "formats",
    )


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Return a sort key with which 10 follows 9."""
    return [(int(digits or 0), digits) for digits in re.split(r"\D+", path.name)]
