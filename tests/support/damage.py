"""Damage to files, and what must hold of a command that meets it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from crossgrad_core.cli.main import main


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def flip(path: Path) -> None:
    """Change the lowest bit of the byte in the middle: of a digit, that makes another digit."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))


DAMAGES: dict[str, Callable[[Path], None]] = {
    "cut in half": halve,
    "emptied": empty,
    "one bit changed": flip,
    "removed": Path.unlink,
}


def files_of(folder: Path) -> list[Path]:
    """The files below a folder that are not empty, as paths relative to it."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.stat().st_size)
    return sorted(path.relative_to(folder) for path in files)


def cases(files: list[Path], *, thorough: bool) -> Iterator[tuple[Path, str]]:
    """Each file with each damage; in the short form each file with one of them, in turn."""
    for number, file in enumerate(files):
        for other, name in enumerate(DAMAGES):
            if thorough or number % len(DAMAGES) == other:
                yield file, name


@dataclass(frozen=True)
class End:
    """How a command ended: exit status, and what it printed."""

    code: int
    out: str
    err: str

    @property
    def is_refused(self) -> bool:
        return self.code == 2 and self.err.count("error: ") == 1


def command(capsys: pytest.CaptureFixture[str], *arguments: object) -> End:
    """Run `crossgrad` in this process; an exception that is no end of the command comes through."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main([str(each) for each in arguments])
    said = capsys.readouterr()
    return End(int(ended.value.code or 0), said.out, said.err)
