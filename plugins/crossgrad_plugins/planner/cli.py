"""`crossgrad plan`: decisions about a run, from the evidence of its scene."""

from dataclasses import dataclass
from pathlib import Path

from crossgrad_core.commands import announce, argument, command_of, option

_RUN = "Run (the planner does not change settings that you give here)"
_RESULTS = "Results"


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    scene: Path | None = argument(
        "SCENE", "Scene folder. Default: the bundled example scene.", default=None
    )
    probe: float | None = option(
        None,
        "Also train for this many seconds and measure gradients: noise scale, "
        "variance between near and far, conflict.",
        "SECONDS",
        min=1.0,
    )
    config: Path | None = option(None, "YAML file of settings for the run.", "FILE", heading=_RUN)
    assignments: list[str] | None = option(
        None,
        "One setting of the run, such as exposure=none or backbone.sh_degree=3. Repeatable.",
        "KEY=VALUE",
        heading=_RUN,
        flag="--set",
    )
    seconds: float | None = option(None, "Training seconds of the run.", "S", heading=_RUN, min=0.0)
    steps: int | None = option(None, "Steps of the run.", "N", heading=_RUN, min=1)
    max_size: int | None = option(
        None, "Longest image side; larger photos are resized.", "PIXELS", heading=_RUN
    )
    device: str | None = option(
        None, "Device of the tensors. Default: auto.", "auto|cpu|cuda|cuda:N", heading=_RUN
    )
    threads: int | None = option(None, "Number of CPU threads. Default: all.", "N", heading=_RUN)
    as_json: bool = option(False, "Print all values as JSON.", heading=_RESULTS, flag="--json")
    write: Path | None = option(
        None,
        "Write the settings to this file, for `crossgrad run --config FILE`.",
        "FILE",
        heading=_RESULTS,
    )


@command_of(Options)
def plan(given: Options) -> None:
    """Decide which components a run needs, and show the evidence.

    The command reads cameras, photos, SfM points and tracks. It trains only with --probe. A table
    shows each decision, its evidence, the cost that it saves, and the option that overrides it. If
    evidence is missing, the decision is the default. `crossgrad run` makes the same decisions,
    unless `--plan off` is given. `crossgrad recipes show` lists the decisions of the recipe.
    """
    announce(quiet=given.as_json)
    from crossgrad_plugins.planner import app

    options = {
        "scene": None if given.scene is None else str(given.scene),
        "seconds": given.seconds,
        "steps": given.steps,
        "max_size": given.max_size,
        "device": given.device,
        "threads": given.threads,
    }
    made, way = app.plan(given.config, options, given.assignments or [], given.probe, given.write)
    app.show(made, way, as_json=given.as_json)
