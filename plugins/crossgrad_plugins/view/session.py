"""One browser window: its camera, the controls of its page, and the frames that it waits for."""

import io
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from time import monotonic
from typing import Any, Final, Literal

import numpy as np

from crossgrad_core.plugin import Camera, Scene, Similarity, UserError, View
from crossgrad_plugins.view.camera_file import write_camera_path
from crossgrad_plugins.view.cameras import (
    camera_of,
    distance_ahead,
    fov_in_window,
    fov_of,
    free_camera,
    looks_like,
    photo_in_window,
    quaternion_of,
    spacing_of,
    whole_window,
)
from crossgrad_plugins.view.frames import Frame, Look, Pixels, layers_of
from crossgrad_plugins.view.sources import Source
from crossgrad_plugins.view.training import Training

#: The page draws at most this many cameras and points.
_MOST_CAMERAS, _MOST_POINTS = 1_000, 200_000
#: A camera is still if it has not moved for this many seconds.
STILL_AFTER: Final = 0.2
#: Seconds of a frame while the camera moves; the size of these frames is adapted to it.
_MOVING_SECONDS: Final = 0.07
#: Smallest share of the side length for these frames, and the change of the share per frame.
_SMALLEST, _STEP = 0.08, 1.3
_FREE: Final = "free camera"
#: Colours of the regimes' cameras (RGB), in the order of their names.
_COLORS: Final = ((255, 150, 40), (60, 150, 255), (90, 200, 90), (220, 90, 200), (160, 160, 160))
Size = Literal["small", "full"]


@dataclass(frozen=True, eq=False)
class Stage:
    """The things that all windows share.

    Attributes:
        sources: Returns the present sources.
        world: Maps the coordinates of the page to input coordinates.
        scene: The scene whose cameras are shown, in the coordinates of the page; None for a file.
        command: Start of the command that renders a path; None without a run.
        training: The run in training; None for a viewer of results.
    """

    sources: Callable[[], list[Source]]
    world: Similarity
    scene: Scene | None = None
    command: str | None = None
    training: Training | None = None

    @cached_property
    def views(self) -> tuple[View, ...]:
        """The views whose cameras are shown."""
        views = () if self.scene is None else self.scene.views
        return views[:: -(-len(views) // _MOST_CAMERAS) or 1]

    @cached_property
    def spacing(self) -> float:
        """The length of a drawn camera."""
        return spacing_of(self.views)


@dataclass(eq=False)
class Session:
    """A connected browser window.

    Attributes:
        client: The handle of viser.
        stage: The things that all windows share.
        wake: Tells the drawing thread that a frame may be due.
        view: The view that the user chose last.
        closed: True if the window is no longer connected.
    """

    client: Any
    stage: Stage
    wake: Callable[[], None]
    view: View | None = None
    closed: bool = False
    _window: Camera | None = None
    _keyframes: list[Camera] = field(default_factory=list)
    _changed_at: float = 0.0
    _changes: int = 0
    _drawn: dict[Size, int] = field(default_factory=lambda: {"small": 0, "full": 0})
    _versions: list[int] = field(default_factory=list)
    _share: float = 0.4
    _wants_file: bool = False
    _controls: dict[str, Any] = field(default_factory=dict)
    _nodes: list[Any] = field(default_factory=list)

    @property
    def number(self) -> int:
        """The number of the connection."""
        return int(self.client.client_id)

    def start(self) -> None:
        """Build the page, and move its camera to the first camera."""
        self._add_controls()
        self._add_cameras()
        # An async callback runs on the server's own thread, in the order of the messages.
        self.client.camera.on_update(self._camera_moved)
        views = self.stage.views
        if views:
            self.go_to(views[0])
        else:
            camera = free_camera()
            self._move(camera, ahead=float(camera.center.norm()))
        self._read_camera()

    async def _camera_moved(self, _camera: object) -> None:
        self._read_camera()

    def _read_camera(self) -> None:
        window = camera_of(self.client.camera)
        if window is not None:
            self._window = window
            self.changed()

    def changed(self) -> None:
        """Ask for new frames: small frames while changes follow each other, then a full one."""
        self._changed_at = monotonic()
        self._changes += 1
        self.wake()

    def due(self) -> Size | None:
        """Return the size of the frame that the window waits for; None if it has its frame."""
        if self._window is None:
            return None
        size: Size = "small" if monotonic() - self._changed_at < STILL_AFTER else "full"
        if self._drawn[size] < self._changes:
            return size
        versions = [source.version for source in self.stage.sources()]
        return "full" if size == "full" and versions != self._versions else None

    @property
    def waits(self) -> bool:
        """True if a full frame will be due."""
        return self._window is not None and self._drawn["full"] < self._changes

    def draw(self, size: Size, *, lossless: bool) -> None:
        """Render and send a frame.

        Args:
            size: As `due` returned it.
            lossless: True to send a full frame without loss.
        """
        begun, number = monotonic(), self._changes
        share = self._share if size == "small" else 1.0
        sources = self.stage.sources()
        pixels = self._frame(sources, share).pixels()
        exact = lossless and size == "full"
        if self.closed:  # The window was closed while the frame was rendered.
            return
        self.client.scene.set_background_image(
            pixels, format="png" if exact else "jpeg", jpeg_quality=None if exact else 85
        )
        self._drawn[size] = number
        if size == "full":
            self._drawn["small"], self._versions = number, [source.version for source in sources]
            if self._wants_file:
                self._send_file(pixels)
            return
        ratio = (_MOVING_SECONDS / max(monotonic() - begun, 1e-6)) ** 0.5
        step = min(max(ratio, 1 / _STEP), _STEP)
        self._share = min(max(self._share * step, _SMALLEST), 1.0)

    def _frame(self, sources: list[Source], share: float) -> Frame:
        window, view = self._window, self.view
        if window is None:
            raise RuntimeError("the window has no camera yet")
        if view is not None and looks_like(window, view):
            fit = photo_in_window(window, view.camera, share)
        else:
            fit, view = whole_window(window, share), None
        return Frame(sources, self.stage.world, fit, view, self._look(sources))

    def _look(self, sources: list[Source]) -> Look:
        layers = {layer.label(len(sources)): layer for layer in layers_of(sources)}
        left, right = (layers[self._controls[side].value] for side in ("left", "right"))
        split, exposure = self._controls["split"].value, self._controls["exposure"].value
        return Look(left, right, float(split), bool(exposure))

    def go_to(self, view: View) -> None:
        """Move the camera to a view; its photo can then be compared with the render."""
        self.view = view
        if self._controls["camera"].value != view.name:
            self._controls["camera"].value = view.name
        scene = self.stage.scene
        otherwise = 10 * self.stage.spacing
        points = np.zeros((0, 3)) if scene is None else scene.points
        self._move(view.camera, distance_ahead(view, points, otherwise))

    def _move(self, camera: Camera, ahead: float) -> None:
        """Move the camera; the user then turns around the point at a distance ahead of it."""
        handle, window = self.client.camera, camera_of(self.client.camera)
        center, pose = camera.center.numpy(), camera.world_to_camera[:3, :3].numpy()
        with self.client.atomic():
            handle.wxyz = quaternion_of(camera)
            handle.position = center
            handle.look_at = center + ahead * pose[2]
            handle.fov = fov_of(camera) if window is None else fov_in_window(window, camera)

    def _add_controls(self) -> None:
        gui, sources = self.client.gui, self.stage.sources()
        two = len(sources) > 1
        titles = [
            f"{'AB'[number]}: {s.title}" if two else s.title for number, s in enumerate(sources)
        ]
        gui.add_markdown("  \n".join(titles))
        if self.stage.training is not None:
            self._add_training(self.stage.training)
        with gui.add_folder("Image"):
            layers = layers_of(sources)
            names = [layer.label(len(sources)) for layer in layers]
            second = min(1, len(names) - 1)
            self._keep("left", gui.add_dropdown("Left", names, initial_value=names[0]))
            self._keep("right", gui.add_dropdown("Right", names, initial_value=names[second]))
            split = 0.5 if two else 1.0
            hint = "Left layer up to here, then the right layer"
            self._keep("split", gui.add_slider("Split", 0.0, 1.0, 0.01, split, hint=hint))
            hint = "Apply the photo's exposure at a camera of the scene, as an evaluation does"
            self._keep("exposure", gui.add_checkbox("Exposure", initial_value=True, hint=hint))
        self._add_camera_controls()

    def _keep(self, name: str, handle: Any) -> None:  # noqa: ANN401 - a control of viser
        self._controls[name] = handle
        handle.on_update(lambda _event: self.changed())

    def _add_camera_controls(self) -> None:
        gui, names = self.client.gui, [view.name for view in self.stage.views]
        with gui.add_folder("Camera"):
            choice = gui.add_dropdown("Go to", [_FREE, *names], hint="Or click a drawn camera")
            self._controls["camera"] = choice
            choice.on_update(self._camera_chosen)
            shown = gui.add_checkbox("Show cameras", initial_value=True)
            shown.on_update(lambda _event: self._show_nodes(visible=shown.value))
            gui.add_button("Screenshot (PNG)").on_click(lambda _event: self._ask_screenshot())
        with gui.add_folder("Camera path"):
            self._controls["path"] = gui.add_markdown("No keyframes")
            gui.add_button("Add keyframe").on_click(lambda _event: self._add_keyframe())
            gui.add_button("Save the path").on_click(lambda _event: self._save_path())
            gui.add_button("Clear").on_click(lambda _event: self._clear_path())

    def _camera_chosen(self, event: Any) -> None:  # noqa: ANN401 - an event of viser
        # The page also reports a change that `go_to` made.
        if event.client is None:
            return
        chosen = self._controls["camera"].value
        view = next((view for view in self.stage.views if view.name == chosen), None)
        self.view = view
        if view is not None:
            self.go_to(view)

    def _add_cameras(self) -> None:
        scene, stage = self.client.scene, self.stage
        regimes = sorted({view.regime for view in stage.views})
        for number, view in enumerate(stage.views):
            camera = view.camera
            node = scene.add_camera_frustum(
                f"/cameras/{number}",
                fov=fov_of(camera),
                aspect=camera.width / camera.height,
                scale=stage.spacing,
                thickness=1.5,
                thickness_units="screen",
                color=_COLORS[regimes.index(view.regime) % len(_COLORS)],
                wxyz=quaternion_of(camera),
                position=camera.center.numpy(),
            )
            node.on_click(lambda _event, view=view: self.go_to(view))
            self._nodes.append(node)
        drawn = any(source.draw is not None for source in stage.sources())
        if stage.scene is not None and not drawn:
            kept = slice(None, None, -(-len(stage.scene.points) // _MOST_POINTS) or 1)
            scene.add_point_cloud(
                "/points",
                stage.scene.points[kept].astype(np.float32),
                stage.scene.point_colors[kept],
                point_size=stage.spacing / 15,
                precision="float32",
            )

    def _show_nodes(self, *, visible: bool) -> None:
        for node in self._nodes:
            node.visible = visible

    def _ask_screenshot(self) -> None:
        """Ask the drawing thread to send its next full frame as a file, too."""
        self._wants_file = True
        self.changed()

    def _send_file(self, pixels: Pixels) -> None:
        from PIL import Image

        self._wants_file = False

        picture = io.BytesIO()
        Image.fromarray(pixels).save(picture, format="png")
        self.client.send_file_download("crossgrad.png", picture.getvalue(), save_immediately=True)

    def _add_keyframe(self) -> None:
        if self._window is not None:
            self._keyframes.append(self._window)
            self._say_path(f"{len(self._keyframes)} keyframes, 2 s between two of them")

    def _save_path(self) -> None:
        if len(self._keyframes) < 2:  # noqa: PLR2004 - the two ends of a path
            self._say_path("A path needs two keyframes: move the camera, and add another one")
            return
        try:
            path = write_camera_path(Path.cwd(), self._keyframes, self.stage.world)
        except UserError as error:
            self._say_path(str(error))
            return
        command = self.stage.command
        self._say_path(f"`{path}`" if command is None else f"`{command} --path {path}`")

    def _clear_path(self) -> None:
        self._keyframes.clear()
        self._say_path("No keyframes")

    def _say_path(self, text: str) -> None:
        self._controls["path"].content = text

    def _add_training(self, training: Training) -> None:
        gui = self.client.gui
        with gui.add_folder("Training"):
            self._controls["progress"] = gui.add_markdown(training.text)
            self._controls["pause"] = gui.add_button("Pause")
            self._controls["pause"].on_click(lambda _event: self._pause(training))
            gui.add_button("Stop", hint="Save, evaluate and end; --resume continues").on_click(
                lambda _event: self._stop(training)
            )
            for name, points in (("loss", training.losses), ("PSNR (dB)", training.scores)):
                series = ({"label": "step"}, {"label": name, "stroke": "#2a6fdb", "width": 2})
                self._controls[name] = gui.add_uplot(
                    Training.curve(points),
                    series,
                    scales={"x": {"time": False}},
                    title=f"{name} of {'training' if name == 'loss' else 'held-out'} views",
                    aspect=3.0,
                )

    def _pause(self, training: Training) -> None:
        training.paused = not training.paused
        self.wake()

    def _stop(self, training: Training) -> None:
        training.stopping, training.paused = True, False
        self.wake()

    def refresh(self, training: Training) -> None:
        """Show the present progress and curves."""
        self._controls["progress"].content = training.text
        self._controls["pause"].label = "Resume" if training.paused else "Pause"
        self._controls["loss"].data = Training.curve(training.losses)
        self._controls["PSNR (dB)"].data = Training.curve(training.scores)
