"""Which branches of a parser the inputs reach, and whether an input reaches any for the first time.

Coverage.py's tracer does the watching: it costs about half of an execution, where a tracer in
Python costs four.
"""

import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import coverage


@dataclass(frozen=True)
class Reach:
    """How much of a parser was run.

    Attributes:
        branches: Number of branches.
        taken: Those that were taken.
        missing: `file:function` -> pairs of lines that never followed each other.
    """

    branches: int
    taken: int
    missing: Mapping[str, list[list[int]]]

    @property
    def share(self) -> float:
        """Share of the branches that were taken."""
        return self.taken / self.branches if self.branches else 1.0


class Guide:
    """Watches the functions of a parser.

    Args:
        parser: Module -> functions that do not count.
    """

    def __init__(self, parser: Mapping[ModuleType, tuple[str, ...]]) -> None:
        self._parser = {str(module.__file__): names for module, names in parser.items()}
        self._coverage = coverage.Coverage(
            data_file=None, branch=True, include=list(self._parser), config_file=False
        )
        self._known = 0

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Counts what runs inside."""
        self._coverage.start()
        try:
            yield
        finally:
            self._coverage.stop()

    def news(self) -> bool:
        """Whether two lines followed each other that never did when this was last asked."""
        # What `get_data` would hand out, without the cost of writing it down each time.
        arcs = sum(map(len, self._coverage._collector.data.values()))  # type: ignore[union-attr]
        known, self._known = self._known, arcs
        return arcs > known

    def reach(self) -> Reach:
        """What was reached so far; ask it when the watching has ended."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "coverage.json"
            self._coverage.json_report(outfile=str(path))
            files: dict[str, Any] = json.loads(path.read_text())["files"]
        branches = taken = 0
        missing: dict[str, list[list[int]]] = {}
        for file, found in files.items():
            left_out = next(
                n for f, n in self._parser.items() if Path(f).resolve() == Path(file).resolve()
            )
            for name, region in found["functions"].items():
                # The region without a name is what runs at import.
                if name == "" or name.split(".")[0] in left_out or name in left_out:
                    continue
                branches += region["summary"]["num_branches"]
                taken += region["summary"]["covered_branches"]
                if region["missing_branches"]:
                    missing[f"{Path(file).name}:{name}"] = region["missing_branches"]
        return Reach(branches, taken, missing)
