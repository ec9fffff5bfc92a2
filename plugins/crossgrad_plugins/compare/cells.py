"""Which run of an arm stands for a scene and a seed, when there are several lengths."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from crossgrad_plugins.compare.arms import Arm
from crossgrad_plugins.compare.run import Run

#: Scene and seed.
Problem: TypeAlias = tuple[str, int]
Length: TypeAlias = tuple[str, float]


@dataclass(frozen=True, eq=False)
class Cells:
    """The runs of all arms by scene, seed and length.

    Attributes:
        runs: Arm -> scene and seed -> length -> run.
        repetitions: Folder -> the folder that it repeats, which stands for both.
    """

    runs: Mapping[str, Mapping[Problem, Mapping[Length, Run]]]
    repetitions: Mapping[str, str]

    @classmethod
    def of(cls, arms: Sequence[Arm]) -> "Cells":
        """Sorts the runs in."""
        runs: dict[str, dict[Problem, dict[Length, Run]]] = {}
        repetitions: dict[str, str] = {}
        for arm in arms:
            own = runs.setdefault(arm.name, {})
            for run in arm.runs:
                kept = own.setdefault((run.scene, run.seed), {}).setdefault(run.length, run)
                if kept is not run:
                    repetitions[run.name] = kept.name
        return cls(runs, repetitions)

    @property
    def lengths(self) -> tuple[Length, ...]:
        """All lengths, by unit and from short to long."""
        return tuple(sorted({run.length for run in self._all()}))

    @property
    def several(self) -> bool:
        """Whether an arm has a scene and seed at several lengths."""
        return any(len(by) > 1 for problems in self.runs.values() for by in problems.values())

    def at(self, length: Length) -> dict[str, dict[Problem, Run]]:
        """Arm -> scene and seed -> run of that length."""
        return {
            arm: {problem: by[length] for problem, by in problems.items() if length in by}
            for arm, problems in self.runs.items()
        }

    def main(self) -> dict[str, dict[Problem, Run]]:
        """Arm -> scene and seed -> the run that stands for them.

        It has the length that most scenes and seeds of all arms have, the longer one of two; or
        else the length that is its own, the longest of several.
        """
        counts = Counter(run.length for run in self._all())
        usual = max(counts, key=lambda length: (counts[length], length[1]))
        return {
            arm: {
                problem: by.get(usual, by[max(by, key=lambda length: length[1])])
                for problem, by in problems.items()
            }
            for arm, problems in self.runs.items()
        }

    def _all(self) -> list[Run]:
        return [
            run
            for problems in self.runs.values()
            for by in problems.values()
            for run in by.values()
        ]
