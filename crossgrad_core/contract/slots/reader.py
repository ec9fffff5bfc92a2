"""The reader slot: a path -> Scene."""

from abc import abstractmethod
from pathlib import Path
from typing import ClassVar

from crossgrad_core.contract.component import Component
from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.scene_options import SceneOptions


class Reader(Component):
    """Reads a scene from a folder."""

    slot: ClassVar[str] = "readers"

    @abstractmethod
    def accepts(self, path: Path) -> bool:
        """Whether the folder looks like something this reader can read."""

    def nearly_accepts(self, path: Path) -> bool:
        """Whether a file in the folder is nearly of this reader's format.

        It is asked if no reader accepts the folder. `read` then says what the file lacks.
        """
        return False

    @abstractmethod
    def read(self, path: Path, options: SceneOptions) -> Scene:
        """The scene.

        Raises:
            UserError: The folder cannot be read; says which file, what is wrong and what to do.
        """
