"""Render a PLY with independent code, in NumPy and float64, one Gaussian after the other.

This program reads and draws the file by the published rules, without code of crossgrad. The results
of a run for its PLY can therefore be checked independently.

    python benchmarks/viewer.py RUN [--ply FILE]      # PSNR of the held-out photos, on black
"""

import argparse
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import crossgrad_core as cg

Array = NDArray[np.float64]

#: Constants of 3DGS: minimum alpha, maximum alpha, transmittance at which a pixel is finished,
#: dilation in px^2, near plane in camera units, and margin for the limits of the Jacobian.
LEAST, CAP, STOP, DILATION, NEAR, MARGIN = 1 / 255, 0.99, 1e-4, 0.3, 1e-3, 1.3


def read(path: Path) -> dict[str, Array]:
    """Return the vertex columns of a binary PLY of floats."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii").splitlines()]
    names = [words[2] for words in lines if words[0] == "property"]
    (count,) = (int(words[2]) for words in lines if words[:2] == ["element", "vertex"])
    table = np.frombuffer(body, "<f4", count * len(names)).reshape(count, len(names))
    return dict(zip(names, table.T.astype(np.float64), strict=True))


def harmonics(d: Array, bands: int) -> Array:
    """Return real spherical harmonics [N, bands] of unit directions [N, 3], as in 3DGS."""
    x, y, z = d.T
    xx, yy, zz = x * x, y * y, z * z
    found = [
        np.full_like(x, 0.28209479177387814),
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.stack(found[:bands], 1)


def rotations(quats: Array) -> Array:
    """Return rotations [N, 3, 3] of quaternions wxyz [N, 4] of any norm."""
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


@dataclass(frozen=True)
class Projection:
    """N Gaussians seen by a camera. `pose` [4, 4] maps to camera axes, up to a positive scale."""

    ply: dict[str, Array]
    pose: Array
    k: Array
    size: tuple[int, int]

    @cached_property
    def means(self) -> Array:
        """[N, 3] means in the coordinates of the file."""
        return np.stack([self.ply[name] for name in "xyz"], 1)

    @cached_property
    def local(self) -> Array:
        """[N, 3] means in camera axes."""
        return self.means @ self.pose[:3, :3].T + self.pose[:3, 3]

    @cached_property
    def axes(self) -> Array:
        """[N, 3, 3] principal axes as columns, scaled by the standard deviations."""
        zoom = np.cbrt(np.linalg.det(self.pose[:3, :3]))
        sides = np.exp(np.stack([self.ply[f"scale_{i}"] for i in range(3)], 1)) * zoom
        quats = np.stack([self.ply[f"rot_{i}"] for i in range(4)], 1)
        return self.pose[:3, :3] / zoom @ rotations(quats) * sides[:, None, :]

    @cached_property
    def opacities(self) -> Array:
        """[N] opacities."""
        return 1 / (1 + np.exp(-self.ply["opacity"]))

    @cached_property
    def colors(self) -> Array:
        """[N, 3] colours."""
        away = self.means + np.linalg.solve(self.pose[:3, :3], self.pose[:3, 3])
        bands = 1 + sum(name.startswith("f_rest_") for name in self.ply) // 3
        basis = harmonics(away / np.linalg.norm(away, axis=1, keepdims=True), bands)
        found = np.empty((len(away), 3))
        for c in range(3):
            rest = [f"f_rest_{c * (bands - 1) + b}" for b in range(bands - 1)]
            found[:, c] = sum(
                basis[:, b] * self.ply[name] for b, name in enumerate([f"f_dc_{c}", *rest])
            )
        return np.maximum(found + 0.5, 0.0)

    @cached_property
    def reach(self) -> tuple[Array, Array]:
        """Minimum [2] and maximum [2] of x / z and y / z in the Jacobian."""
        focal, center = np.diag(self.k)[:2], self.k[:2, 2]
        low, high = -center / focal, (np.array(self.size) - center) / focal
        margin = (MARGIN - 1) / 2 * (high - low)
        return low - margin, high + margin

    def footprint(self, i: int) -> tuple[Array, Array]:
        """Return centre [2] in pixels and dilated covariance [2, 2] of Gaussian i."""
        x, y, z = self.local[i]
        fx, fy = self.k[0, 0], self.k[1, 1]
        tx, ty = np.clip([x / z, y / z], *self.reach)
        jacobian = np.array([[fx / z, 0, -fx * tx / z], [0, fy / z, -fy * ty / z]])
        spread = jacobian @ self.axes[i]
        center = np.array([fx * x / z, fy * y / z]) + self.k[:2, 2]
        return center, spread @ spread.T + DILATION * np.eye(2)


def draw(seen: Projection) -> Array:
    """Return the image [H, W, 3] over black."""
    width, height = seen.size
    image, through = np.zeros((height, width, 3)), np.ones((height, width))
    ended = np.zeros((height, width), bool)
    depth = seen.local[:, 2]
    for i in np.argsort(depth, kind="stable"):
        peak = seen.opacities[i]
        if depth[i] <= NEAR or peak < LEAST:
            continue
        (u, v), ((a, b), (_, c)) = seen.footprint(i)
        wide, high = np.sqrt(2 * np.log(peak / LEAST) * np.array([a, c]))
        x0, x1 = int(max(0, np.floor(u - wide))), int(min(width, np.ceil(u + wide) + 1))
        y0, y1 = int(max(0, np.floor(v - high))), int(min(height, np.ceil(v + high) + 1))
        if x0 >= x1 or y0 >= y1:
            continue
        dx, dy = np.arange(x0, x1) + 0.5 - u, (np.arange(y0, y1) + 0.5 - v)[:, None]
        power = -0.5 * (c * dx * dx + a * dy * dy - 2 * b * dx * dy) / (a * c - b * b)
        alpha = np.minimum(CAP, peak * np.exp(power))
        alpha[alpha < LEAST] = 0.0
        spot = slice(y0, y1), slice(x0, x1)
        behind = through[spot] * (1 - alpha)
        ended[spot] |= behind < STOP
        weight = np.where(ended[spot], 0.0, alpha * through[spot])
        image[spot] += weight[..., None] * seen.colors[i]
        through[spot] = np.where(ended[spot], through[spot], behind)
    return image


def psnr(run: "cg.Run", ply: Path) -> float:
    """Return the mean PSNR of a PLY in scene coordinates on a run's held-out photos."""
    columns, scene = read(ply), run.scene
    to_local = np.diag([scene.similarity.scale] * 3 + [1.0])
    to_local[:3, 3] = -scene.similarity.offset * scene.similarity.scale
    found = []
    for view in scene.test_views:
        camera = view.camera
        pose = camera.world_to_camera.numpy() @ to_local
        size = camera.width, camera.height
        drawn = draw(Projection(columns, pose, camera.matrix.numpy(), size))
        error = drawn.clip(0, 1) - view.photo.image().numpy() / 255
        found.append(-10 * np.log10(np.mean(error**2)))
    return float(np.mean(found))


def main() -> None:
    """Print the PSNR."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--ply", type=Path)
    given = parser.parse_args()
    ply = given.ply or given.run / "point_cloud.ply"
    print(f"{psnr(cg.open(given.run), ply):.4f} dB")


if __name__ == "__main__":
    main()
