"""The options of `crossgrad compare`."""

from dataclasses import dataclass
from pathlib import Path

from crossgrad_core.commands import argument, option
from crossgrad_plugins.compare.quantity import ClockChoice

_WHAT = "What is compared"
_ARMS = "Arms"


@dataclass(frozen=True, kw_only=True)
class Options:
    """How runs are compared."""

    metric: str = option("psnr", "The figure that is compared.", "NAME", heading=_WHAT)
    margin: float | None = option(
        None,
        "What counts as no difference; fix it before you look. Default: 0.1 dB, 0.005 of SSIM and "
        "LPIPS.",
        "X",
        heading=_WHAT,
        min=1e-9,
    )
    clock: ClockChoice = option(
        ClockChoice.AUTO,
        "Seconds of the clock, of the processor, or none. auto: of the clock if all runs had one "
        "quiet machine, else of the processor.",
        heading=_WHAT,
    )
    target: float | None = option(
        None,
        "Quality to reach. Default: on each scene what the weakest arm ends with.",
        "X",
        heading=_WHAT,
    )
    baseline: str | None = option(
        None,
        "Compare the other arms with this one only. Default: all with all.",
        "ARM",
        heading=_ARMS,
    )
    name: list[str] | None = option(
        None, "Another name for an arm, repeatable.", "OLD:NEW", heading=_ARMS
    )


@dataclass(frozen=True, kw_only=True)
class Command(Options):
    """All options of the command: the comparison, its runs, and the output folder."""

    runs: list[Path] = argument(
        "RUN...|FOLDER", "Folders of runs, or folders with runs below, such as that of a sweep."
    )
    out: Path | None = option(
        None,
        "Folder for the page, the figures and the tables; an earlier comparison in it is "
        "replaced, nothing else is. Default: compare, beside the runs.",
        "DIR",
    )
    skip_broken: bool = option(
        False, "Leave out runs with damaged files, and list them.", flag="--skip-broken"
    )
