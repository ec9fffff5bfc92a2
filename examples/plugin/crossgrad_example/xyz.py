"""An exporter of centres as lines of text."""

from pathlib import Path
from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import ExportContent, Exporter


class Xyz(Exporter):
    """An exporter that writes only the centres, one `x y z` per line, for point-cloud programs."""

    suffix: ClassVar[str] = "xyz"

    @override
    def write(self, content: ExportContent, path: Path) -> tuple[str, ...]:
        centres = content.similarity.to_input(content.gaussians.means.double().numpy())
        part = path.with_name(f".{path.name}.part")
        part.write_text("".join(f"{x} {y} {z}\n" for x, y, z in centres), encoding="utf-8")
        part.replace(path)
        return (f"{path.name}: contains only the centres of the Gaussians",)
