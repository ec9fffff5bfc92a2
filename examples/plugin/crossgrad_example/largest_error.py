"""A metric: the largest error of a view."""

from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import Compared, Figure, Metric


class LargestError(Metric):
    """The largest difference over all channels and pixels that count, in grey levels."""

    figure: ClassVar[Figure] = Figure(
        "largest_error", "largest error", form=".0f", definition="grey levels, mean over images"
    )

    @override
    def measure(self, compared: Compared) -> float | None:
        difference = (compared.render.int() - compared.photo.int()).abs()
        if compared.mask is not None:
            difference = difference[compared.mask]
        return float(difference.max()) if difference.numel() else None
