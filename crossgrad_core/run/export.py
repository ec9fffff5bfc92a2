"""Export of the trained scene to a file, and the loss of quality if the file approximates it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from json import dumps
from math import fsum
from pathlib import Path
from typing import Final

import torch
from torch import Tensor

from crossgrad_core.contract.blocks import Json
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.georeference import COORDINATES_TAG, INPUT, LOCAL, Placed
from crossgrad_core.contract.scene import Camera, View
from crossgrad_core.contract.slots.exporter import ExportContent, Exporter
from crossgrad_core.defaults import PAGE_EXPORTER
from crossgrad_core.errors import UserError
from crossgrad_core.evaluation.evaluation import compare, psnr
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.run.export_edits import Crop, camera_in, most_important, upright, with_degree
from crossgrad_core.system.files import write_atomically
from crossgrad_core.system.text_files import read_json
from crossgrad_core.training.per_image_params import apply
from crossgrad_core.training.rules import eval_parameters
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.views import eval_background

#: A run writes no page that could be larger than this. The size is that of an attachment to a mail.
MOST_PAGE_BYTES: Final = 25_000_000


@dataclass(frozen=True)
class Exported:
    """The contents of an exported file.

    Attributes:
        gaussians: Number of Gaussians.
        baked_for: The view that the file was baked for, or `N training views` for their average;
            None if no baking was needed.
        views: Number of views on which the file was compared with the live model: the view that it
            was baked for, else the held-out views.
        psnr: Mean PSNR in dB over these views, for the Gaussians of the file on black, as in
            viewers. None if the live model has the same Gaussians on the same background, or if
            there are no such views.
        live_psnr: Mean PSNR in dB over these views, for the live model on its own background.
        background: Name of the live model's background if it is not black; no file stores it.
        notes: Messages for the user about the file.
    """

    gaussians: int
    baked_for: str | None = None
    views: int = 0
    psnr: float | None = None
    live_psnr: float | None = None
    background: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def loss(self) -> float | None:
        """The loss of PSNR in dB by the file: its precision, its options, baking and background."""
        if self.psnr is None or self.live_psnr is None:
            return None
        return self.live_psnr - self.psnr

    def as_data(self) -> dict[str, Json]:
        """Return the values for summary.json."""
        values = {name: value for name, value in vars(self).items() if name != "notes"}
        return {**values, "loss": self.loss}


@dataclass(frozen=True, eq=False)
class ExportOptions:
    """The options of an export.

    Attributes:
        camera: Name of the view for which view-dependent parts are baked; None for the average
            over the training views.
        coordinates: Coordinates of the file, as `check_coordinates` accepts them; None for those
            of the exporter.
        up: The axis of the file that points up, `y`, `z` or `input`; None for that of the
            exporter.
        sh_degree: Highest degree of spherical harmonics in the file; None for all.
        crop: The part of space to export; None for all.
        max_gaussians: Number of Gaussians to keep, those that contribute most to the training
            photos; None for all.
        baked: False to store Gaussians with the backbone's own response, for viewers that draw it.
    """

    camera: str | None = None
    coordinates: str | None = None
    up: str | None = None
    sh_degree: int | None = None
    crop: Crop | None = None
    max_gaussians: int | None = None
    baked: bool = True

    @property
    def reduces(self) -> bool:
        """True if the file has fewer Gaussians or fewer coefficients than the model."""
        return any(v is not None for v in (self.sh_degree, self.crop, self.max_gaussians))


@dataclass(frozen=True, eq=False)
class _Prepared:
    """A scene that is ready to be written to a file.

    Attributes:
        gaussians: The Gaussians in the local frame.
        baked: True if the backbone's Gaussians depend on the view or have another response.
        views: The views that the Gaussians are baked for.
        placed: The Gaussians in the coordinates of the file.
        content: The content of the file.
    """

    gaussians: Gaussians
    baked: bool
    views: tuple[View, ...]
    placed: Placed
    content: ExportContent


def export_scene(
    setup: Setup,
    state: TrainState,
    path: Path,
    exporter: Exporter | None = None,
    options: ExportOptions = ExportOptions(),
) -> Exported:
    """Write the trained scene and, if there is anything to record, a `.georef.json`.

    Args:
        setup: The run.
        state: The state of the run.
        path: The file.
        exporter: The exporter; by default the exporter of the run.
        options: The options of the export.

    Raises:
        UserError: There is no view of that name, no Gaussian is left, the scene cannot be put into
            these coordinates, or the file cannot be written.
    """
    exporter, scene = exporter or setup.selection.exporter, setup.scene
    ready = _prepared(setup, state, path, exporter, options)
    number = len(ready.gaussians)
    notes = exporter.write(ready.content, path)
    notes += (*ready.placed.notes, *_write_georef(path, ready.placed, exporter))
    background = _own_background(setup)
    if setup.backbone.plain and background is None and not exporter.lossy and not options.reduces:
        return Exported(number, notes=notes)
    compared = scene.test_views if options.camera is None else ready.views
    drawn = drawer(setup, state, exporter.stored(ready.gaussians, scene.similarity))
    return Exported(
        gaussians=number,
        baked_for=(options.camera or f"{len(ready.views)} training views") if ready.baked else None,
        views=len(compared),
        psnr=_mean_psnr(compared, drawn),
        live_psnr=_mean_psnr(compared, renderer(setup, state)),
        background=background,
        notes=notes,
    )


def write_page(setup: Setup, state: TrainState, path: Path, gaussians: int) -> Exported | None:
    """Write a page that shows the scene in a browser, if it is small.

    Args:
        setup: The run.
        state: The state of the run.
        path: The file; an old one is removed if no page is written.
        gaussians: Number of Gaussians of the run's exported file.

    Returns:
        A description of the page. None if the exporter of pages is not installed, or if the page
        could be larger than `MOST_PAGE_BYTES`.

    Raises:
        UserError: The page cannot be written.
    """
    path.unlink(missing_ok=True)
    if PAGE_EXPORTER not in entries("exporters"):
        return None
    exporter = build(Exporter, PAGE_EXPORTER, {})
    size = exporter.largest_size(gaussians)
    if size is None or size > MOST_PAGE_BYTES:
        return None
    return export_scene(setup, state, path, exporter)


def _prepared(
    setup: Setup, state: TrainState, path: Path, exporter: Exporter, options: ExportOptions
) -> _Prepared:
    """Return the scene as the exporter writes it to `path`; see `export_scene`."""
    scene = setup.scene
    views = setup.train_views if options.camera is None else (view_named(setup, options.camera),)
    coordinates, axis = coordinates_of(setup, exporter, options)
    all_gaussians, baked = _gaussians_of(setup, state, exporter, views, options)
    gaussians = with_degree(all_gaussians, options.sh_degree)
    placed = scene.georeference.placed(gaussians, scene.similarity, coordinates)
    placed = upright(placed, scene.up, axis, coordinates)
    rows = torch.ones(len(gaussians), dtype=torch.bool)
    if options.crop is not None:
        means = placed.gaussians.means.detach().cpu().double().numpy()
        rows = torch.from_numpy(options.crop.inside(placed.similarity.to_input(means), axis))
    if options.max_gaussians is not None and int(rows.sum()) > options.max_gaussians:
        kept = most_important(
            setup, gaussians.selected(rows), setup.train_views, options.max_gaussians
        )
        rows[rows.clone()] = kept
    if options.reduces:
        gaussians = gaussians.selected(rows)
        placed = replace(placed, gaussians=placed.gaussians.selected(rows))
    if not len(gaussians):
        raise UserError(
            "no Gaussian is left to export",
            where=path,
            found="no Gaussian of the model is inside the part of --crop"
            if options.crop is not None
            else "a model without Gaussians",
            todo="give --crop in the coordinates of the exported file"
            if options.crop is not None
            else "train the run with more steps or with another densifier",
        )
    frame = coordinates if axis == INPUT else f"{coordinates}, {axis} up"
    comments = [f"crossgrad step {state.step}"]
    comments += [] if frame == INPUT else [f"{COORDINATES_TAG} {frame}"]
    content = ExportContent(
        placed.gaussians,
        placed.similarity,
        tuple(
            replace(each, camera=camera_in(each.camera, placed.rotation))
            for each in setup.train_views
        ),
        placed.rotation @ scene.up,
        placed.to_ecef,
        tuple(comments),
        scene.name,
    )
    return _Prepared(gaussians, baked, views, placed, content)


def _gaussians_of(
    setup: Setup,
    state: TrainState,
    exporter: Exporter,
    views: Sequence[View],
    options: ExportOptions,
) -> tuple[Gaussians, bool]:
    """Return the Gaussians in the local frame, and True if they are baked for the views."""
    phase, parameters = setup.phase(state.step, training=False), eval_parameters(setup, state)
    keeps = exporter.keeps_response or not options.baked
    with torch.no_grad():
        unbaked = setup.backbone.unbaked(parameters, phase) if keeps else None
        if unbaked is not None and unbaked.response in exporter.responses:
            return unbaked, False
        if options.baked:
            cameras = [view.camera for view in views]
            return setup.backbone.bake(parameters, phase, cameras), not setup.backbone.plain
    if unbaked is not None:
        raise UserError(
            f"the format cannot store Gaussians with the response {unbaked.response}",
            where="--unbaked",
            expected="a format with a field for the response",
            todo="leave --unbaked out, or choose another --format",
        )
    raise UserError(
        f"--unbaked has no effect: backbone {setup.selection.names['backbone']} has no "
        "response of its own that a file can store",
        where="--unbaked",
        expected="a backbone with its own response, such as mip",
        todo="leave --unbaked out",
    )


def coordinates_of(setup: Setup, exporter: Exporter, options: ExportOptions) -> tuple[str, str]:
    """Return the coordinates of a file and the axis that points up in it.

    The exporter's defaults apply where the options say nothing. Map axes are never rotated, and a
    scene without a location keeps its input coordinates.
    """
    coordinates = options.coordinates
    if coordinates is None:
        placeable = setup.scene.georeference.up is not None
        coordinates = exporter.coordinates if placeable else INPUT
    axis = options.up
    if axis is None:
        axis = exporter.up if coordinates in {INPUT, LOCAL, "enu"} else INPUT
    return coordinates, axis


def georef_of(path: Path) -> Path:
    """Return the path of the file that tells other programs the location of an exported file."""
    return path.with_name(f"{path.name}.georef.json")


def check_frame(path: Path) -> None:
    """Refuse a file of Gaussians whose `.georef.json` names other axes than those of the input.

    Some formats have no field for their coordinates, so the file itself cannot be checked.

    Raises:
        UserError: The coordinates or the up axis of the file differ from the scene's input.
    """
    try:
        facts = read_json(georef_of(path))
    except (OSError, ValueError):
        return
    if not isinstance(facts, dict):
        return
    coordinates, up = facts.get("coordinates", INPUT), facts.get("up", INPUT)
    if coordinates != INPUT or up != INPUT:
        raise UserError(
            "the file uses other coordinates than the scene",
            where=path,
            expected="the coordinates of the scene's input files",
            found=f"coordinates {coordinates}, up {up}, as {georef_of(path).name} states",
            todo="export the file again with --coordinates input --up input",
        )


def _write_georef(path: Path, placed: Placed, exporter: Exporter) -> tuple[str, ...]:
    """Write the `.georef.json` if there is anything to record; return a note about rounding."""
    rounding = exporter.rounding(placed.gaussians, placed.similarity)
    offset, largest = rounding.offset.tolist(), rounding.largest
    if not placed.facts and not any(offset):
        return ()
    facts = {"coordinates": INPUT, **placed.facts, "offset": offset, "rounding": largest}
    write_atomically(georef_of(path), f"{dumps({'file': path.name, **facts}, indent=1)}\n".encode())
    rounding_note = f"; rounding moves Gaussians by at most {largest:.1g} units" if largest else ""
    return (
        f"{path.name}: {facts['coordinates']} coordinates, "
        f"see {georef_of(path).name}{rounding_note}",
    )


def _own_background(setup: Setup) -> str | None:
    """Return the name of the background of evaluated views; None if it is black."""
    return setup.config.background if bool(eval_background(setup).any()) else None


def _mean_psnr(views: Sequence[View], render_one: Callable[[View], Tensor]) -> float | None:
    """Return the mean PSNR in dB over the views with pixels to compare; None without such views."""
    values = []
    with torch.no_grad():
        for view in views:
            pair = compare(view, render_one(view))
            values.append(psnr(pair.render, pair.photo, pair.mask))
    numbers = [value for value in values if value is not None]
    return fsum(numbers) / len(numbers) if numbers else None


def view_named(setup: Setup, name: str, where: str = "--camera") -> View:
    """Return the view of this name; `where` names its option in the error message.

    Raises:
        UserError: There is no such view.
    """
    for view in setup.scene.views:
        if view.name == name:
            return view
    names = [view.name for view in setup.scene.views]
    raise UserError(
        f"the scene has no view {name!r}",
        where=where,
        expected=f"one of {len(names)} names such as {names[0]}",
        todo="per_view.csv lists the held-out views",
    )


def renderer(setup: Setup, state: TrainState) -> Callable[[View], Tensor]:
    """Return a function that renders a view as an evaluation does, exposure included."""
    through = camera_renderer(setup, state)
    return lambda view: apply(setup, state, view, through(view.camera))


def plain_renderer(setup: Setup, state: TrainState) -> Callable[[View], Tensor]:
    """Return a function that renders a view of another capture, whose exposure is unknown."""
    through = camera_renderer(setup, state)
    return lambda view: through(view.camera)


def camera_renderer(setup: Setup, state: TrainState) -> Callable[[Camera], Tensor]:
    """Return a function that renders any camera as an evaluation does, before any exposure."""
    background, parameters = eval_background(setup), eval_parameters(setup, state)
    phase = setup.phase(state.step, training=False)

    def render_one(camera: Camera) -> Tensor:
        gaussians = setup.backbone.decode(parameters, camera, phase)
        return setup.rasterizer.render(gaussians, camera, background).image

    return render_one


def drawer(setup: Setup, state: TrainState, gaussians: Gaussians) -> Callable[[View], Tensor]:
    """Return a function that renders `gaussians` for a view and applies the exposure of the view.

    The background is black, because viewers draw the Gaussians of a file on black.
    """
    plain = plain_drawer(setup, gaussians)
    return lambda view: apply(setup, state, view, plain(view))


def plain_drawer(setup: Setup, gaussians: Gaussians) -> Callable[[View], Tensor]:
    """Return a function that renders `gaussians` for a view on black, without exposure."""
    background = torch.zeros(3, device=setup.device)
    moved = gaussians.mapped(lambda tensor: tensor.to(setup.device))
    return lambda view: setup.rasterizer.render(moved, view.camera, background).image


def described(exported: Exported, path: Path) -> Sequence[str]:
    """Return lines for the user about an exported file."""
    lines = [*exported.notes]
    if exported.loss is None:
        return lines
    baked = "" if exported.baked_for is None else f"baked for {exported.baked_for}; "
    over = "" if exported.background is None else f" over its background {exported.background}"
    lines.append(
        f"{path.name}: {baked}rendered on black, as viewers do, it has "
        f"{exported.psnr:.2f} dB, and the trained model{over} has "
        f"{exported.live_psnr:.2f} dB (loss {exported.loss:.2f} dB, {exported.views} "
        "views)"
    )
    return lines
