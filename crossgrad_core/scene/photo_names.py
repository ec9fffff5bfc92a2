"""Names of posed images that have another path than their photos."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from crossgrad_core.errors import UserError
from crossgrad_core.scene.file_names import is_absolute, same_spelling
from crossgrad_core.scene.photo_files import find_photo_folders
from crossgrad_core.scene.raw import RawScene
from crossgrad_core.scene.wording import count, name_some
from crossgrad_core.system.input_files import is_file


def with_photo_names(raw: RawScene) -> RawScene:
    """Return the scene with each posed image under the name that its photo has below `images`.

    Programs write absolute paths, or paths from another folder. Spelling is left as it is: a name
    may differ from its photo's in suffix and case.

    Raises:
        UserError: There is no photo folder, or an absolute path fits several photos.
    """
    names = [view.name for view in raw.views]
    if all(not is_absolute(name) and is_file(raw.images / name) for name in names):
        return raw
    pairs = find_photo_folders(raw.images)[0].pair(names)
    _check_absolute(raw, pairs.ambiguous)
    moved = {name: file for name, file in pairs.files.items() if not same_spelling(name, file)}
    told = (
        (moved, "found by the end of their path", "{0} is {1}"),
        (pairs.ambiguous, "without a photo of their own, several could be meant", "{0} ({1})"),
    )
    notes = [
        f"photos: {count(len(which), 'posed image')} {what}: "
        + name_some([form.format(name, _listed(files)) for name, files in sorted(which.items())])
        for which, what, form in told
        if which
    ]
    views = tuple(replace(view, name=moved.get(view.name, view.name)) for view in raw.views)
    if raw.split is not None:
        train, test = (frozenset(moved.get(name, name) for name in part) for part in raw.split)
        raw = replace(raw, split=(train, test))
    return replace(raw, views=views, notes=(*raw.notes, *notes))


def _listed(files: str | Sequence[str]) -> str:
    return files if isinstance(files, str) else " or ".join(files)


def _check_absolute(raw: RawScene, ambiguous: Mapping[str, Sequence[str]]) -> None:
    names = [name for name in ambiguous if is_absolute(name)]
    if names:
        raise UserError(
            "an image name fits several photos",
            where=raw.images,
            expected="a path below the image folder, or one whose end only one photo has",
            found=f"{names[0]}, which can be {name_some(ambiguous[names[0]])}",
            todo="rename the image in the model, so that its folders are those of the photo",
        )
