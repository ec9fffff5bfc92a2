"""A figure of the results: its name and how it is shown. Imports nothing heavy."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """One figure of a view, of which results hold means.

    Attributes:
        name: Its name in every file of results, such as a column of metrics.csv.
        label: What tables call it.
        form: How tables format it.
        per_regime: Whether metrics.csv has a column of it for every regime.
        definition: How it is computed, for summary.json; empty where the name says it all.
        undefined: Why a view that has pixels to compare may have none.
        falls: Whether less of it is better.
    """

    name: str
    label: str
    form: str = ".4f"
    per_regime: bool = False
    definition: str = ""
    undefined: str = "not defined for these views"
    falls: bool = False

    def column(self, regime: str) -> str:
        """Its column in metrics.csv for one regime."""
        return f"{self.name}_{regime}"
