"""The options of `crossgrad compare`."""

from dataclasses import dataclass
from pathlib import Path

from crossgrad_core.commands import argument, option
from crossgrad_plugins.compare.quantity import ClockChoice

_WHAT = "Comparison"
_ARMS = "Arms"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the comparison itself."""

    metric: str = option("psnr", "Metric to compare.", "NAME", heading=_WHAT)
    margin: float | None = option(
        None,
        "Differences below this margin count as none; choose it before you look at "
        "results. Default: 0.1 dB, 0.005 of SSIM and LPIPS.",
        "X",
        heading=_WHAT,
        min=1e-9,
    )
    clock: ClockChoice = option(
        ClockChoice.AUTO,
        "Wall-clock seconds, CPU seconds, or none. auto: wall-clock seconds if all "
        "runs had the same quiet machine, else CPU seconds.",
        heading=_WHAT,
    )
    target: float | None = option(
        None,
        "Target quality for the time to quality. Default: on each scene, the final "
        "quality of the worst arm.",
        "X",
        heading=_WHAT,
    )
    baseline: str | None = option(
        None,
        "Compare the other arms only with this arm. Default: all pairs of arms.",
        "ARM",
        heading=_ARMS,
    )
    name: list[str] | None = option(None, "Rename an arm. Repeatable.", "OLD:NEW", heading=_ARMS)


@dataclass(frozen=True, kw_only=True)
class Command(Options):
    """All options of the command: comparison, runs and output folder."""

    runs: list[Path] = argument(
        "RUN...|FOLDER",
        "Folders of runs, or folders that contain runs, such as the folder of a sweep.",
    )
    out: Path | None = option(
        None,
        "Folder for the page, the figures and the tables; it may contain only an "
        "earlier comparison, which is replaced. Default: the folder compare next to "
        "the runs.",
        "DIR",
    )
    skip_broken: bool = option(
        False, "Ignore runs with damaged files, and list them.", flag="--skip-broken"
    )
