"""A fuzzing target: a parser, valid files for it, and the functions that it consists of."""

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

from crossgrad_fuzz.case import MOST_BYTES, Case

#: Changes one file's bytes.
Mutator = Callable[[bytes, random.Random], bytes]
#: Changes a case as a whole.
CaseMutator = Callable[[dict[str, bytes], random.Random], dict[str, bytes]]


def unchanged(case: dict[str, bytes], rng: random.Random) -> dict[str, bytes]:
    """No repair."""
    return case


def nothing(folder: Path) -> None:
    """No further files."""


@dataclass(frozen=True)
class Target:
    """A parser under test.

    Attributes:
        name: What it is called.
        seeds: Makes the valid inputs.
        parse: Reads the files in a folder; asserts that what comes back is valid.
        parser: Module -> its functions that write or do something else than parsing, left out of
            the coverage. A name covers what is defined inside of it.
        words: Pieces of the format, to insert.
        mutators: Changes that know the format of a file.
        case_mutators: Changes that know how the files belong together.
        repair: Mends checksums and lengths after a mutation, so that it is not refused at once.
        prepare: Writes further, constant files into the folder.
        writes: Files that the parser may replace where it succeeds.
        quiet: Whether a warning counts as a finding.
        seconds: CPU seconds for one execution.
        mebibytes: Memory that one execution may take.
        most_bytes: Mutated files are cut there.
    """

    name: str
    seeds: Callable[[], Sequence[Case]]
    parse: Callable[[Path], object]
    parser: Mapping[ModuleType, tuple[str, ...]]
    words: tuple[bytes, ...] = ()
    mutators: tuple[Mutator, ...] = ()
    case_mutators: tuple[CaseMutator, ...] = ()
    repair: CaseMutator = unchanged
    prepare: Callable[[Path], None] = nothing
    writes: frozenset[str] = field(default_factory=frozenset)
    quiet: bool = True
    seconds: float = 2.0
    mebibytes: int = 256
    most_bytes: int = MOST_BYTES
