"""Photos of a folder by what other programs call them: with or without folder or suffix."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from crossgrad_core.scene.photo_files import PhotoFolder
from crossgrad_plugins.readers._inside import Inside


@dataclass(frozen=True)
class PhotoNames:
    """Names that a file of poses gives to the photos of a folder.

    Attributes:
        files: Such a name -> the one photo below the folder that it stands for.
    """

    files: Mapping[str, str]

    @classmethod
    def of(cls, folder: Path, names: Iterable[str]) -> "PhotoNames":
        """The photos below a folder; none where it is not there."""
        return cls(PhotoFolder(folder).pair(frozenset(names)).files)

    def full(self, name: str, inside: Inside, where: object) -> str:
        """The photo that a name stands for; the plain name itself where there is none, or several.

        Raises:
            UserError: There is none, and the name leads out of the scene.
        """
        return self.files.get(name) or inside.name(name, where)
