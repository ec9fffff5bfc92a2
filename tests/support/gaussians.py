"""Random small scenes of Gaussians in front of a camera, for tests of rasterizers."""

from dataclasses import replace
from itertools import count

import torch
from support.brute_force import trace
from torch import Tensor

from crossgrad_core.contract.gaussians import Gaussians, Response
from crossgrad_core.contract.scene import Camera


def posed_camera(
    width: int = 20,
    height: int = 12,
    *,
    focal: float = 20.0,
    principal: tuple[float, float] = (0.45, 0.6),
) -> Camera:
    """A camera that is turned, shifted, and has unequal focal lengths.

    Args:
        width: Pixels.
        height: Pixels.
        focal: fx in pixels; fy is a tenth longer.
        principal: Principal point in shares of the width and height.
    """
    axis = torch.tensor([0.3, -0.5, 0.2], dtype=torch.float64)
    cross = torch.tensor(
        [[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]],
        dtype=torch.float64,
    )
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.linalg.matrix_exp(cross)
    pose[:3, 3] = torch.tensor([0.1, -0.2, 0.4], dtype=torch.float64)
    cx, cy = principal[0] * width, principal[1] * height
    return Camera(width, height, focal, 1.1 * focal, cx, cy, pose)


def random_gaussians(
    number: int,
    camera: Camera,
    *,
    seed: int = 0,
    sigmas: tuple[float, float] = (0.8, 4.0),
    depths: tuple[float, float] = (1.0, 4.0),
    opacities: tuple[float, float] = (0.1, 0.9),
    border: float = 0.2,
    sh_degree: int | None = None,
    response: Response = "plain",
) -> Gaussians:
    """Gaussians whose means project onto the image and a border around it; float64.

    Args:
        number: Number N of Gaussians.
        camera: The camera that sees them.
        seed: Seed of everything drawn.
        sigmas: Range of the standard deviations in pixels at each Gaussian's depth, log-uniform.
        depths: Range of the camera depths, log-uniform.
        opacities: Range of the opacities.
        border: Width of the border in shares of the image size.
        sh_degree: Colours as spherical harmonics of this degree; None for RGB.
        response: How a Gaussian fills a pixel.
    """
    rng = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=rng, dtype=torch.float64)

    def log_uniform(bounds: tuple[float, float], *shape: int) -> Tensor:
        low, high = torch.tensor(bounds, dtype=torch.float64).log().tolist()
        return uniform(low, high, *shape).exp()

    z = log_uniform(depths, number)
    u = uniform(-border * camera.width, (1 + border) * camera.width, number)
    v = uniform(-border * camera.height, (1 + border) * camera.height, number)
    local = torch.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], -1)
    pose = camera.world_to_camera
    gaussians = Gaussians(
        means=(local - pose[:3, 3]) @ pose[:3, :3],
        quats=torch.randn(number, 4, generator=rng, dtype=torch.float64),
        scales=log_uniform(sigmas, number, 3) * (z / camera.fx)[:, None],
        opacities=uniform(*opacities, number),
        response=response,
    )
    if sh_degree is None:
        return replace(gaussians, colors=uniform(0.0, 1.0, number, 3))
    bands = (sh_degree + 1) ** 2
    return replace(
        gaussians,
        sh_dc=uniform(-1.0, 1.0, number, 1, 3),
        sh_rest=uniform(-0.4, 0.4, number, bands - 1, 3) if bands > 1 else None,
        sh_degree=sh_degree,
    )


def smooth_gaussians(
    number: int,
    camera: Camera,
    *,
    seed: int = 0,
    margin: float = 1e-3,
    sigmas: tuple[float, float] = (0.8, 4.0),
    opacities: tuple[float, float] = (0.1, 0.9),
    border: float = 0.2,
    sh_degree: int | None = None,
    response: Response = "plain",
) -> Gaussians:
    """The first draw of `random_gaussians` around which the image is differentiable.

    No value that a rule compares with a threshold is within `margin` (relative) of it, so that
    small steps, and the rounding of other number types, change no decision.

    Args:
        number: Number N of Gaussians.
        camera: The camera that sees them.
        seed: The first seed tried.
        margin: Smallest relative distance from a threshold.
        sigmas: See `random_gaussians`.
        opacities: See `random_gaussians`.
        border: See `random_gaussians`.
        sh_degree: See `random_gaussians`.
        response: See `random_gaussians`.
    """
    for draw in count(1000 * seed):
        gaussians = random_gaussians(
            number,
            camera,
            seed=draw,
            sigmas=sigmas,
            opacities=opacities,
            border=border,
            sh_degree=sh_degree,
            response=response,
        )
        if away_from_thresholds(gaussians, camera, margin=margin):
            return gaussians
    raise AssertionError


def away_from_thresholds(
    gaussians: Gaussians, camera: Camera, *, margin: float = 1e-3, max_alpha: float = 0.99
) -> bool:
    """Whether every compared value is farther than `margin` (relative) from its threshold."""
    result = trace(gaussians, camera, max_alpha=max_alpha)
    return bool((result.pixel_gaps > margin).all() and (result.gaussian_gaps > margin).all())
