"""An input of a parser: a few named files."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

#: File name, with forward slashes -> content.
Case = Mapping[str, bytes]

#: Larger files are cut: what a parser does wrong, it does to small files too.
MOST_BYTES = 1 << 16


def digest(case: Case) -> str:
    """A short name of the content."""
    total = hashlib.sha256()
    for name in sorted(case):
        total.update(name.encode() + b"\0" + len(case[name]).to_bytes(8, "little") + case[name])
    return total.hexdigest()[:12]


def save(case: Case, folder: Path) -> Path:
    """Writes the files of a case below `folder`."""
    for name, content in case.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder


def load(folder: Path) -> dict[str, bytes]:
    """The case that `save` wrote."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}
