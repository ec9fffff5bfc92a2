"""Gaussians, the output of every backbone, and renders, the output of every rasterizer."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal, SupportsIndex

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core.numerics.harmonics import harmonics_rotation
from crossgrad_core.numerics.raster_constants import COEFFICIENTS

Response = Literal["plain", "antialiased", "analytic"]
_FLOATS = ("means", "quats", "scales", "opacities", "colors", "sh_dc", "sh_rest")


@dataclass(frozen=True)
class OnDemand:
    """Tensors whose rows are updated on demand; a row is up to date only after a request.

    Attributes:
        fields: The fields of the Gaussians that contain these tensors.
        bring: Updates rows in place; its argument is [R] int32 rows without duplicates, or None for
            all rows.
    """

    fields: frozenset[str]
    bring: Callable[[Tensor | None], None]


@dataclass(frozen=True)
class Gaussians:
    """N coloured 3-D Gaussians in the local frame of the scene.

    Colour is either `colors` (RGB as drawn) or spherical harmonics `sh_dc`, `sh_rest`, evaluated at
    `sh_degree`. Exactly one of `colors` and `sh_dc` is given.

    Attributes:
        means: [N, 3] centres, local units.
        quats: [N, 4] rotations wxyz, not necessarily normalised.
        scales: [N, 3] standard deviations, local units, positive.
        opacities: [N] in [0, 1].
        colors: [N, 3] RGB.
        sh_dc: [N, 1, 3] band 0 coefficients.
        sh_rest: [N, B - 1, 3] higher bands (B = 4, 9 or 16), None at degree 0.
        sh_degree: Active degree of the spherical harmonics, 0 to 3.
        response: Formula of a Gaussian's opacity in a pixel, see `Response`.
        dilation: Number that is added to both diagonal entries of the 2-D covariance, px^2; None
            uses the dilation of the rasterizer.
        origin: [N] int64, the primitive of each Gaussian; None if Gaussian i is primitive i.
        slot: [N] int64, index of each Gaussian among the Gaussians of its primitive; None if every
            primitive gives one Gaussian.
        decoded: [P] bool, the primitives that were decoded for this view, with or without a
            resulting Gaussian; None if all were decoded.
        on_demand: Tensors whose rows must be requested before they are read. The gradients of these
            tensors are sparse tensors of whole rows. None if all rows are up to date. Only
            rasterizers with `sparse_rows` receive this field.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor | None = None
    sh_dc: Tensor | None = None
    sh_rest: Tensor | None = None
    sh_degree: int = 0
    response: Response = "plain"
    dilation: float | None = None
    origin: Tensor | None = None
    slot: Tensor | None = None
    decoded: Tensor | None = None
    on_demand: OnDemand | None = None

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def floats(self) -> list[Tensor]:
        """Return the floating-point tensors that are given, in the order of the fields."""
        return [t for t in (getattr(self, name) for name in _FLOATS) if t is not None]

    def mapped(self, function: Callable[[Tensor], Tensor]) -> "Gaussians":
        """Return the same Gaussians with `function` applied to every floating-point tensor."""
        tensors = {name: getattr(self, name) for name in _FLOATS}
        mapped: dict[str, Any] = {n: function(t) for n, t in tensors.items() if t is not None}
        return replace(self, **mapped)

    def rotated(self, rotation: Tensor, means: Tensor | None = None) -> "Gaussians":
        """Return the same Gaussians, rotated about the origin.

        A camera that is rotated in the same way sees the same image.

        Args:
            rotation: [3, 3] float64 on the CPU, orthonormal with determinant 1.
            means: [N, 3] centres of the rotated Gaussians, if they are known more precisely.
        """
        quats = _quaternion_product(_quaternion(rotation), self.quats)
        rest = self.sh_rest
        if rest is not None:
            degree = COEFFICIENTS.index(1 + rest.shape[1])
            matrix = harmonics_rotation(rotation, degree).to(rest)
            # One product of matrices is faster than one product per Gaussian.
            rest = (rest.flatten(1) @ torch.kron(matrix.T, matrix.new_ones(3).diag())).view_as(rest)
        if means is None:
            means = (self.means.double() @ rotation.T.to(self.means.device)).to(self.means)
        return replace(self, means=means, quats=quats, sh_rest=rest)

    def selected(self, rows: Tensor) -> "Gaussians":
        """Return the Gaussians that are marked in `rows` [N] bool, without their origins."""
        chosen = self.mapped(lambda tensor: tensor[rows.to(tensor.device)])
        return replace(chosen, origin=None, slot=None, decoded=None)

    def detached(self) -> "Gaussians":
        """Return the same Gaussians without their graph."""
        return self.mapped(torch.Tensor.detach)

    def misfit(self) -> str | None:
        """Return the first wrong shape, such as `colors is [5, 1], not [5, 3]`; else None."""
        if (self.colors is None) == (self.sh_dc is None):
            return "either colors or sh_dc must be given, not both or neither"
        number, rest, degree = len(self), self.sh_rest, self.sh_degree
        degrees = range(1 if rest is None else len(COEFFICIENTS))
        if self.sh_dc is not None and degree not in degrees:
            return f"sh_degree is {degree}, {'without' if rest is None else 'with'} sh_rest"
        higher = 0 if rest is None or rest.ndim == 1 else rest.shape[1]
        shapes: dict[str, tuple[int, ...]] = {
            "means": (number, 3),
            "quats": (number, 4),
            "scales": (number, 3),
            "opacities": (number,),
            "colors": (number, 3),
            "sh_dc": (number, 1, 3),
            "sh_rest": (number, max(higher, (degree + 1) ** 2 - 1), 3),
            "origin": (number,),
            "slot": (number,),
        }
        for name, shape in shapes.items():
            tensor = getattr(self, name)
            if tensor is not None and tuple(tensor.shape) != shape:
                return f"{name} is {list(tensor.shape)}, not {list(shape)}"
        return None

    def whole(self) -> "Gaussians":
        """Return the same Gaussians with all rows up to date, for code without on-demand rows."""
        return self if self.on_demand is None else _Whole(**vars(self))


class _Whole(Gaussians):
    """Gaussians that update all rows of a tensor when the tensor is read.

    Copying or pickling gives a plain `Gaussians` object whose rows are all up to date.
    """

    @override
    def __getattribute__(self, name: str) -> Any:
        stored: dict[str, Any] = super().__getattribute__("__dict__")
        demand: OnDemand = stored["on_demand"]
        match name:
            case "on_demand":
                return None
            case "__class__":
                return Gaussians
            case "__dict__":
                return {field: getattr(self, field) for field in stored}
        if name in demand.fields:
            demand.bring(None)
        return super().__getattribute__(name)

    @override
    def __reduce_ex__(self, protocol: SupportsIndex) -> tuple[type[Gaussians], tuple[Any, ...]]:
        return Gaussians, tuple(vars(self).values())


def _quaternion(rotation: Tensor) -> Tensor:
    """Return the unit quaternion [4] wxyz, float64, of a rotation matrix [3, 3]."""
    # The largest eigenvector of this matrix is the quaternion, also for a rotation by 180 degrees
    # (Bar-Itzhack 2000).
    r = rotation.double()
    matrix = torch.zeros((4, 4), dtype=torch.float64)
    matrix[0, 0] = r.trace()
    matrix[1:, 1:] = r + r.T - r.trace() * torch.eye(3, dtype=torch.float64)
    matrix[0, 1:] = matrix[1:, 0] = torch.stack(
        [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    )
    vectors: Tensor = torch.linalg.eigh(matrix)[1]
    return vectors[:, -1]


def _quaternion_product(first: Tensor, second: Tensor) -> Tensor:
    """Return the quaternions [N, 4] wxyz of a rotation by `second` [N, 4], then by `first` [4]."""
    w, x, y, z = first.tolist()
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return second @ torch.tensor(rows, dtype=torch.float64).T.to(second)


@dataclass
class Screen:
    """Per-Gaussian screen statistics of one render.

    The gradient fields are None before the backward pass of the render.

    Attributes:
        radii: [N] int32, radius on the screen in pixels; 0 if the Gaussian touches no pixel.
        pixels: [N] int32, number of pixels in which the Gaussian was blended; None unless
            requested.
        mean_gradient: [N, 2] gradient of the loss with respect to the projected mean, in pixel
            coordinates.
        abs_gradient: [N, 2] like `mean_gradient`, but with the absolute values summed over the
            pixels; None unless requested.
        directions: [N, 6, 5] gradients of single pixels with respect to the projected mean, in 6
            bins along the longest axis; None unless requested. The axis is the axis of the largest
            scale (the first one of equal scales), projected to the image plane. Let a be the
            projection, without dilation, of one standard deviation along this axis. A pixel whose
            centre has the offset d from the projected mean is at t = d . a / |a|^2, or at t = 0 if
            a is shorter than 1e-6 px. The upper ends of the bins are -2, -1, 0, 1, 2 and infinity.
            Each bin contains 5 numbers about its pixels whose gradient is not 0. The first two
            numbers are the sum of the gradients' directions (x and y). A direction is the unit
            vector of the gradient in NDC units, that is, of the gradient times width and height.
            The next two numbers are the sums of |x| and |y| of the gradients in pixel coordinates.
            The sum of these two numbers over all bins is `abs_gradient`. The last number is the
            number of pixels with a gradient that is not 0.
        count: Function [H, W] bool -> [N] int32: the number of marked pixels in which each Gaussian
            was blended; None unless requested. The data of the render stay in memory as long as
            this function exists.
        rows: [R] int64, sorted; contains every Gaussian with a radius above 0. None if the
            rasterizer provides no such list.
    """

    radii: Tensor
    pixels: Tensor | None = None
    mean_gradient: Tensor | None = None
    abs_gradient: Tensor | None = None
    directions: Tensor | None = None
    count: Callable[[Tensor], Tensor] | None = None
    rows: Tensor | None = None


@dataclass(frozen=True)
class Render:
    """One rendered view.

    Attributes:
        image: [H, W, 3] linear blend over the background, not clamped.
        alpha: [H, W] accumulated opacity, which is 1 - transmittance.
        depth: [H, W] sum of weight times camera depth (not divided by alpha), or None.
        screen: Statistics for density control.
    """

    image: Tensor
    alpha: Tensor
    screen: Screen
    depth: Tensor | None = field(default=None)
