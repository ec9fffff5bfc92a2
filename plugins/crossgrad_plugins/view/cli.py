"""The command `crossgrad view` and its options."""

from dataclasses import dataclass
from pathlib import Path

from crossgrad_core.commands import announce, argument, command_of, option


@dataclass(frozen=True)
class Given:
    """The options of the command."""

    path: Path = argument(
        "RUN|FILE|SCENE", "Folder of a run, file of Gaussians, or folder of a scene."
    )
    other: Path | None = argument(
        "RUN|FILE", "A second run or file to compare with the first.", default=None
    )
    host: str = option(
        "127.0.0.1",
        "Address to listen on. The default is reached from this machine only; use an SSH tunnel "
        "to view from another machine.",
        "ADDRESS",
    )
    port: int = option(8080, "Port to listen on.", "N", min=1, max=65_535)
    device: str | None = option(
        None,
        "Device of the tensors. Default: the device of the run, or the CPU.",
        "auto|cpu|cuda|cuda:N",
    )
    threads: int | None = option(None, "Number of CPU threads. Default: all.", "N")
    accept_scene: bool = option(
        False,
        "Continue although photos, masks, points or held-out views of the scene have changed.",
        flag="--accept-scene",
    )


@command_of(Given)
def view(given: Given) -> None:
    """Show a run, a file of Gaussians or a scene in a browser.

    Ctrl-C ends the viewer. With two runs, a split line compares their renders. The photos of the
    scene, the error and the depth are further layers.
    """
    announce()
    from crossgrad_plugins.view.server import Viewer, check_address, check_viser

    # Check before reading, because a large run takes long to read.
    check_viser()
    check_address(given.host, given.port)
    from crossgrad_plugins.view.app import How, serve, stage_of, warm_up

    paths = [given.path] if given.other is None else [given.path, given.other]
    stage = stage_of(paths, How(given.device, given.threads, given.accept_scene))
    warm_up(stage)
    viewer = Viewer(stage, given.host, given.port)
    print(f"viewer at {viewer.url} (Ctrl-C ends it)", flush=True)  # noqa: T201
    serve(viewer)
