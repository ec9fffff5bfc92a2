"""Make towns, photographed from a drone and from streets, as COLMAP scenes with exact poses.

    python benchmarks/towns.py --seed 1 --out FOLDER [--aerial 64] [--street 64]

A town consists of boxes and trees along a grid of roads (_town_photos.py). Each seed gives another
town: other streets, heights, patterns, sun and drone flights. The drone flies 60 to 115 m above
ground. It flies in rings and looks inwards, in lines and looks down, or anywhere and looks
obliquely. Street photos are taken 2 m above ground. Points are computed from the depths of the
training photos, with a random error of 2 cm. Each point has up to two further observations in
photos of its own kind (aerial or street), and one in a photo of the other kind. Every eighth photo
of each kind gives no points, because `crossgrad run --split every` holds it out.
"""

import argparse
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
from _town_photos import Array, Vector, first_hit, photograph
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

#: Number of rays of a pixel in x, and also in y.
RAYS: Final = 2
POINTS: Final = 40_000
#: Half of the horizontal field of view, in degrees.
HALF_ANGLE: Final = {"aerial": 25, "street": 35}
Integers: TypeAlias = NDArray[np.int64]
#: Number of blocks and roads from the middle of the town in each direction.
REACH: Final = 2
#: One of this many photos of each kind is held out.
EVERY: Final = 8


@dataclass(frozen=True, eq=False)
class Town:
    """Boxes and trees along a grid of roads, and the sun.

    Attributes:
        pitch: Distance between roads in metres.
        road: Width of a road in metres.
        boxes: [B, 10] boxes, as in _town_photos.py.
        trees: [T, 5] trees, as in _town_photos.py.
        sun: Unit vector towards the sun.
    """

    pitch: float
    road: float
    boxes: Array
    trees: Array
    sun: Vector

    def holds(self, point: Array) -> bool:
        """Return True if a point is inside an object or close to it."""
        for box in self.boxes:
            x, y = point[:2] - box[:2]
            across, along = box[6] * x + box[7] * y, box[6] * y - box[7] * x
            beside = abs(across) < box[2] + 0.7 and abs(along) < box[3] + 0.7
            if beside and box[4] < point[2] < box[5] + 0.7:
                return True
        radii = self.trees[:, [3, 3, 4]]
        return bool((np.linalg.norm((point - self.trees[:, :3]) / radii, axis=1) < 1.4).any())


@dataclass(frozen=True, eq=False)
class View:
    """A photo with its camera.

    Attributes:
        kind: Folder of the photo.
        number: Index among the photos of its kind.
        eye: [3] centre of the camera.
        axes: [3, 3] camera axes to the right, down and ahead.
        width: Width in pixels; the height is 5/8 of the width.
    """

    kind: str
    number: int
    eye: Array
    axes: Array
    width: int

    @property
    def name(self) -> str:
        """The file name below the folder of photos."""
        return f"{self.kind}/{self.number:04d}.jpg"

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.width, self.width * 5 // 8

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return self.width / 2 / math.tan(math.radians(HALF_ANGLE[self.kind]))

    def project(self, points: Array) -> Array:
        """Return the pixels and depths of points [N, 3]."""
        local = (points - self.eye) @ self.axes.T
        with np.errstate(divide="ignore", invalid="ignore"):
            at = local[:, :2] / local[:, 2:] * self.focal + np.array(self.size) / 2
        return np.column_stack([at, local[:, 2]])


def _houses(rng: np.random.Generator, x: float, y: float, half: float) -> list[list[float]]:
    """Return the boxes of one block of houses around (x, y)."""
    rows, boxes = int(rng.integers(2, 4)), []
    side = 2 * half / rows
    for place in range(rows * rows):
        if rng.random() < 0.15:
            continue
        u = x - half + (place % rows + 0.5) * side
        v = y - half + (place // rows + 0.5) * side
        width, depth = rng.uniform(0.3, 0.47, 2) * side
        turn = rng.choice([0.0, 0.0, rng.uniform(-0.15, 0.15)])
        top = rng.choice([1, 2, 2, 3, 4, 6, 9]) * 3.1 + rng.uniform(0.3, 1.2)
        way = [math.cos(turn), math.sin(turn)]
        boxes.append([u, v, width, depth, 0, top, *way])
        if rng.random() < 0.6:
            u, v = u + rng.uniform(-0.4, 0.4) * width, v + rng.uniform(-0.4, 0.4) * depth
            rise = rng.uniform(0.8, 2.5)
            boxes.append([u, v, 0.25 * width, 0.25 * depth, top - 0.1, top + rise, *way])
    return boxes


def _beside_roads(rng: np.random.Generator, count: int, pitch: float, off: float) -> list[Vector]:
    """Return places at the distance `off` from the middles of roads, and 1 for roads along y."""
    places = []
    for _ in range(count):
        line = rng.integers(-1, 2) * pitch + rng.choice([-1, 1]) * off
        along, upright = rng.uniform(-1.8, 1.8) * pitch, rng.random() < 0.5
        places.append((line, along, 1.0) if upright else (along, line, 0.0))
    return places


def build(rng: np.random.Generator) -> Town:
    """Draw a random town."""
    pitch, road = rng.uniform(38, 55), rng.uniform(7, 11)
    boxes: list[list[float]] = []
    trees: list[list[float]] = []
    half = pitch / 2 - road / 2 - 3
    for block in range((2 * REACH) ** 2):
        x, y = (block % (2 * REACH) - REACH + 0.5), (block // (2 * REACH) - REACH + 0.5)
        if rng.random() >= 0.12:
            boxes += _houses(rng, x * pitch, y * pitch, half)
            continue
        for u, v in rng.uniform(-half, half, (9, 2)):  # A park.
            high = rng.uniform(1.5, 3.5)
            trees.append([x * pitch + u, y * pitch + v, high + 1, rng.uniform(1.5, 3), high])
    for x, y, _ in _beside_roads(rng, 24, pitch, road / 2 + 1.5):
        high = rng.uniform(1.0, 2.2)
        trees.append([x, y, 1.6 + high, rng.uniform(0.9, 1.8), high])
    for x, y, upright in _beside_roads(rng, 16, pitch, road / 2 - 1.2):  # Add cars and booths.
        lengths = (0.9, 2.1) if upright else (2.1, 0.9)
        boxes.append([x, y, *lengths, 0, rng.uniform(1.3, 2.4), 1, 0])
    rows = np.array(boxes, float)
    middle, rise = (rows[:, 4] + rows[:, 5]) / 2, (rows[:, 5] - rows[:, 4]) / 2
    radius = np.sqrt(rows[:, 2] ** 2 + rows[:, 3] ** 2 + rise**2)
    turn, high = rng.uniform(0, 2 * math.pi), rng.uniform(0.6, 1.0)
    sun = math.cos(turn) * math.cos(high), math.sin(turn) * math.cos(high), math.sin(high)
    return Town(pitch, road, np.column_stack([rows, middle, radius]), np.array(trees, float), sun)


def _looking(eye: Array, at: Array) -> Array:
    """Return the axes of a camera at `eye` that looks at a point; the horizon is level."""
    ahead = (at - eye) / np.linalg.norm(at - eye)
    up = np.array([0.0, 0.0, 1.0] if abs(ahead[2]) < 0.999 else [0.0, 1.0, 0.0])
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


def fly(rng: np.random.Generator, town: Town, count: int, width: int) -> list[View]:
    """Return the photos of the drone."""
    way = rng.integers(0, 3)
    low, high = sorted(rng.uniform(60, 115, 2))
    # Use one row more than the square root, because the held-out photos would otherwise all be in
    # one column.
    views, rows = [], math.isqrt(count) + 1
    for i in range(count):
        z, share = rng.uniform(low, high), i / count
        if way == 0:
            turn, r = 6 * math.pi * share + rng.normal(0, 0.05), town.pitch * (0.5 + 1.2 * share)
            eye = np.array([r * math.cos(turn), r * math.sin(turn), z])
            at = np.array([*rng.normal(0, 0.35 * town.pitch, 2), 3.0])
        elif way == 1:
            u, v = i % rows / (rows - 1) - 0.5, (i // rows) * rows / count - 0.5
            eye = np.array([2.6 * town.pitch * u, 2.6 * town.pitch * v, z])
            at = np.array([*(eye[:2] + rng.normal(0, 12, 2)), 0.0])
        else:
            eye = np.array([*rng.uniform(-1.8, 1.8, 2) * town.pitch, z])
            at = np.array([*(0.35 * eye[:2] + rng.normal(0, 15, 2)), 3.0])
        views.append(View("aerial", i, eye, _looking(eye, at), width))
    return views


def _vector(row: Array) -> Vector:
    x, y, z = map(float, row)
    return x, y, z


def walk(rng: np.random.Generator, town: Town, count: int, width: int) -> list[View]:
    """Return street photos along or across roads, with at least 4 m of free space in the middle."""
    views: list[View] = []
    while len(views) < count:
        line = rng.integers(-1, 2) * town.pitch + rng.uniform(-0.4, 0.4) * town.road
        along, upright = rng.uniform(-1.5, 1.5) * town.pitch, rng.random() < 0.5
        x, y = (line, along) if upright else (along, line)
        eye = np.array([x, y, rng.uniform(1.6, 2.2)])
        turn = rng.choice([0, math.pi]) + rng.normal(0, 0.5) + (math.pi / 2 if upright else 0)
        ahead = np.array([math.cos(turn), math.sin(turn), rng.uniform(-0.1, 0.25)])
        axes = _looking(eye, eye + ahead)
        free = first_hit(_vector(eye), _vector(axes[2]), town.boxes, town.trees, False)[0]
        if free < 4 or town.holds(eye):
            continue
        views.append(View("street", len(views), eye, axes, width))
    return views


def take_photos(folder: Path, seed: int, town: Town, views: list[View]) -> list[Array]:
    """Write the photos, and return their depths [H, W], 0 for the sky."""
    depths = []
    things = town.boxes, town.trees, town.sun, np.array([1000 * seed, town.pitch, town.road])
    for view in views:
        camera = view.eye, view.axes, view.focal
        image, depth = photograph(camera, things, view.size, RAYS)
        path = folder / "images" / view.name
        path.parent.mkdir(parents=True, exist_ok=True)
        levels = (image ** (1 / 1.3) * 255 + 0.5).astype(np.uint8)
        Image.fromarray(levels).save(path, quality=95)
        depths.append(depth)
    return depths


def _sampled(rng: np.random.Generator, view: View, depth: Array, count: int) -> Array:
    """Return random visible points [count, 3] of a photo."""
    rows, columns = np.nonzero(depth)
    some = rng.choice(len(rows), min(count, len(rows)), replace=False)
    z = depth[rows[some], columns[some]]
    width, height = view.size
    across = (columns[some] + 0.5 - width / 2) / view.focal * z
    down = (rows[some] + 0.5 - height / 2) / view.focal * z
    return np.asarray(view.eye + np.column_stack([across, down, z]) @ view.axes)


def _sees(view: View, depth: Array, points: Array) -> NDArray[np.bool_]:
    """Return [N], True for points that a photo shows without occlusion."""
    (u, v, z), (width, height) = view.project(points).T, view.size
    inside = (z > 0.1) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    column = np.where(inside, u, 0).astype(int)
    row = np.where(inside, v, 0).astype(int)
    return np.asarray(inside & (np.abs(depth[row, column] - z) < 0.02 * np.abs(z)))


def _tracks(
    rng: np.random.Generator,
    views: list[View],
    depths: list[Array],
    points: Array,
    source: Integers,
) -> list[list[int]]:
    """Return the photos of each point; the first is the photo from which the point was computed."""
    sees = np.array([_sees(v, d, points) for v, d in zip(views, depths, strict=True)])
    kinds = np.array([view.kind for view in views])
    tracks = []
    for point, first in enumerate(source):
        seen = sees[:, point].copy()
        seen[first] = False
        own = rng.permutation(np.flatnonzero(seen & (kinds == kinds[first])))[:2]
        other = rng.permutation(np.flatnonzero(seen & (kinds != kinds[first])))[:1]
        tracks.append([int(first), *map(int, own), *map(int, other)])
    return tracks


def write_model(
    folder: Path, rng: np.random.Generator, views: list[View], depths: list[Array]
) -> int:
    """Write cameras, poses and points, and return the number of points."""
    trained = [n for n, view in enumerate(views) if view.number % EVERY]
    each = POINTS // len(trained) + 1
    samples = [_sampled(rng, views[n], depths[n], each) for n in trained]
    points = np.concatenate(samples)
    sizes = [len(some) for some in samples]
    source = np.repeat(np.arange(len(trained), dtype=np.int64), sizes)
    chosen = [views[n] for n in trained]
    tracks = _tracks(rng, chosen, [depths[n] for n in trained], points, source)
    colours = [_colours(folder, view, some) for view, some in zip(chosen, samples, strict=True)]
    paints = np.concatenate(colours)
    observations: dict[str, list[str]] = {view.name: [] for view in views}
    lines: list[str] = []
    for n, track in enumerate(tracks):
        if len(track) < 2:
            continue
        number, elements = len(lines) + 1, []
        for view in (chosen[k] for k in track):
            u, v = view.project(points[n : n + 1])[0, :2] + rng.normal(0, 0.25, 2)
            elements.append(f"{views.index(view) + 1} {len(observations[view.name])}")
            observations[view.name].append(f"{u:.3f} {v:.3f} {number}")
        place = " ".join(f"{c:.6f}" for c in points[n] + rng.normal(0, 0.02, 3))
        lines.append(f"{number} {place} {' '.join(map(str, paints[n]))} 0.35 {' '.join(elements)}")
    _write(folder / "sparse" / "0", views, observations, lines)
    return len(lines)


def _colours(folder: Path, view: View, points: Array) -> NDArray[np.uint8]:
    """Return the colours [N, 3] of points in a photo."""
    column, row = np.floor(view.project(points)[:, :2]).astype(int).T
    with Image.open(folder / "images" / view.name) as photo:
        pixels = np.asarray(photo, np.uint8)
    width, height = view.size
    chosen: NDArray[np.uint8] = pixels[row.clip(0, height - 1), column.clip(0, width - 1)]
    return chosen


def _write(
    model: Path, views: list[View], observations: dict[str, list[str]], points: list[str]
) -> None:
    """Write the three text files of a COLMAP model."""
    model.mkdir(parents=True, exist_ok=True)
    kinds = {view.kind: view for view in views}
    cameras = []
    for n, view in enumerate(kinds.values(), 1):
        width, height = view.size
        numbers = view.focal, view.focal, width / 2, height / 2
        cameras.append(f"{n} PINHOLE {width} {height} {' '.join(map(str, numbers))}")
    images = []
    for n, view in enumerate(views, 1):
        x, y, z, w = Rotation.from_matrix(view.axes).as_quat()
        pose = " ".join(f"{c:.12g}" for c in (w, x, y, z, *(-view.axes @ view.eye)))
        images.append(f"{n} {pose} {list(kinds).index(view.kind) + 1} {view.name}")
        images.append(" ".join(observations[view.name]))
    for name, text in (("cameras", cameras), ("images", images), ("points3D", points)):
        (model / f"{name}.txt").write_text("\n".join(text) + "\n", encoding="utf-8")


def main() -> None:
    """Write a scene, and print a summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--aerial", type=int, default=64)
    parser.add_argument("--street", type=int, default=64)
    parser.add_argument("--width", type=int, default=640, help="width of the photos in pixels")
    args = parser.parse_args()
    if min(args.aerial, args.street) < 2 or args.width < 8:
        parser.error("at least two photos of each kind are needed, at least 8 pixels wide")
    rng = np.random.default_rng(args.seed)
    town = build(rng)
    views = [
        *fly(rng, town, args.aerial, args.width),
        *walk(rng, town, args.street, args.width),
    ]
    depths = take_photos(args.out, args.seed, town, views)
    points = write_model(args.out, rng, views, depths)
    heights = [view.eye[2] for view in views if view.kind == "aerial"]
    print(
        f"{args.out}: {len(town.boxes)} boxes, {len(town.trees)} trees, {len(views)} photos, "
        f"{points:,} points, drone {min(heights):.0f} to {max(heights):.0f} m above ground"
    )


if __name__ == "__main__":
    main()
