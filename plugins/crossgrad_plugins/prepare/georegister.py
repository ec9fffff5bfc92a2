"""Georegistration of models by GPS, and merging of models that are connected only by GPS."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.prepare.earth import levelled
from crossgrad_plugins.prepare.pycolmap_calls import quiet

if TYPE_CHECKING:
    import pycolmap

#: Minimum number of photos with GPS for a similarity.
FEWEST: Final = 3
#: Possible GPS errors in metres, from a good receiver to a phone between houses. The smallest error
#: with which most photos agree is used.
_ERRORS: Final = (3.0, 10.0, 30.0)
_AGREEING: Final = 0.6
#: The spread of the photos across their main direction must be at least this many GPS errors. If
#: the photos show the upward direction, a spread along the main direction is enough.
_SPREAD: Final = 3.0
#: Cameras are on a line if their spread across the line is below this share of the spread along the
#: line.
_STRAIGHT: Final = 0.05
#: Maximum number of photos on a line that are paired with each other.
_ASKED: Final = 1_000


@dataclass(frozen=True, eq=False)
class Placement:
    """The position and orientation of a model on Earth.

    Attributes:
        similarity: From the model to metres east, north and up.
        residuals: Name of a photo with GPS -> camera position minus GPS position [3], metres.
        agreeing: Names of the photos with which the similarity was fitted.
    """

    similarity: "pycolmap.Sim3d"
    residuals: Mapping[str, NDArray[np.float64]]
    agreeing: frozenset[str]

    @property
    def rms(self) -> float:
        """Root mean square residual of the agreeing photos, metres."""
        lengths = [float(np.linalg.norm(self.residuals[name])) for name in sorted(self.agreeing)]
        return float(np.sqrt(np.mean(np.square(lengths))))


def centers_of(model: "pycolmap.Reconstruction") -> dict[str, NDArray[np.float64]]:
    """Return the centre [3] of each camera of a model, by photo name."""
    images = (model.image(number) for number in model.reg_image_ids())
    return {image.name: np.asarray(image.projection_center()) for image in images}


def placement_of(
    model: "pycolmap.Reconstruction",
    positions: Mapping[str, NDArray[np.float64]],
    tops: Mapping[str, NDArray[np.float64]],
) -> tuple[Placement | None, str]:
    """Return the placement of a model, or None and the reason why there is no placement.

    Args:
        model: The model.
        positions: Name of a photo with GPS -> position [3], metres east, north and up.
        tops: Name of a photo -> camera axis [3] towards the top of the photo.
    """
    centers = centers_of(model)
    names = sorted(centers.keys() & positions.keys())
    if len(names) < FEWEST:
        return None, f"{len(names)} of its photos have GPS, but at least {FEWEST} are needed"
    here = np.array([centers[name] for name in names])
    there = np.array([positions[name] for name in names])
    alignment = _aligned(here, there) or _on_a_line(here, there)
    if alignment is None:
        return None, (
            "GPS and poses do not agree: no similarity transform brings most photos within 30 m"
        )
    similarity, agrees = alignment
    agreeing = frozenset(name for name, good in zip(names, agrees, strict=True) if good)
    residuals = dict(zip(names, _moved(similarity, here) - there, strict=True))
    placement = Placement(similarity, residuals, agreeing)
    middle, (along, across), direction = _line(_moved(similarity, here[agrees]))
    if across >= _SPREAD * placement.rms:
        return placement, ""
    if along < _SPREAD * placement.rms:
        return None, (
            f"GPS is not accurate enough: its photos are {along:.1f} m apart, and the GPS "
            f"error is {placement.rms:.1f} m"
        )
    upright = levelled(model, similarity, (middle, direction), tops)
    if upright is None:
        return None, (
            "the GPS positions are on a line, and the photos do not show the upward direction"
        )
    residuals = dict(zip(names, _moved(upright, here) - there, strict=True))
    return Placement(upright, residuals, agreeing), ""


def _moved(similarity: "pycolmap.Sim3d", points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the transformed points [N, 3]."""
    matrix = similarity.matrix()
    return np.asarray(points @ matrix[:, :3].T + matrix[:, 3])


def _line(
    points: NDArray[np.float64],
) -> tuple[NDArray[np.float64], tuple[float, float], NDArray[np.float64]]:
    """Fit a line to points [N, 3] and return middle [3], spread along and across, direction [3].

    The two spreads are root mean squares.
    """
    middle = points.mean(0)
    _, sizes, axes = np.linalg.svd(points - middle, full_matrices=False)
    along, across = (float(size) / len(points) ** 0.5 for size in sizes[:2])
    return middle, (along, across), axes[0]


def _aligned(
    here: NDArray[np.float64], there: NDArray[np.float64]
) -> tuple["pycolmap.Sim3d", NDArray[np.bool_]] | None:
    """Return the similarity that most points [N, 3] agree with, and these points."""
    import pycolmap

    options = pycolmap.RANSACOptions()
    options.random_seed = 0
    for error in _ERRORS:
        options.max_error = error
        with quiet():
            estimate: Any = pycolmap.estimate_sim3d_robust(here, there, options)
        if not estimate:
            continue
        agrees = np.asarray(estimate["inlier_mask"], dtype=np.bool_)
        if agrees.sum() < max(FEWEST, _AGREEING * len(here)):
            continue
        refined = pycolmap.estimate_sim3d(here[agrees], there[agrees])
        return (refined or estimate["tgt_from_src"]), agrees
    return None


def _on_a_line(
    here: NDArray[np.float64], there: NDArray[np.float64]
) -> tuple["pycolmap.Sim3d", NDArray[np.bool_]] | None:
    """Return a similarity for points [N, 3] on a line, and the points that agree with it.

    The roll of the similarity about the line is arbitrary. Scale and direction are medians over
    pairs of points (Theil-Sen estimator). If there are more than `_ASKED` points, only `_ASKED` of
    them, spread along the line, are paired.
    """
    import pycolmap
    from scipy.spatial.transform import Rotation

    middle, (along, across), direction = _line(here)
    if across > _STRAIGHT * along:
        return None
    places = (here - middle) @ direction
    asked = np.linspace(0, len(places) - 1, min(len(places), _ASKED)).astype(np.int64)
    first, second = (asked[rows] for rows in np.triu_indices(len(asked), 1))
    gaps = places[first] - places[second]
    apart = np.abs(gaps) > _STRAIGHT * along
    slopes = (there[first] - there[second])[apart] / gaps[apart, None]
    slope = np.median(slopes, axis=0)
    scale = float(np.linalg.norm(slope))
    start = np.median(there - places[:, None] * slope, axis=0)
    if scale == 0.0:
        return None
    turn = Rotation.align_vectors(slope[None] / scale, direction[None])[0].as_matrix()
    similarity = pycolmap.Sim3d(np.column_stack([scale * turn, start - scale * turn @ middle]))
    off = np.linalg.norm(_moved(similarity, here) - there, axis=1)
    for error in _ERRORS:
        if (off <= error).sum() >= max(FEWEST, _AGREEING * len(off)):
            return similarity, off <= error
    return None


def merged(
    model: "pycolmap.Reconstruction", others: "Sequence[pycolmap.Reconstruction]"
) -> "pycolmap.Reconstruction":
    """Return a model with the photos and points of other models in one common frame.

    Photos that are already in the model are not added again. The cameras of other models were
    calibrated independently, so they are added as new cameras.
    """
    import pycolmap

    whole = pycolmap.Reconstruction(model)
    with quiet():
        for other in others:
            _add(whole, other)
    return whole


def _add(whole: "pycolmap.Reconstruction", other: "pycolmap.Reconstruction") -> None:
    import pycolmap

    present = set(whole.reg_image_ids())
    new = [number for number in other.reg_image_ids() if number not in present]
    cameras: dict[int, int] = {}
    for number in new:
        image = other.image(number)
        if image.camera_id not in cameras:
            camera = pycolmap.Camera(other.camera(image.camera_id).todict())
            camera.camera_id = max(whole.cameras, default=0) + 1
            whole.add_camera_with_trivial_rig(camera)
            cameras[image.camera_id] = camera.camera_id
        copy = pycolmap.Image(
            name=image.name,
            keypoints=np.array([point.xy for point in image.points2D]).reshape(-1, 2),
            camera_id=cameras[image.camera_id],
            image_id=number,
        )
        whole.add_image_with_trivial_frame(copy, image.cam_from_world())
    added = set(new)
    for point in other.points3D.values():
        seen = [element for element in point.track.elements if element.image_id in added]
        if len(seen) > 1:
            whole.add_point3D(point.xyz, pycolmap.Track(seen), point.color)
