"""The exporter that reads a file of Gaussians, chosen by the name of the file."""

from collections.abc import Iterator
from pathlib import Path

from crossgrad_core.contract.slots.exporter import Exporter
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.wording import listed


def exporter_for(path: Path, where: str | None = None) -> Exporter:
    """Return the exporter whose files have names like `path`, with default options.

    Args:
        path: A file of Gaussians. The exporter checks whether the file exists.
        where: The option that named the file, for the error message.

    Raises:
        UserError: No installed exporter has files with such a name.
    """
    for exporter in _exporters(path):
        if exporter.is_of_format(path):
            return exporter
    suffixes = sorted(f".{each.suffix}" for each in _exporters(path) if _reads(each))
    raise UserError(
        "the name of the file does not show a format of Gaussians that crossgrad reads",
        where=path if where is None else f"{where} {path}",
        expected=f"a name that ends in {listed(suffixes)}",
        todo="rename the file if it has one of these formats, or convert it",
    )


def _exporters(path: Path) -> Iterator[Exporter]:
    """Yield all exporters; first the exporter with the name of the suffix of `path`.

    The other exporters, which may be slow or broken, are then not imported for common files.
    """
    suffix = path.suffix.lower().removeprefix(".")
    for name in sorted(entries(Exporter.slot), key=lambda name: (name != suffix, name)):
        yield build(Exporter, name, {})


def _reads(exporter: Exporter) -> bool:
    return bool(exporter.suffix) and type(exporter).read is not Exporter.read
