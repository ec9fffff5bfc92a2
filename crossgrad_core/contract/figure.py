"""A figure of the results: its name and its format. Imports no large package."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """One figure that is measured for each view; results contain its means.

    Attributes:
        name: Its name in every file of results, such as a column of metrics.csv.
        label: Its name in tables.
        form: Its number format in tables.
        per_regime: True if metrics.csv contains one column of this figure for every regime.
        definition: How it is computed, for summary.json; empty if the name is clear enough.
        undefined: Why the figure may be undefined for a view that has pixels to compare.
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
        """Return the name of its column in metrics.csv for one regime."""
        return f"{self.name}_{regime}"
