"""Which run of an arm stands for a scene and a seed, when there are several lengths."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from crossgrad_plugins.compare.arms import Arm
from crossgrad_plugins.compare.run import Run, text_of

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

        It has the length that most runs on the scene have, the longer one of two, or else the one
        that the arm has more than twice as often there. An arm that has no run of the usual length
        on a scene stands there with its own lengths, the longest of several.
        """
        chosen = self._chosen()
        return {
            arm: {
                problem: by[length]
                for problem, by in problems.items()
                if (length := chosen.get((arm, problem[0]), max(by, key=_amount))) in by
            }
            for arm, problems in self.runs.items()
        }

    @property
    def unlike(self) -> dict[str, str]:
        """Name of a run -> why it stands for nothing, though its arm has no other run there."""
        chosen = self._chosen()
        return {
            run.name: f"has {run.length_text}, other runs of {arm} on {scene} {text_of(length)}"
            for arm, problems in self.runs.items()
            for (scene, _), by in problems.items()
            if (length := chosen.get((arm, scene))) is not None and length not in by
            for run in by.values()
        }

    def _chosen(self) -> dict[tuple[str, str], Length]:
        """Arm and scene -> the length of the runs that stand there; not where it has none."""
        usual: dict[str, Counter[Length]] = {}
        own: dict[tuple[str, str], Counter[Length]] = {}
        for arm, problems in self.runs.items():
            for (scene, _), by in problems.items():
                usual.setdefault(scene, Counter()).update(by.keys())
                own.setdefault((arm, scene), Counter()).update(by.keys())
        most = {scene: max(n, key=lambda x: (n[x], _amount(x))) for scene, n in usual.items()}
        return {
            (arm, scene): _preferred(counts, most[scene])
            for (arm, scene), counts in own.items()
            if most[scene] in counts
        }

    def _all(self) -> list[Run]:
        return [
            run
            for problems in self.runs.values()
            for by in problems.values()
            for run in by.values()
        ]


def _amount(length: Length) -> float:
    return length[1]


def _preferred(counts: Mapping[Length, int], usual: Length) -> Length:
    """The usual length, or one that there is more than twice as often."""
    own = max(counts, key=lambda length: (counts[length], _amount(length)))
    return own if counts[own] > 2 * counts[usual] else usual
