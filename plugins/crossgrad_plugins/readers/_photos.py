"""Photos of a folder by what other programs call them: with or without folder or suffix."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from crossgrad_core.scene.photo_files import walked


@dataclass(frozen=True)
class PhotoNames:
    """Names of the files below a folder.

    Attributes:
        exact: All of them.
        short: Names without folders, with and without suffix -> the names that they can stand for.
    """

    exact: frozenset[str]
    short: Mapping[str, frozenset[str]]

    @classmethod
    def of(cls, folder: Path) -> "PhotoNames":
        """The files below a folder; none where it is not there."""
        exact, short = set(), defaultdict(set)
        for below, _, files in walked(folder):
            for file in files:
                name = (PurePosixPath(below) / file).as_posix()
                exact.add(name)
                for spelling in {file, PurePosixPath(file).stem}:
                    short[spelling].add(name)
        return cls(frozenset(exact), {key: frozenset(names) for key, names in short.items()})

    def full(self, name: str) -> str:
        """The one file that a name stands for; the name itself where there is none, or several."""
        if name in self.exact:
            return name
        alike = self.short.get(PurePosixPath(name).name, frozenset())
        return min(alike) if len(alike) == 1 else name
