"""The one file of a program that a scene's own folder holds."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from crossgrad_core.plugin import UserError
from crossgrad_plugins.readers._inside import Inside


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        form: Such as XML.
        program: Whose it is.
        suffix: Of its names, with the dot.
        holds: Whether a file is of the kind, from its first bytes.
        expected: What is in it, for errors.
        nearly: Whether a file lacks little to be of the kind.
    """

    form: str
    program: str
    suffix: str
    holds: Callable[[Path], bool]
    expected: str
    nearly: Callable[[Path], bool] = lambda _: False

    def find(self, inside: Inside, named: str | None) -> list[Path]:
        """The files of the kind: at most the named one, else those of the scene's own folder."""
        files = self._files(inside) if named is None else [inside.scene / named]
        return list(filter(self.holds, files))

    def find_near(self, inside: Inside) -> list[Path]:
        """The files of the scene's own folder that lack little to be of the kind."""
        return list(filter(self.nearly, self._files(inside)))

    def _files(self, inside: Inside) -> list[Path]:
        return [path for path in inside.files("*") if path.suffix.lower() == self.suffix]

    def one(self, inside: Inside, named: str | None) -> Path:
        """The file that is named by `reader.file`, else the only one of the kind, or nearly.

        Raises:
            UserError: There is none, or there are several, or it leads out of the scene.
        """
        if named is not None:
            return inside.file(inside.name(named, "reader.file"), "reader.file")
        found = self.find(inside, None) or self.find_near(inside)
        if len(found) == 1:
            return inside.file(found[0].name, found[0])
        several = f"several {self.form}s" if found else f"no {self.form}"
        raise UserError(
            f"the scene has {several} of {self.program}",
            where=inside.scene,
            expected=self.expected,
            found=", ".join(path.name for path in found) or "none",
            todo="name it, with --set reader.file=NAME, or export it",
        )
