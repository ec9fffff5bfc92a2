"""Contract checks for readers, with folders that are not scenes."""

from pathlib import Path
from tempfile import TemporaryDirectory

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.contract.slots.reader import Reader
from crossgrad_core.errors import UserError
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import Check, ContractError, Make, require


def foreign_folders_are_not_accepted(make: Make[Reader]) -> None:
    """`accepts` returns False for an empty folder, a missing folder, and a file.

    `accepts` never raises an error.
    """
    with TemporaryDirectory() as folder:
        file = Path(folder) / "notes.txt"
        for path, what in ((Path(folder), "an empty"), (Path(folder) / "gone", "a missing")):
            require(make().accepts(path) is False, f"accepts() returns True for {what} folder")
        file.write_text("no scene")
        require(make().accepts(file) is False, "accepts() returns True for a text file")


def foreign_folders_are_a_user_error(make: Make[Reader]) -> None:
    """Reading a folder that is not a scene raises a `UserError`."""
    with TemporaryDirectory() as folder:
        for path in (Path(folder), Path(folder) / "gone"):
            try:
                make().read(path, SceneOptions.model_validate({}))
            except UserError:
                continue
            except Exception as error:
                raise ContractError(f"reading {path} raised {error!r}, not a UserError") from error
            raise ContractError(f"reading {path}, which is not a scene, raised no error")


def folders_stay_as_they_are(make: Make[Reader]) -> None:
    """Neither `accepts` nor a failed `read` leaves files in the folder."""
    with TemporaryDirectory() as folder:
        make().accepts(Path(folder))
        try:
            make().read(Path(folder), SceneOptions.model_validate({}))
        except UserError:
            left = sorted(path.name for path in Path(folder).iterdir())
            require(not left, f"the reader does not remove its files: {left}")


READER_CHECKS: tuple[Check[Reader], ...] = (
    *COMPONENT_CHECKS,
    foreign_folders_are_not_accepted,
    foreign_folders_are_a_user_error,
    folders_stay_as_they_are,
)
