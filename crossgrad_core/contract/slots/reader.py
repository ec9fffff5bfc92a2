"""The reader slot: a component reads a scene from a path."""

from abc import abstractmethod
from pathlib import Path
from typing import ClassVar

from crossgrad_core.contract.component import Component
from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.scene_options import SceneOptions


class Reader(Component):
    """A reader of scenes from folders."""

    slot: ClassVar[str] = "readers"

    @abstractmethod
    def accepts(self, path: Path) -> bool:
        """Return True if the folder seems to be in a format that this reader can read."""

    def nearly_accepts(self, path: Path) -> bool:
        """Return True if a file in the folder has almost the format of this reader.

        This method is called only if no reader accepts the folder. If the result is True, the error
        message of `read` reports what is missing.
        """
        return False

    @abstractmethod
    def read(self, path: Path, options: SceneOptions) -> Scene:
        """Return the scene.

        Raises:
            UserError: The folder cannot be read; the message names the file, the problem and a
                remedy.
        """
