"""Tiny synthetic COLMAP scenes on disk, with photos that agree with their poses.

A textured ground plane with a few coloured balls is ray-traced through the very camera models that
are written, so every test that reads, undistorts, resizes or trains has exact ground truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.scene.pycolmap_guard import guard_pycolmap

if TYPE_CHECKING:
    import pycolmap

Array = NDArray[np.float64]

_BALLS = 6
_WAVES = 8
_SUPERSAMPLING = 2
_DEPTH_TOLERANCE = 1e-3
_DISTORTION = {"FOV": 0.4, "EUCM": 0.5}


@dataclass(frozen=True, eq=False)
class _World:
    """A ground plane z = 0 and balls resting on it.

    Attributes:
        centers: [B, 3] ball centres.
        radii: [B] ball radii.
        ball_colors: [B, 3] in [0, 1].
        waves: [W, 2] wave vectors of the ground texture, radians per unit.
        phases: [W, 3] phase of each wave in each colour channel.
    """

    centers: Array
    radii: Array
    ball_colors: Array
    waves: Array
    phases: Array

    def trace(self, origin: Array, rays: Array) -> tuple[Array, Array]:
        """First hits of rays that start at one point.

        Args:
            origin: [3].
            rays: [M, 3], need not be unit length; must point below the horizon.

        Returns:
            [M] ray parameters of the hits and [M, 3] colours in [0, 1].
        """
        depth = -origin[2] / rays[:, 2]
        color = self._ground(origin[:2] + depth[:, None] * rays[:, :2])
        for center, radius, paint in zip(self.centers, self.radii, self.ball_colors, strict=True):
            offset = origin - center
            a = (rays * rays).sum(1)
            b = rays @ offset
            discriminant = b * b - a * (offset @ offset - radius * radius)
            near = (-b - np.sqrt(np.maximum(discriminant, 0))) / a
            hit = (discriminant > 0) & (near > 0) & (near < depth)
            normal = (offset + near[:, None] * rays) / radius
            shade = 0.65 + 0.35 * normal[:, 2:]
            depth = np.where(hit, near, depth)
            color = np.where(hit[:, None], paint * shade, color)
        return depth, color

    def _ground(self, xy: Array) -> Array:
        """[M, 3] colours of points [M, 2] on the ground."""
        waves = np.cos((xy @ self.waves.T)[:, :, None] + self.phases)
        return np.asarray(0.5 + 0.45 * np.tanh(waves.sum(1) / 2))


def _make_world(rng: np.random.Generator) -> _World:
    radii = rng.uniform(0.15, 0.4, _BALLS)
    xy = rng.uniform(-1.2, 1.2, (_BALLS, 2))
    angles = rng.uniform(0, 2 * np.pi, _WAVES)
    lengths = np.geomspace(1.2, 6.0, _WAVES)
    waves = np.stack([np.cos(angles), np.sin(angles)], 1) * (2 * np.pi / lengths)[:, None]
    return _World(
        centers=np.column_stack([xy, radii]),
        radii=radii,
        ball_colors=rng.uniform(0.1, 1.0, (_BALLS, 3)),
        waves=waves,
        phases=rng.uniform(0, 2 * np.pi, (_WAVES, 3)),
    )


@dataclass(frozen=True, eq=False)
class _Shot:
    """One photo to be taken: name, pycolmap camera, [3, 3] world-to-camera rotation, [3] centre."""

    name: str
    camera: "pycolmap.Camera"
    rotation: Array
    center: Array

    def rays(self, pixels: Array) -> Array:
        """[M, 3] world rays of unit depth through pixels [M, 2]."""
        plane = np.asarray(self.camera.cam_from_img(pixels), dtype=float)
        return np.asarray(np.column_stack([plane, np.ones(len(plane))]) @ self.rotation)

    def project(self, points: Array) -> tuple[Array, Array]:
        """[N, 2] pixels and [N] depths of world points [N, 3]."""
        local = (points - self.center) @ self.rotation.T
        return np.asarray(self.camera.img_from_cam(local)), local[:, 2]


def _look_at(center: Array, target: Array) -> Array:
    """[3, 3] world-to-camera rotation (x right, y down, z forward), world z up."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _make_camera(
    camera_id: int, model: str, size: tuple[int, int], focal: float, centered: bool = False
) -> "pycolmap.Camera":
    """A pycolmap camera with an off-centre principal point and, where it has any, distortion."""
    guard_pycolmap()
    import pycolmap

    camera = pycolmap.Camera.create_from_model_name(camera_id, model, focal, *size)
    params = np.array(camera.params)
    params[list(camera.principal_point_idxs())] += [0.0, 0.0] if centered else [1.5, -1.0]
    first_extra = list(camera.extra_params_idxs())[:1]
    params[first_extra] = _DISTORTION.get(model, -0.08)
    camera.params = params.tolist()
    return camera


def _make_shots(
    count: int,
    size: tuple[int, int],
    folders: Sequence[str],
    model: str,
    mixed: bool,
    centered: bool = False,
) -> tuple[list["pycolmap.Camera"], list[_Shot]]:
    width, height = size
    cameras = [_make_camera(1, model, size, 1.2 * width, centered)]
    if mixed:
        other = (width * 3 // 4, height * 5 // 4)
        cameras.append(_make_camera(2, model, other, 1.5 * width, centered))
    shots = []
    for rank in range(len(folders)):
        # Folders are rings around the scene, each 3 times farther away than the one before.
        reach = 3.0 * 3.0**rank
        for k in range(count):
            azimuth = 2 * np.pi * (k + 0.5 * rank) / count
            elevation = np.deg2rad(55 + 10 * np.cos(3 * azimuth))
            distance = reach * (1 + 0.15 * np.cos(2 * azimuth + 1))
            flat = np.cos(elevation)
            direction = [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)]
            center = distance * np.array(direction)
            target = np.array([0.1 * np.cos(5 * azimuth), 0.1 * np.sin(4 * azimuth), 0.1])
            name = f"{folders[rank]}/{k:04d}".lstrip("/")
            camera = cameras[k % len(cameras)]
            shots.append(_Shot(name, camera, _look_at(center, target), center))
    return cameras, shots


def _render(world: _World, shot: _Shot) -> NDArray[np.uint8]:
    """[H, W, 3] photo; each pixel is the mean of a small grid of rays."""
    width, height = shot.camera.width, shot.camera.height
    n = _SUPERSAMPLING
    x = (np.arange(width * n) + 0.5) / n
    y = (np.arange(height * n) + 0.5) / n
    pixels = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    _, color = world.trace(shot.center, shot.rays(pixels))
    photo = color.reshape(height, n, width, n, 3).mean((1, 3))
    return np.asarray(np.rint(photo * 255), dtype=np.uint8)


def _make_points(
    world: _World, shots: Sequence[_Shot], count: int, rng: np.random.Generator
) -> tuple[Array, NDArray[np.uint8]]:
    """[N, 3] surface points, shared out evenly among the photos, and their [N, 3] colours."""
    positions, colors = [], []
    for k, shot in enumerate(shots):
        share = (k + 1) * count // len(shots) - k * count // len(shots)
        pixels = rng.uniform(0.05, 0.95, (share, 2)) * [shot.camera.width, shot.camera.height]
        rays = shot.rays(pixels)
        depth, color = world.trace(shot.center, rays)
        positions.append(shot.center + depth[:, None] * rays)
        colors.append(np.rint(color * 255).astype(np.uint8))
    return np.concatenate(positions), np.concatenate(colors)


def _observe(world: _World, shot: _Shot, points: Array) -> tuple[NDArray[np.int64], Array]:
    """Indices [S] of the points that a photo shows, and their pixels [S, 2]."""
    pixels, depth = shot.project(points)
    size = np.array([shot.camera.width, shot.camera.height])
    inside = (depth > 0) & (pixels > 0).all(1) & (pixels < size).all(1)
    surface, _ = world.trace(shot.center, points - shot.center)
    visible = inside & (np.abs(surface - 1) < _DEPTH_TOLERANCE)
    return np.flatnonzero(visible), pixels[visible]


def _reconstruct(
    cameras: Sequence["pycolmap.Camera"],
    shots: Sequence[_Shot],
    points: tuple[Array, NDArray[np.uint8]],
    seen: Sequence[tuple[NDArray[np.int64], Array]],
    suffix: str,
) -> "pycolmap.Reconstruction":
    """The pycolmap reconstruction: poses, points, and the tracks that `seen` describes."""
    guard_pycolmap()
    import pycolmap

    model = pycolmap.Reconstruction()
    for camera in cameras:
        model.add_camera_with_trivial_rig(camera)
    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in points[0]]
    for image_id, (shot, (indices, pixels)) in enumerate(zip(shots, seen, strict=True), 1):
        image = pycolmap.Image(
            name=shot.name + suffix,
            keypoints=pixels,
            camera_id=shot.camera.camera_id,
            image_id=image_id,
        )
        pose = np.column_stack([shot.rotation, -shot.rotation @ shot.center])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for row, index in enumerate(indices):
            tracks[index].append(pycolmap.TrackElement(image_id, row))
    for xyz, color, elements in zip(*points, tracks, strict=True):
        track = pycolmap.Track()
        track.add_elements(elements)
        model.add_point3D(xyz, track, color)
    return model


def write_tiny_scene(
    folder: Path,
    *,
    views: int = 8,
    width: int = 48,
    height: int = 32,
    points: int = 200,
    seed: int = 0,
    folders: Sequence[str] = ("",),
    model: str = "PINHOLE",
    mixed: bool = False,
    centered: bool = False,
    text: bool = False,
    suffix: str = ".png",
    scale: float = 1.0,
    offset: Sequence[float] = (0.0, 0.0, 0.0),
) -> Path:
    """Writes a COLMAP scene (`images/`, `sparse/0/`) whose photos agree with its poses.

    Cameras stand on a ring around the scene, 3 units away, and look down at it.

    Args:
        folder: Where to write; made if need be.
        views: Photos per entry of `folders`, named `0000`, `0001` ...
        width: Photo width in pixels.
        height: Photo height in pixels.
        points: Number of SfM points, exact and on the surfaces.
        seed: Seed of the scene's shapes, textures and points.
        folders: Image folders; each is a ring 3 times farther away than the one before, so
            `("street", "aerial")` is a near and a far regime with the same file names.
        model: COLMAP camera model; models with distortion get some.
        mixed: Every other photo is of a second camera with another size and focal length.
        centered: The principal point is the middle of the photo.
        text: Write cameras.txt, images.txt, points3D.txt rather than the binary files.
        suffix: `.png`, `.jpg` (quality 95) or another that Pillow knows.
        scale: Multiplies every length of the scene.
        offset: Added to every position, after scaling.

    Returns:
        `folder`.
    """
    guard_pycolmap()
    import pycolmap
    from PIL import Image

    rng = np.random.default_rng(seed)
    world = _make_world(rng)
    cameras, shots = _make_shots(views, (width, height), folders, model, mixed, centered)
    cloud = _make_points(world, shots, points, rng)
    seen = [_observe(world, shot, cloud[0]) for shot in shots]
    for shot in shots:
        path = folder / "images" / (shot.name + suffix)
        path.parent.mkdir(parents=True, exist_ok=True)
        # Formats other than JPEG ignore these two.
        Image.fromarray(_render(world, shot)).save(path, quality=95, subsampling=0)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    reconstruction = _reconstruct(cameras, shots, cloud, seen, suffix)
    identity = pycolmap.Rotation3d()
    reconstruction.transform(pycolmap.Sim3d(scale, identity, np.asarray(offset, dtype=float)))
    write = reconstruction.write_text if text else reconstruction.write_binary
    write(sparse)
    return folder
