"""Arms: runs that differ in nothing but scene, seed and length, by scene and seed."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

from crossgrad_core.commands import UserError
from crossgrad_plugins.compare.run import ABSENT, Run, Settings, text_of

#: What names an arm if it can, before anything else that differs.
_FIRST: Final = (
    *("backbone", "views_per_step", "sampler", "operator", "densifier"),
    *("rate_factor", "densify_views", "schedule", "schedule_length", "schedule_unit"),
    *("exposure", "loss", "resolution", "recipe", "backward"),
)
#: Settings that people know by another name.
_SPOKEN: Final = {"views_per_step": "views"}
_DIGITS: Final = re.compile(r"(\d+)")
#: Scene and seed.
Problem: TypeAlias = tuple[str, int]
Length: TypeAlias = tuple[str, float]


@dataclass(frozen=True, eq=False)
class Arm:
    """One of the things that are compared.

    Attributes:
        name: Its name.
        runs: Its runs that finished, of any length.
        failed: Its runs that failed.
        settings: Setting -> value, of those in which arms differ.
    """

    name: str
    runs: tuple[Run, ...]
    failed: tuple[Run, ...]
    settings: Mapping[str, str]


def arms_of(runs: Sequence[Run], failed: Sequence[Run] = ()) -> tuple[Arm, ...]:
    """The arms, in the order of their names.

    Runs belong together that agree in every setting which varies within a scene: what depends on
    the scene alone, such as a degree that its data cannot support, makes no arm. Where each run
    has a label of a sweep, those of one label belong together, unless it stands for several
    configurations on one scene, as labels of two sweeps do: then their settings tell them apart.

    Args:
        runs: The runs that finished; at least one.
        failed: Those that failed.
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
    """The runs of each arm with its name; no two of these are the same."""
    if all(run.label for run in runs):
        found = _by_labels(runs)
        if len({name for name, _ in found}) == len(found):
            return found
    # A run with two labels is there twice.
    return _by_settings(list({run.name: run for run in runs}.values()))


def _by_labels(runs: Sequence[Run]) -> list[tuple[str, list[Run]]]:
    labelled: dict[str, list[Run]] = {}
    for run in runs:
        labelled.setdefault(str(run.label), []).append(run)
    found = []
    for label, own in labelled.items():
        parts = _by_settings(own)
        if len(parts) == 1:
            found.append((label, own))
        elif len(labelled) == 1:
            found += parts
        else:
            found += [(f"{label}, {name}", members) for name, members in parts]
    return found


def _by_settings(runs: Sequence[Run]) -> list[tuple[str, list[Run]]]:
    keys = _varying(runs)
    groups: dict[tuple[str, ...], list[Run]] = {}
    for run in runs:
        groups.setdefault(_values(run.settings, keys), []).append(run)
    names = _names(groups, keys)
    return [(names[values], members) for values, members in groups.items()]


def renamed(arms: Sequence[Arm], names: Sequence[str]) -> tuple[Arm, ...]:
    """The arms with names that the user gives.

    Args:
        arms: The arms.
        names: `OLD:NEW` texts.

    Raises:
        UserError: A text names no arm, or two arms would have one name.
    """
    new = {arm.name: arm.name for arm in arms}
    for text in names:
        fitting = (arm.name for arm in arms if text.startswith(f"{arm.name}:"))
        old = max(fitting, key=len, default=None)
        if old is None or text == f"{old}:":
            raise UserError(
                "no arm has this name",
                where="--name",
                expected=f"OLD:NEW with one of {'; '.join(new)}",
                found=text,
                todo="copy the old name from the table that compare prints",
            )
        new[old] = text[len(old) + 1 :]
    if len(set(new.values())) < len(new):
        raise UserError(
            "two arms would have one name",
            where="--name",
            found="; ".join(new.values()),
            todo="give each arm a name of its own",
        )
    return tuple(Arm(new[arm.name], arm.runs, arm.failed, arm.settings) for arm in arms)


def _varying(runs: Iterable[Run]) -> tuple[str, ...]:
    """Settings that have two values or more within a scene, the telling ones first.

    An option that only some runs have does not count: it belongs to a component that the others
    lack, which differs itself, or to another version.
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
    """The first settings that tell all groups apart; none that adds nothing to those before."""
    if len(groups) == 1:
        return {key: _of_one(runs[0]) for key, runs in groups.items()}
    chosen: list[int] = []
    for index in range(len(keys)):
        if _distinguished(groups, [*chosen, index]) > _distinguished(groups, chosen):
            chosen.append(index)
    return {key: _name(keys, key, chosen) for key in groups}


def _name(keys: Sequence[str], values: tuple[str, ...], chosen: Sequence[int]) -> str:
    """What is set of the chosen settings; an option of a component that is not there is not."""
    known = [index for index in chosen if values[index] != ABSENT]
    return ", ".join(_part(keys[index], values[index]) for index in known or chosen)


def _distinguished(groups: Iterable[tuple[str, ...]], chosen: Sequence[int]) -> int:
    return len({tuple(key[index] for index in chosen) for key in groups})


def _part(key: str, value: str) -> str:
    return f"{_SPOKEN.get(key, key)}={'none' if value == ABSENT else value}"


def _of_one(run: Run) -> str:
    """What the only arm is called: the parts that make it."""
    named = [run.settings.get(key, "") for key in ("backbone", "sampler", "operator")]
    return ", ".join([*filter(None, named), f"views={run.settings.get('views_per_step', '?')}"])


def _natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts numbers by their size."""
    return [
        (int(part), "") if part.isdecimal() else (-1, part) for part in _DIGITS.split(name) if part
    ]


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
