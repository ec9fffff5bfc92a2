"""A file of Gaussians that other programs open."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
from typing_extensions import override

from crossgrad_core.plugin import Exporter, Gaussians, Similarity, UserError


class Template(Exporter):
    """The centres in the input frame, as a NumPy file."""

    suffix: ClassVar[str] = "npy"

    @override
    def write(
        self, gaussians: Gaussians, similarity: Similarity, path: Path, comments: Sequence[str]
    ) -> tuple[str, ...]:
        local = gaussians.means.detach().cpu().double().numpy()
        unfinished = path.with_name(f"{path.name}.tmp")
        try:
            with unfinished.open("wb") as file:
                np.save(file, similarity.to_input(local))
            unfinished.replace(path)
        except OSError as error:
            raise UserError(
                "the file cannot be written", where=path, found=str(error), todo="choose another"
            ) from error
        return ("only the centres are written",)
