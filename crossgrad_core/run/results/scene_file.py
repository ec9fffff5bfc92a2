"""scene.json: the fingerprint of the scene that a run was trained on."""

import json
import logging
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from crossgrad_core.errors import UserError
from crossgrad_core.run.results.reading import SCENE as FILE
from crossgrad_core.scene.fingerprint import Fingerprint, Weight, differences
from crossgrad_core.system.checksums import changed_files
from crossgrad_core.system.files import write_atomically
from crossgrad_core.system.input_files import read_file

#: Most serious difference of the scene -> advice for the user. The key None stands for differences
#: that the user can accept.
_WAYS_OUT = {
    None: "restore the scene, or add --accept-scene to continue with the changed scene",
    Weight.HELD_OUT: (
        "restore the scene; eval, render and export accept the change with "
        "--accept-scene, but a run can continue only with the views that it was "
        "started with"
    ),
    Weight.PLACE: (
        "restore the scene, or start a new run: otherwise the trained parameters "
        "would be at wrong positions, or training views would be used for evaluation"
    ),
}
#: The beginning of the note on an accepted scene.
ACCEPTED: Final = "the scene has changed since the run was trained, accepted: "
_LOG = logging.getLogger(__name__)


def write_scene(folder: Path, fingerprint: Fingerprint) -> None:
    """Write a run's scene.json, one line for each view.

    Raises:
        UserError: The disk is full.
    """
    data = fingerprint.model_dump(mode="json")
    views = data.pop("views")
    head = json.dumps(data, indent=1, ensure_ascii=True).removesuffix("\n}")
    lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(view)}" for name, view in views.items())
    write_atomically(folder / FILE, f'{head},\n "views": {{\n{lines}\n }}\n}}\n'.encode())


def read_scene_file(folder: Path) -> Fingerprint | None:
    """Return the fingerprint of a run's scene; if it is unknown, log a warning and return None."""
    path = folder / FILE
    why = f"{path} is damaged, or another version wrote it"
    try:
        fingerprint = Fingerprint.model_validate_json(read_file(path))
        if not changed_files(folder, [FILE]):
            return fingerprint
    except OSError:
        why = f"{folder} has no {FILE}: an older version wrote the run, or the file was removed"
    except ValidationError:
        pass
    _LOG.warning("%s; it is not known whether the scene is still the same", why)
    return None


def check_scene(
    folder: Path, now: Fingerprint, tolerated: Weight, *, accept: bool
) -> tuple[str, ...]:
    """Compare the present scene with the scene that the run was trained on.

    Args:
        folder: The run's folder.
        now: The present scene.
        tolerated: The most serious kind of difference that the calling command can accept.
        accept: True if the user accepts tolerated differences (`--accept-scene`).

    Returns:
        A note on the differences, if there are any.

    Raises:
        UserError: The scene has a difference that is not tolerated, or the user did not accept the
            differences.
    """
    was = read_scene_file(folder)
    changed = [] if was is None else differences(was, now)
    if not changed:
        return ()
    text = "; ".join(difference.text for difference in changed)
    heaviest = max(difference.weight for difference in changed)
    if heaviest <= tolerated and accept:
        return (f"{ACCEPTED}{text}",)
    raise UserError(
        "the scene has changed since the run was trained",
        where=folder / FILE,
        found=text,
        todo=_WAYS_OUT[heaviest if heaviest > tolerated else None],
    )
