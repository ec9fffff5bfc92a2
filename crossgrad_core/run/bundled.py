"""The example scene that comes with the package."""

from pathlib import Path

from crossgrad_core.errors import UserError

#: The length of a run on the bundled scene that asks for none, whichever is over first: training
#: seconds, and 100 views of each of its training photos, which more teach by heart
#: (docs/few-photos.md).
BUNDLED_SECONDS = 120.0
BUNDLED_VIEWS = 2_400


def bundled_scene() -> Path:
    """The folder of the bundled scene: inside an installed package, or in a checkout.

    Raises:
        UserError: It is in neither place.
    """
    package = Path(__file__).resolve().parents[1]
    installed = package / "data" / "boruszyn"
    checkout = package.parent / "examples" / "scenes" / "boruszyn"
    for folder in (installed, checkout):
        if folder.is_dir():
            return folder
    raise UserError(
        "the bundled scene is missing",
        where=installed,
        todo="name a scene: crossgrad run SCENE",
    )
