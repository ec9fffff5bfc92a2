"""The core is the smaller part of what ships: what can be a plugin stands on a shelf."""

from support.imports import CORE, modules

#: Share of the shipped lines, and lines, that the core may have.
LARGEST_SHARE, MOST_LINES = 0.46, 32_110


def lines_of(core):
    """Lines of all modules inside, or outside, the core."""
    return sum(
        len(path.read_text(encoding="utf-8").splitlines())
        for name, path in modules().items()
        if (name.split(".")[0] == CORE) == core
    )


def test_the_core_has_its_share_of_the_lines():
    core, shelves = lines_of(core=True), lines_of(core=False)
    assert core <= LARGEST_SHARE * (core + shelves), f"{core} of {core + shelves}"


def test_the_core_has_its_number_of_lines():
    assert lines_of(core=True) <= MOST_LINES
