"""Correct scenes in memory, and changes that make a scene contradict itself."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Final, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from crossgrad_core.contract.scene import Camera, Scene, View
from crossgrad_core.scene.frame import make_frame

Floats: TypeAlias = NDArray[np.float64]
Photo: TypeAlias = NDArray[np.uint8]
#: One of this many photos is held out.
EVERY: Final = 8
_FLIP: Final = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class MemoryPhoto:
    """A photo in memory."""

    pixels: Photo

    def image(self) -> Tensor:
        """Return the pixels [H, W, 3] uint8."""
        return torch.from_numpy(self.pixels)

    def mask(self) -> None:
        """Return None: every pixel counts."""


@dataclass(frozen=True, eq=False)
class Model:
    """A scene in the form that a reader returns, with its photos.

    Attributes:
        rotations: [V, 3, 3] rotations from world to camera.
        translations: [V, 3] translations from world to camera.
        calibrations: [V, 4] focal lengths and principal points: fx, fy, cx, cy.
        photos: [V] images [H, W, 3].
        seen: [V] indices of the points that each view observed.
        points: [P, 3] positions.
        colors: [P, 3] uint8 colours.
    """

    rotations: Floats
    translations: Floats
    calibrations: Floats
    photos: list[Photo]
    seen: list[NDArray[np.int64]]
    points: Floats
    colors: NDArray[np.uint8]

    @classmethod
    def of(cls, scene: Scene) -> "Model":
        """Return the model of a scene that was read."""
        cameras = [view.camera for view in scene.views]
        centers = scene.similarity.to_input(np.stack([each.center.numpy() for each in cameras]))
        rotations = np.stack([each.world_to_camera[:3, :3].numpy() for each in cameras])
        return cls(
            rotations,
            -np.einsum("vij,vj->vi", rotations, centers),
            np.array([[each.fx, each.fy, each.cx, each.cy] for each in cameras]),
            [view.photo.image().numpy() for view in scene.views],
            [view.seen for view in scene.views],
            scene.similarity.to_input(scene.points),
            scene.point_colors,
        )

    @property
    def centers(self) -> Floats:
        """[V, 3] camera centres."""
        return np.asarray(-np.einsum("vji,vj->vi", self.rotations, self.translations))

    def posed(self, rotations: Floats, centers: Floats) -> "Model":
        """Return the model with other poses."""
        translations = -np.einsum("vij,vj->vi", rotations, centers)
        return replace(self, rotations=rotations, translations=translations)

    def views(self, chosen: NDArray[np.int64]) -> "Model":
        """Return the model with some of its views."""
        return replace(
            self,
            rotations=self.rotations[chosen],
            translations=self.translations[chosen],
            calibrations=self.calibrations[chosen],
            photos=[self.photos[i] for i in chosen],
            seen=[self.seen[i] for i in chosen],
        )

    def name(self, view: int) -> str:
        """Return the name of a view."""
        return f"{view:04d}.png"

    def scene(self) -> Scene:
        """Return the scene that is built from the model."""
        count = len(self.photos)
        test = tuple(range(0, count, EVERY))
        train = tuple(i for i in range(count) if i % EVERY)
        frame = make_frame(self.centers[list(train)], self.points)
        views = []
        for i, photo in enumerate(self.photos):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = self.rotations[i], self.translations[i]
            camera = Camera(
                photo.shape[1],
                photo.shape[0],
                *self.calibrations[i],
                world_to_camera=torch.from_numpy(frame.pose(pose)),
            )
            views.append(View(self.name(i), camera, MemoryPhoto(photo), "all", self.seen[i]))
        return Scene(
            name="searched",
            views=tuple(views),
            train=train,
            test=test,
            points=frame.points(self.points),
            point_colors=self.colors,
            similarity=frame.similarity,
        )


@dataclass(frozen=True)
class Wrong:
    """A scene that contradicts itself.

    Attributes:
        model: The changed scene.
        strength: Size of the change, as a text for the table.
        views: The changed views; empty if all views are changed.
        causes: Words of which at least one must be in the reported cause.
    """

    model: Model
    strength: str
    views: frozenset[int]
    causes: tuple[str, ...]


Kind: TypeAlias = Callable[[Model, np.random.Generator], Wrong]


def some_views(model: Model, rng: np.random.Generator, most: float = 0.25) -> NDArray[np.int64]:
    """Return random views: at least one, and at most the share `most` of all views."""
    count = len(model.photos)
    return np.sort(rng.choice(count, rng.integers(1, max(2, int(most * count) + 1)), replace=False))


def opengl_axes(model: Model, _: np.random.Generator) -> Wrong:
    """Change camera axes to y up, z backward."""
    turned = replace(
        model, rotations=_FLIP @ model.rotations, translations=model.translations @ _FLIP
    )
    return Wrong(turned, "all", frozenset(), ("OpenGL",))


def camera_to_world(model: Model, _: np.random.Generator) -> Wrong:
    """Invert the poses."""
    inverse = model.rotations.transpose(0, 2, 1)
    turned = replace(model, rotations=inverse, translations=model.centers)
    return Wrong(turned, "all", frozenset(), ("camera-to-world",))


def exchanged(model: Model, rng: np.random.Generator) -> Wrong:
    """Exchange photos in pairs."""
    views = rng.permutation(len(model.photos))[
        : 2 * int(rng.integers(1, max(2, len(model.photos) // 5)))
    ]
    photos = list(model.photos)
    for a, b in views.reshape(-1, 2):
        photos[a], photos[b] = photos[b], photos[a]
    strength = "one pair" if len(views) == 2 else "several pairs"
    return Wrong(replace(model, photos=photos), strength, frozenset(views.tolist()), ())


def mirrored(model: Model, rng: np.random.Generator) -> Wrong:
    """Mirror photos left to right."""
    every = rng.random() < 0.4
    views = np.arange(len(model.photos)) if every else some_views(model, rng)
    photos = list(model.photos)
    for view in views:
        photos[view] = np.ascontiguousarray(photos[view][:, ::-1])
    which = frozenset[int]() if every else frozenset(views.tolist())
    causes = ("mirrored", "other axes")
    return Wrong(replace(model, photos=photos), "all" if every else "some", which, causes)


def rotated(model: Model, rng: np.random.Generator) -> Wrong:
    """Rotate photos by 90 or 180 degrees, and resize them to the size of their camera."""
    every, turns = rng.random() < 0.4, int(rng.integers(1, 4))
    views = np.arange(len(model.photos)) if every else some_views(model, rng)
    photos = list(model.photos)
    for view in views:
        height, width = photos[view].shape[:2]
        turned = Image.fromarray(np.rot90(photos[view], turns)).resize((width, height))
        photos[view] = np.asarray(turned).copy()
    which = frozenset[int]() if every else frozenset(views.tolist())
    strength = f"{'all' if every else 'some'}, {90 if turns % 2 else 180} degrees"
    return Wrong(replace(model, photos=photos), strength, which, ("rotated", "exchanged", "other"))


def focal(model: Model, rng: np.random.Generator) -> Wrong:
    """Multiply the focal length by a factor."""
    factor = float(rng.choice([0.5, 0.7, 0.8, 0.9, 0.95, 1.05, 1.1, 1.25, 1.5, 2.0]))
    wrong = replace(model, calibrations=model.calibrations * [factor, factor, 1, 1])
    causes = ("focal", "another size")
    return Wrong(wrong, f"x {max(factor, 1 / factor):.2f}", frozenset(), causes)


def nonsense(model: Model, rng: np.random.Generator) -> Wrong:
    """Rotate cameras by random angles."""
    views, angle = some_views(model, rng), float(rng.choice([10.0, 30.0, 180.0]))
    rotations = model.rotations.copy()
    for view in views:
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(np.radians(angle) * axis / np.linalg.norm(axis)).as_matrix()
        rotations[view] = turn @ rotations[view]
    wrong = model.posed(rotations, model.centers)
    return Wrong(wrong, f"{angle:g} degrees", frozenset(views.tolist()), ())


def principal_point(model: Model, rng: np.random.Generator) -> Wrong:
    """Move the principal point, or set it to zero."""
    share = float(rng.choice([0.0, 0.05, 0.1, 0.2]))
    sizes = np.array([photo.shape[1::-1] for photo in model.photos], dtype=np.float64)
    off = share * sizes * rng.choice([-1.0, 1.0], 2)
    points = model.calibrations[:, 2:] + off if share else np.zeros_like(off)
    wrong = replace(model, calibrations=np.hstack([model.calibrations[:, :2], points]))
    strength = f"off by {share:.0%}" if share else "(0, 0)"
    return Wrong(wrong, strength, frozenset(), ("principal point",))


def scaled_points(model: Model, rng: np.random.Generator) -> Wrong:
    """Scale the points to another unit."""
    factor = float(rng.choice([0.1, 0.3048, 0.8, 0.9, 1.1, 1.25, 3.2808, 10.0]))
    strength = f"x {max(factor, 1 / factor):.2f}"
    return Wrong(replace(model, points=model.points * factor), strength, frozenset(), ("units",))


def shifted(model: Model, rng: np.random.Generator) -> Wrong:
    """Shift all photos by one view."""
    step = int(rng.choice([-1, 1]))
    photos = model.photos[step:] + model.photos[:step]
    causes = ("shifted", "other photos")
    return Wrong(replace(model, photos=photos), "by 1", frozenset(), causes)


def half_elsewhere(model: Model, rng: np.random.Generator) -> Wrong:
    """Exchange the poses within one half of the photos."""
    views = rng.permutation(len(model.photos))[: len(model.photos) // 2]
    photos = list(model.photos)
    for a, b in zip(views, np.roll(views, 1), strict=True):
        photos[a] = model.photos[b]
    return Wrong(replace(model, photos=photos), "half", frozenset(views.tolist()), ())


def points_y_z(model: Model, _: np.random.Generator) -> Wrong:
    """Exchange y and z of the points, so that points and poses have different axes."""
    matrix = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    return Wrong(
        replace(model, points=model.points @ matrix.T), "all", frozenset(), ("other axes",)
    )


KINDS: Final[dict[str, Kind]] = {
    "OpenGL axes": opengl_axes,
    "camera-to-world poses": camera_to_world,
    "exchanged photos": exchanged,
    "mirrored photos": mirrored,
    "rotated photos": rotated,
    "wrong focal length": focal,
    "turned cameras": nonsense,
    "wrong principal point": principal_point,
    "scaled points": scaled_points,
    "photos shifted by one": shifted,
    "half of the photos elsewhere": half_elsewhere,
    "points with y and z exchanged": points_y_z,
}


def varied(model: Model, rng: np.random.Generator) -> Model:
    """Vary a correct scene: fewer photos or points, cropped or stretched photos, no tracks."""
    count = int(rng.integers(8, len(model.photos) + 1))
    model = model.views(np.sort(rng.choice(len(model.photos), count, replace=False)))
    if rng.random() < 0.5:
        model = _cropped(model, rng)
    if rng.random() < 0.5:
        model = _stretched(model, rng)
    if rng.random() < 0.5:
        model = _fewer_points(model, rng)
    if rng.random() < 0.4:
        model = replace(model, seen=[np.zeros(0, dtype=np.int64)] * count)
    return model


def harmless(model: Model, rng: np.random.Generator) -> Model:
    """Change light, noise, JPEG quality or coordinate frame; the scene stays correct."""
    photos = list(model.photos)
    if rng.random() < 0.5:
        gains = 2.0 ** rng.normal(0.0, 0.5, len(photos))
        photos = [_gained(photo, gain) for photo, gain in zip(photos, gains, strict=True)]
    if rng.random() < 0.3:
        level = rng.uniform(2.0, 12.0)
        photos = [_clipped(photo + rng.normal(0.0, level, photo.shape)) for photo in photos]
    if rng.random() < 0.3:
        photos = [_jpeg(photo, int(rng.integers(30, 90))) for photo in photos]
    model = replace(model, photos=photos)
    if rng.random() < 0.3:
        noisy = model.colors + rng.normal(0.0, 20.0, model.colors.shape)
        model = replace(model, colors=_clipped(noisy))
    if rng.random() < 0.15:
        colors = np.full_like(model.colors, int(rng.choice([0, 128])))
        model = replace(model, colors=colors)
    return _moved(model, rng) if rng.random() < 0.5 else model


def _moved(model: Model, rng: np.random.Generator) -> Model:
    turn = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    scale, offset = float(np.exp(rng.uniform(-4, 4))), rng.normal(0.0, 100.0, 3)
    moved = replace(model, points=scale * model.points @ turn.T + offset)
    return moved.posed(model.rotations @ turn.T, scale * model.centers @ turn.T + offset)


def _cropped(model: Model, rng: np.random.Generator) -> Model:
    """Crop photos off centre, and move their principal points accordingly."""
    height, width = model.photos[0].shape[:2]
    left, top = int(rng.uniform(0, 0.2) * width), int(rng.uniform(0, 0.2) * height)
    photos = [np.ascontiguousarray(photo[top:, left:]) for photo in model.photos]
    calibrations = model.calibrations - [0, 0, left, top]
    seen = []
    for view, rows in enumerate(model.seen):
        local = model.points[rows] @ model.rotations[view].T + model.translations[view]
        at = calibrations[view, :2] * local[:, :2] / local[:, 2:] + calibrations[view, 2:]
        seen.append(rows[(at >= 0).all(axis=1)])
    return replace(model, photos=photos, calibrations=calibrations, seen=seen)


def _stretched(model: Model, rng: np.random.Generator) -> Model:
    """Stretch photos to non-square pixels, so that fx and fy differ."""
    height, width = model.photos[0].shape[:2]
    new_width = round(width * rng.uniform(0.8, 1.25))
    photos = [np.array(Image.fromarray(each).resize((new_width, height))) for each in model.photos]
    factor = new_width / width
    return replace(model, photos=photos, calibrations=model.calibrations * [factor, 1, factor, 1])


def _fewer_points(model: Model, rng: np.random.Generator) -> Model:
    total = len(model.points)
    kept = np.sort(rng.choice(total, int(rng.uniform(0.05, 1.0) * total), replace=False))
    place = np.full(total, -1)
    place[kept] = np.arange(len(kept))
    seen = [rows[rows >= 0] for rows in (place[rows] for rows in model.seen)]
    return replace(model, points=model.points[kept], colors=model.colors[kept], seen=seen)


def _gained(photo: Photo, gain: float) -> Photo:
    return _clipped(255.0 * (photo / 255.0) * gain ** (1 / 2.2))


def _clipped(values: NDArray[np.floating]) -> Photo:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _jpeg(photo: Photo, quality: int) -> Photo:
    buffer = BytesIO()
    Image.fromarray(photo).save(buffer, "JPEG", quality=quality)
    return np.asarray(Image.open(buffer)).copy()
