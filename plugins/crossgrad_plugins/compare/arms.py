"""Arms: groups of runs that differ only in scene, seed and length."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

from crossgrad_core.commands import UserError
from crossgrad_plugins.compare.run import ABSENT, Run, Settings, text_of

#: Settings that come first in the names of arms, if their values differ between the arms.
_FIRST: Final = (
    *("backbone", "views_per_step", "sampler", "operator", "densifier"),
    *("rate_factor", "densify_views", "schedule", "schedule_length", "schedule_unit"),
    *("exposure", "loss", "resolution", "recipe", "backward"),
)
#: Settings that have a shorter name in the names of arms.
_SPOKEN: Final = {"views_per_step": "views"}
_DIGITS: Final = re.compile(r"(\d+)")
#: Name of a scene, and a seed.
Problem: TypeAlias = tuple[str, int]
Length: TypeAlias = tuple[str, float]


@dataclass(frozen=True, eq=False)
class Arm:
    """A group of runs that is compared with other groups.

    Attributes:
        name: Name of the arm.
        runs: The finished runs of the arm, of any length.
        failed: The failed runs of the arm.
        settings: Setting -> value of this arm, for all settings whose values differ between arms.
    """

    name: str
    runs: tuple[Run, ...]
    failed: tuple[Run, ...]
    settings: Mapping[str, str]


def arms_of(runs: Sequence[Run], failed: Sequence[Run] = ()) -> tuple[Arm, ...]:
    """Group runs into arms; return the arms in the order of their names.

    The runs of an arm agree in every setting whose values differ within a scene. If a setting
    differs only between scenes, it does not separate arms. An example is an SH degree that the data
    of a scene cannot support. If every run has a label from a sweep, runs with equal labels form an
    arm. If a label covers several configurations on one scene, for example after two sweeps, the
    settings separate these configurations.

    Args:
        runs: The finished runs; at least one.
        failed: The failed runs.
    """
    everything = [*runs, *failed]
    keys = _varying(everything)
    finished = set(runs)
    arms = [
        Arm(
            name=name,
            runs=tuple(run for run in members if run in finished),
            failed=tuple(run for run in members if run not in finished),
            settings=dict(zip(keys, _values(members[0].settings, keys), strict=True)),
        )
        for name, members in _grouped(everything)
    ]
    return tuple(sorted(arms, key=lambda arm: _natural(arm.name)))


def _grouped(runs: Sequence[Run]) -> list[tuple[str, list[Run]]]:
    """Return the name and the runs of each arm; all names differ."""
    if all(run.label for run in runs):
        arms = _by_labels(runs)
        if len({name for name, _ in arms}) == len(arms):
            return arms
    # A run with two labels is listed twice, so keep it only once.
    return _by_settings(list({run.name: run for run in runs}.values()))


def _by_labels(runs: Sequence[Run]) -> list[tuple[str, list[Run]]]:
    labelled: dict[str, list[Run]] = {}
    for run in runs:
        labelled.setdefault(str(run.label), []).append(run)
    arms = []
    for label, group in labelled.items():
        parts = _by_settings(group)
        if len(parts) == 1:
            arms.append((label, group))
        elif len(labelled) == 1:
            arms += parts
        else:
            arms += [(f"{label}, {name}", members) for name, members in parts]
    return arms


def _by_settings(runs: Sequence[Run]) -> list[tuple[str, list[Run]]]:
    keys = _varying(runs)
    groups: dict[tuple[str, ...], list[Run]] = {}
    for run in runs:
        groups.setdefault(_values(run.settings, keys), []).append(run)
    names = _names(groups, keys)
    return [(names[values], members) for values, members in groups.items()]


def renamed(arms: Sequence[Arm], names: Sequence[str]) -> tuple[Arm, ...]:
    """Rename arms as the user requests.

    Args:
        arms: The arms.
        names: Texts `OLD:NEW`.

    Raises:
        UserError: A text names no existing arm, or two arms would have the same name.
    """
    new = {arm.name: arm.name for arm in arms}
    for text in names:
        fitting = (arm.name for arm in arms if text.startswith(f"{arm.name}:"))
        old = max(fitting, key=len, default=None)
        if old is None or text == f"{old}:":
            raise UserError(
                "--name renames an arm that does not exist",
                where="--name",
                expected=f"OLD:NEW with one of {'; '.join(new)}",
                found=text,
                todo="copy the old name from the table that compare prints",
            )
        new[old] = text[len(old) + 1 :]
    if len(set(new.values())) < len(new):
        raise UserError(
            "two arms would have the same name",
            where="--name",
            found="; ".join(new.values()),
            todo="give each arm a different name",
        )
    return tuple(Arm(new[arm.name], arm.runs, arm.failed, arm.settings) for arm in arms)


def _varying(runs: Iterable[Run]) -> tuple[str, ...]:
    """Return the settings that have several values within a scene, most important first.

    A setting that is missing in some runs is ignored. It either belongs to another version, or is
    an option of a component that only some runs use. The component's name then separates the runs.
    """
    seen: dict[tuple[str, str], set[str]] = {}
    for run in runs:
        for key, value in run.settings.items():
            seen.setdefault((key, run.scene), set()).add(value)
    varying = {key for (key, _), values in seen.items() if len(values) > 1}
    rest = sorted(varying - set(_FIRST), key=lambda key: (key.count("."), key))
    return (*(key for key in _FIRST if key in varying), *rest)


def _values(settings: Settings, keys: Sequence[str]) -> tuple[str, ...]:
    return tuple(settings.get(key, ABSENT) for key in keys)


def _names(
    groups: Mapping[tuple[str, ...], Sequence[Run]], keys: Sequence[str]
) -> dict[tuple[str, ...], str]:
    """Name each group by the fewest settings, taken in order, that distinguish all groups."""
    if len(groups) == 1:
        return {key: _of_one(runs[0]) for key, runs in groups.items()}
    chosen: list[int] = []
    for index in range(len(keys)):
        if _distinguished(groups, [*chosen, index]) > _distinguished(groups, chosen):
            chosen.append(index)
    return {key: _name(keys, key, chosen) for key in groups}


def _name(keys: Sequence[str], values: tuple[str, ...], chosen: Sequence[int]) -> str:
    """Return the chosen settings as a name, without options of components that are not used."""
    present = [index for index in chosen if values[index] != ABSENT]
    return ", ".join(_part(keys[index], values[index]) for index in present or chosen)


def _distinguished(groups: Iterable[tuple[str, ...]], chosen: Sequence[int]) -> int:
    return len({tuple(key[index] for index in chosen) for key in groups})


def _part(key: str, value: str) -> str:
    return f"{_SPOKEN.get(key, key)}={'none' if value == ABSENT else value}"


def _of_one(run: Run) -> str:
    """Return the name of a single arm: its backbone, sampler, operator and views per step."""
    named = [run.settings.get(key, "") for key in ("backbone", "sampler", "operator")]
    return ", ".join([*filter(None, named), f"views={run.settings.get('views_per_step', '?')}"])


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key that orders numbers in names by their value."""
    return [
        (int(part), "") if part.isdecimal() else (-1, part) for part in _DIGITS.split(name) if part
    ]


@dataclass(frozen=True, eq=False)
class Cells:
    """The runs of all arms by scene, seed and length.

    Attributes:
        runs: Arm -> scene and seed -> length -> run.
        repetitions: Folder of a repeated run -> folder of the run that replaces it.
    """

    runs: Mapping[str, Mapping[Problem, Mapping[Length, Run]]]
    repetitions: Mapping[str, str]

    @classmethod
    def of(cls, arms: Sequence[Arm]) -> "Cells":
        """Sort the runs of the arms by scene, seed and length."""
        runs: dict[str, dict[Problem, dict[Length, Run]]] = {}
        repetitions: dict[str, str] = {}
        for arm in arms:
            by_problem = runs.setdefault(arm.name, {})
            for run in arm.runs:
                kept = by_problem.setdefault((run.scene, run.seed), {}).setdefault(run.length, run)
                if kept is not run:
                    repetitions[run.name] = kept.name
        return cls(runs, repetitions)

    @property
    def lengths(self) -> tuple[Length, ...]:
        """All lengths, ordered by unit, then from short to long."""
        return tuple(sorted({run.length for run in self._all()}))

    @property
    def several(self) -> bool:
        """True if an arm has runs of several lengths for a scene and a seed."""
        return any(len(by) > 1 for problems in self.runs.values() for by in problems.values())

    def at(self, length: Length) -> dict[str, dict[Problem, Run]]:
        """Return the runs of a length: arm -> scene and seed -> run."""
        return {
            arm: {problem: by[length] for problem, by in problems.items() if length in by}
            for arm, problems in self.runs.items()
        }

    def main(self) -> dict[str, dict[Problem, Run]]:
        """Return the runs that represent each scene and seed: arm -> scene and seed -> run.

        A scene is represented by the runs of its most frequent length. Of two equally frequent
        lengths, the longer one is used. An arm uses another length on a scene if it has more than
        twice as many runs of this length there. If an arm has no run of the most frequent length,
        its longest run represents each scene and seed.
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
        """Name of a run -> why the run is not used, if no other run of its arm replaces it."""
        chosen = self._chosen()
        return {
            run.name: (
                f"has {run.length_text}, but other runs of {arm} on {scene} have {text_of(length)}"
            )
            for arm, problems in self.runs.items()
            for (scene, _), by in problems.items()
            if (length := chosen.get((arm, scene))) is not None and length not in by
            for run in by.values()
        }

    def _chosen(self) -> dict[tuple[str, str], Length]:
        """Return the length that is used for each arm and scene.

        An arm without a run of the most frequent length has no entry.
        """
        scene_counts: dict[str, Counter[Length]] = {}
        arm_counts: dict[tuple[str, str], Counter[Length]] = {}
        for arm, problems in self.runs.items():
            for (scene, _), by in problems.items():
                scene_counts.setdefault(scene, Counter()).update(by.keys())
                arm_counts.setdefault((arm, scene), Counter()).update(by.keys())
        most = {
            scene: max(n, key=lambda x: (n[x], _amount(x))) for scene, n in scene_counts.items()
        }
        return {
            (arm, scene): _preferred(counts, most[scene])
            for (arm, scene), counts in arm_counts.items()
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


def _preferred(counts: Mapping[Length, int], usual_length: Length) -> Length:
    """Return the most frequent length, or one with more than twice as many runs in this arm."""
    most_common = max(counts, key=lambda length: (counts[length], _amount(length)))
    return most_common if counts[most_common] > 2 * counts[usual_length] else usual_length
