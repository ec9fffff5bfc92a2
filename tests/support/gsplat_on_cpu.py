"""gsplat 1.5 on the CPU: its own `rasterization` over its own plain-torch reference.

Where the reference lacks a part of the CUDA kernels, or needs them, the part is written here as the
kernels' sources have it: the footprint that follows opacity (ProjectionEWA3DGSFused.cu) and the
compositing of a tile (RasterizeToPixels3DGSFwd.cu, RasterizeToPixels3DGSBwd.cu).
"""

from typing import Any, Final

import torch
from torch import Tensor

#: Constants of the kernels of gsplat 1.5.
CAP: Final = 0.999
THRESHOLD: Final = 1.0 / 255.0
STOP: Final = 1e-4
EXTENT: Final = 3.33


def install(monkeypatch: Any) -> None:
    """Puts the parts below in the places of those that need a GPU, for one test."""
    from gsplat import rendering
    from gsplat.cuda import _torch_impl as reference

    monkeypatch.setattr(rendering, "fully_fused_projection", projected)
    monkeypatch.setattr(rendering, "isect_tiles", tiles)
    monkeypatch.setattr(rendering, "isect_offset_encode", reference._isect_offset_encode)
    monkeypatch.setattr(rendering, "rasterize_to_pixels", composited)
    monkeypatch.setattr("gsplat.rasterize_to_indices_in_range", listed)
    monkeypatch.setattr("gsplat.spherical_harmonics", reference._spherical_harmonics)


def projected(means, covars, quats, scales, viewmats, Ks, width, height, **options) -> Any:
    """`fully_fused_projection` with `packed=False`."""
    from gsplat.cuda import _torch_impl as reference

    assert covars is None
    assert options["packed"] is False
    covariances, _ = reference._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    radii, centers, depths, conics, compensations = reference._fully_fused_projection(
        means,
        covariances,
        viewmats,
        Ks,
        width,
        height,
        eps2d=options["eps2d"],
        near_plane=options["near_plane"],
        calc_compensations=options["calc_compensations"],
    )
    peaks = options["opacities"][..., None, :]
    if compensations is not None:
        peaks = peaks * compensations
    return (
        tightened(radii, centers, conics, peaks, (width, height)),
        centers,
        depths,
        conics,
        (compensations),
    )


@torch.no_grad()
def tightened(radii, centers, conics, peaks, size) -> Tensor:
    """The radii [..., 2] with the extent that follows opacity; 0 for what is not drawn."""
    extent = (2 * (peaks / THRESHOLD).clamp(min=1.0).log()).sqrt().clamp(max=EXTENT)
    a, b, c = conics.unbind(-1)
    det = a * c - b * b
    variances = torch.stack([c / det, a / det], -1)
    found = (extent[..., None] * variances.sqrt()).ceil()
    limit = torch.tensor(size, dtype=centers.dtype)
    inside = ((centers + found > 0) & (centers - found < limit)).all(-1)
    drawn = (radii > 0).all(-1) & (peaks >= THRESHOLD) & inside
    return torch.where(drawn[..., None], found, 0.0).int()


def tiles(means2d, radii, depths, tile_size, tile_width, tile_height, **_options) -> Any:
    """`isect_tiles`."""
    from gsplat.cuda import _torch_impl as reference

    return reference._isect_tiles(
        means2d.detach().float(), radii, depths.detach().float(), tile_size, tile_width, tile_height
    )


class _PerPixel(torch.autograd.Function):
    """Centres [G, 2] for each of P pixels; notes the absolute values of what comes back."""

    @staticmethod
    def forward(ctx, centers, pixels, rows, absolute):
        ctx.rows, ctx.absolute = rows, absolute
        return centers.expand(pixels, -1, -1)

    @staticmethod
    def backward(ctx, gradient):
        if ctx.absolute is not None:
            ctx.absolute.view(-1, 2).index_add_(0, ctx.rows, gradient.abs().sum(0))
        return gradient.sum(0), None, None, None


def composited(
    means2d, conics, colors, opacities, width, height, tile_size, offsets, ids, **options
) -> Any:
    """`rasterize_to_pixels`; sets `means2d.absgrad` in the backward pass where asked for."""
    dims, channels = means2d.shape[:-2], colors.shape[-1]
    background = options["backgrounds"].reshape(-1, channels)
    images = background[:, None, None].repeat(1, height, width, 1)
    alphas = torch.zeros_like(images[..., :1])
    absolute = torch.zeros_like(means2d) if options["absgrad"] else None
    if absolute is not None:
        means2d.absgrad = absolute
    flat = [t.reshape(-1, t.shape[-1]) for t in (means2d, conics, colors, opacities[..., None])]
    for image, rows, ys, xs in _lists(offsets, ids, (width, height), tile_size):
        places = _places(ys, xs)
        blend = _tile(places, [t[rows] for t in flat], rows, absolute)
        shape = (ys.stop - ys.start, xs.stop - xs.start, -1)
        color, alpha = blend[:, :-1], blend[:, -1:]
        behind = (1 - alpha) * background[image]
        images = _placed(images, image, ys, xs, (color + behind).view(shape))
        alphas = _placed(alphas, image, ys, xs, alpha.view(shape))
    return images.view(*dims, height, width, channels), alphas.view(*dims, height, width, 1)


def _lists(offsets, ids, size, tile_size) -> Any:
    """Image, rows of Gaussians, and slices of the pixels of every tile that has some."""
    starts = offsets.reshape(-1, *offsets.shape[-2:])
    ends = torch.cat([starts.reshape(-1), torch.tensor([len(ids)])])[1:].view(starts.shape)
    for image, row, column in torch.cartesian_prod(*map(torch.arange, starts.shape)).tolist():
        rows = ids[starts[image, row, column] : ends[image, row, column]].long()
        if len(rows):
            ys = slice(row * tile_size, min((row + 1) * tile_size, size[1]))
            xs = slice(column * tile_size, min((column + 1) * tile_size, size[0]))
            yield image, rows, ys, xs


def _places(ys, xs) -> Tensor:
    """[P, 2] centres of pixels, x and y."""
    pixels = torch.cartesian_prod(torch.arange(ys.start, ys.stop), torch.arange(xs.start, xs.stop))
    return pixels.flip(-1).float() + 0.5


def _alphas(centers, conics, opacities, places) -> Tensor:
    """[P, G] alpha, 0 below the threshold; centres are [P, G, 2]."""
    a, b, c = conics.unbind(-1)
    dx, dy = (centers - places[:, None]).unbind(-1)
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (opacities[:, 0] * (-sigma).exp()).clamp(max=CAP)
    return torch.where((sigma < 0) | (alpha < THRESHOLD), torch.zeros_like(alpha), alpha)


@torch.no_grad()
def listed(
    first, last, light, means2d, conics, opacities, width, height, tile_size, offsets, ids
) -> Any:
    """`rasterize_to_indices_in_range` of all batches (RasterizeToIndices3DGS.cu)."""
    assert first == 0
    assert last > len(ids)
    number, light = means2d.shape[-2], light.reshape(-1, height, width)
    flat = [t.reshape(-1, t.shape[-1]) for t in (means2d, conics, opacities[..., None])]
    found = [torch.zeros(0, dtype=torch.int64)]
    for image, rows, ys, xs in _lists(offsets, ids, (width, height), tile_size):
        centers, own, peaks = (t[rows] for t in flat)
        alpha = _alphas(centers, own, peaks, _places(ys, xs))
        after = light[image, ys, xs].reshape(-1, 1) * (1 - alpha).cumprod(1)
        blended = (alpha > 0) & (after > STOP)
        found.append((rows % number).expand(len(alpha), -1)[blended])
    return torch.cat(found), None, None


def _tile(places, splats, rows, absolute) -> Tensor:
    """[P, channels + 1] colour and alpha of the pixels at `places` [P, 2], over nothing."""
    centers, conics, colors, opacities = splats
    alpha = _alphas(
        _PerPixel.apply(centers, len(places), rows, absolute), conics, opacities, places
    )
    after = (1 - alpha).cumprod(1)
    alpha = torch.where(after > STOP, alpha, torch.zeros_like(alpha))
    after = (1 - alpha).cumprod(1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    return torch.cat([(alpha * before) @ colors, 1 - after[:, -1:]], 1)


def _placed(images, image, ys, xs, part) -> Tensor:
    copy = images.clone()
    copy[image, ys, xs] = part
    return copy
