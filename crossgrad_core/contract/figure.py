"""The description of a metric in the results: its name and its format.

This module imports no large package, so that results can be read without torch.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """A metric that is measured for each view; the results contain its means.

    Attributes:
        name: Name of the metric in every file of results, such as a column of metrics.csv.
        label: Name of the metric in tables.
        form: Number format of the metric in tables.
        per_regime: True if metrics.csv contains one column of this metric for every regime.
        definition: How the metric is computed, for summary.json; empty if the name is clear enough.
        undefined: Reason why the metric may be undefined for a view although the view has pixels to
            compare.
        falls: True if a lower value is better.
    """

    name: str
    label: str
    form: str = ".4f"
    per_regime: bool = False
    definition: str = ""
    undefined: str = "the metric is not defined for these views"
    falls: bool = False

    def column(self, regime: str) -> str:
        """Return the name of the metric's column in metrics.csv for one regime."""
        return f"{self.name}_{regime}"
