"""The cameras and points of a scene as arrays in input coordinates: trials change them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Scene

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Photos as they are, neither turned nor mirrored.
UPRIGHT: Final = np.eye(2)


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras, and the points of their scene.

    Attributes:
        rotations: [V, 3, 3] world to camera.
        translations: [V, 3] world to camera, input units.
        focal: [V, 2] pixels.
        principal: [V, 2] pixels.
        sizes: [V, 2] width and height in pixels.
        points: [P, 3] input units.
        photos: [V] the view whose photo each camera is compared with.
        count: Photos of the scene.
        turn: [2, 2] turns or mirrors the photos around their middle.
    """

    rotations: Floats
    translations: Floats
    focal: Floats
    principal: Floats
    sizes: Floats
    points: Floats
    photos: Integers
    count: int
    turn: Floats

    @classmethod
    def of(cls, scene: Scene) -> "Rig":
        """The rig of a scene."""
        cameras = [view.camera for view in scene.views]
        poses = np.stack([each.world_to_camera.numpy() for each in cameras])
        rotations = poses[:, :3, :3]
        centers = scene.similarity.to_input(-np.einsum("vji,vj->vi", rotations, poses[:, :3, 3]))
        return cls(
            rotations=rotations,
            translations=-np.einsum("vij,vj->vi", rotations, centers),
            focal=np.array([[each.fx, each.fy] for each in cameras]),
            principal=np.array([[each.cx, each.cy] for each in cameras]),
            sizes=np.array([[each.width, each.height] for each in cameras], dtype=np.float64),
            points=scene.similarity.to_input(scene.points),
            photos=np.arange(len(cameras)),
            count=len(cameras),
            turn=UPRIGHT,
        )

    def chosen(self, views: Sequence[int] | Integers) -> "Rig":
        """The rig with some of its cameras, which keep their photos."""
        rows = np.asarray(views, dtype=np.int64)
        return replace(
            self,
            rotations=self.rotations[rows],
            translations=self.translations[rows],
            focal=self.focal[rows],
            principal=self.principal[rows],
            sizes=self.sizes[rows],
            photos=self.photos[rows],
        )

    def joined(self, others: Sequence["Rig"]) -> "Rig":
        """The cameras of this rig and of others with the same points, in one rig."""
        rigs = (self, *others)
        return replace(
            self,
            rotations=np.concatenate([each.rotations for each in rigs]),
            translations=np.concatenate([each.translations for each in rigs]),
            focal=np.concatenate([each.focal for each in rigs]),
            principal=np.concatenate([each.principal for each in rigs]),
            sizes=np.concatenate([each.sizes for each in rigs]),
            photos=np.concatenate([each.photos for each in rigs]),
        )

    @property
    def centers(self) -> Floats:
        """[V, 3] camera centres, input units."""
        return np.asarray(-np.einsum("vji,vj->vi", self.rotations, self.translations))

    def project(self, rows: Integers) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Where the cameras see points.

        Args:
            rows: [V, N] rows of points for each camera.

        Returns:
            [2, V, N] places in the photo as shares of its width and height, [V, N] depths, and
            [V, N] whether the point is in front of the camera and in its frame.
        """
        local = self.rotations @ self.points.take(rows, axis=0).transpose(0, 2, 1)
        x, y, depth = local.transpose(1, 0, 2) + self.translations.T[:, :, None]
        front = depth > 0.0
        inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=front)
        focal, principal = (
            (each / self.sizes).T[:, :, None] for each in (self.focal, self.principal)
        )
        across, down = shares = focal * np.stack([x * inverse, y * inverse]) + principal
        inside = front & (across >= 0.0) & (across < 1.0) & (down >= 0.0) & (down < 1.0)
        if self.turn is not UPRIGHT:
            shares = np.tensordot(self.turn, shares - 0.5, axes=1) + 0.5
        return shares, depth, inside
