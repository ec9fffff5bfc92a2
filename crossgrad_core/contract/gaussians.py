"""Gaussians, which every backbone decodes to, and renders, which every rasterizer returns."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal, SupportsIndex

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core.numerics.raster_constants import COEFFICIENTS

Response = Literal["plain", "antialiased", "analytic"]
_FLOATS = ("means", "quats", "scales", "opacities", "colors", "sh_dc", "sh_rest")


@dataclass(frozen=True)
class OnDemand:
    """Tensors of which only those rows are up to date that were asked for.

    Attributes:
        fields: Which fields of the Gaussians they are.
        bring: [R] int32 rows, each once, or None for all -> brings these up to date, in place.
    """

    fields: frozenset[str]
    bring: Callable[[Tensor | None], None]


@dataclass(frozen=True)
class Gaussians:
    """N coloured 3-D Gaussians in the local frame of the scene.

    Colour is either `colors` (RGB as drawn) or spherical harmonics `sh_dc`, `sh_rest` evaluated at
    `sh_degree`; exactly one of the two is given.

    Attributes:
        means: [N, 3] centres, local units.
        quats: [N, 4] rotations wxyz, not necessarily normalised.
        scales: [N, 3] standard deviations, local units, positive.
        opacities: [N] in [0, 1].
        colors: [N, 3] RGB.
        sh_dc: [N, 1, 3] band 0 coefficients.
        sh_rest: [N, B - 1, 3] higher bands (B = 4, 9 or 16), None at degree 0.
        sh_degree: Active degree, 0 to 3.
        response: How a Gaussian fills a pixel.
        dilation: Added to both diagonal entries of the 2-D covariance, px^2; None takes the
            rasterizer's own.
        origin: [N] int64, the primitive of each Gaussian; None where Gaussian i is primitive i.
        slot: [N] int64, which of its primitive's Gaussians each one is; None where there is one.
        decoded: [P] bool, the primitives that were decoded for this view, whether or not they gave
            a Gaussian; None where all were.
        on_demand: Tensors whose rows must be asked for before they are read; the gradients of these
            are by rows, sparse. None where all is there. Only rasterizers with `sparse_rows`
            get it.
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
        """The floating-point tensors that are given, in the order of the fields."""
        return [t for t in (getattr(self, name) for name in _FLOATS) if t is not None]

    def mapped(self, function: Callable[[Tensor], Tensor]) -> "Gaussians":
        """The same Gaussians with `function` applied to every floating-point tensor."""
        tensors = {name: getattr(self, name) for name in _FLOATS}
        mapped: dict[str, Any] = {n: function(t) for n, t in tensors.items() if t is not None}
        return replace(self, **mapped)

    def detached(self) -> "Gaussians":
        """The same Gaussians without their graph."""
        return self.mapped(torch.Tensor.detach)

    def misfit(self) -> str | None:
        """What is wrong with the shape of a tensor, such as `colors is [5, 1], not [5, 3]`."""
        if (self.colors is None) == (self.sh_dc is None):
            return "both or none of colors and sh_dc are given"
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
        """The same Gaussians for those who know nothing of rows on demand."""
        return self if self.on_demand is None else _Whole(**vars(self))


class _Whole(Gaussians):
    """Gaussians that bring all rows of a tensor up to date when it is read.

    A copy of them, however it is made, is plain Gaussians whose rows are all up to date.
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


@dataclass
class Screen:
    """Per-Gaussian screen statistics of one render.

    The gradient fields are None until the render's backward pass has run.

    Attributes:
        radii: [N] int32, pixels; 0 where the Gaussian touches no pixel.
        pixels: [N] int32, pixels in which the Gaussian was blended; None unless asked for.
        mean_gradient: [N, 2] gradient of the loss by the projected mean, per pixel unit.
        abs_gradient: [N, 2] the same with absolute values summed over pixels; None unless asked.
        directions: [N, 6, 5] the pixels' gradients by the projected mean, in bins along the longest
            axis; None unless asked. The axis is that of the largest scale (the first of equals)
            on the image plane: a pixel whose centre is d from the projected mean is at
            t = d . a / |a|^2, with a the projection of one standard deviation, undilated, and at
            t = 0 where a is shorter than 1e-6 px. Bins end before -2, -1, 0, 1, 2 and never. Of
            the pixels of a bin whose gradient is not 0 there are the sum of the directions (x
            and y; unit vectors of the gradient in NDC units, that is times width and height),
            the sums of |x| and |y| of the gradient itself (per pixel unit; over all bins they
            are `abs_gradient`), and their number.
        count: [H, W] bool -> [N] int32, in how many of these pixels the Gaussian was blended; None
            unless asked for. It keeps alive what it needs of the render.
        rows: [R] int64, sorted, among which is every Gaussian with a radius; None where the
            rasterizer has no such list.
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
        alpha: [H, W] accumulated opacity, 1 - transmittance.
        depth: [H, W] sum of weight times camera depth (not divided by alpha), or None.
        screen: Statistics for density control.
    """

    image: Tensor
    alpha: Tensor
    screen: Screen
    depth: Tensor | None = field(default=None)
