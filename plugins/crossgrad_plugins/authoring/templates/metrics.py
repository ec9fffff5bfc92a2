"""A figure of every held-out view."""

from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import Compared, Figure, Metric


class Template(Metric):
    """Mean absolute difference of the pixels that count, from 0 to 1."""

    figure: ClassVar[Figure] = Figure(name="absolute", label="abs")

    @override
    def measure(self, compared: Compared) -> float | None:
        error = (compared.render.double() - compared.photo.double()).abs().mean(dim=2) / 255.0
        if compared.mask is not None:
            error = error[compared.mask]
        return float(error.mean()) if error.numel() else None
