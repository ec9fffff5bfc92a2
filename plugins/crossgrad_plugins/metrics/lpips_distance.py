"""The LPIPS distance of two images by the features of a network, and the files of its weights."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from crossgrad_core.plugin import UserError
from crossgrad_plugins.metrics.lpips_trunks import Convolution, Trunk

#: Mean and standard deviation of ImageNet's colours, converted to images in [-1, 1] as in LPIPS.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
#: Lower limit that prevents a division by a zero length of a feature vector.
_LEAST = 1e-8
#: Packages with the published LPIPS heads, and the folder of the heads in each package.
_PACKAGES = (
    ("torchmetrics", ("functional", "image", "lpips_models")),
    ("lpips", ("weights", "v0.1")),
)
_SAFETENSORS = ".safetensors"


@dataclass(frozen=True, eq=False)
class Weights:
    """All weights that LPIPS needs with one trunk.

    Attributes:
        trunk: (weights [O, I, H, W], biases [O]) of the trunk's convolutions, in order.
        heads: [1, C, 1, 1] linear heads of the compared convolutions.
        source: A text that names the files, for summary.json.
    """

    trunk: tuple[tuple[Tensor, Tensor], ...]
    heads: tuple[Tensor, ...]
    source: str


def distance(net: Trunk, weights: Weights, first: Tensor, second: Tensor) -> float:
    """Return the LPIPS of two images [H, W, 3], whose values should be in [-1, 1].

    Source: Zhang et al. 2018, The Unreasonable Effectiveness of Deep Features as a Perceptual
    Metric, version 0.1. Features are scaled to unit length. Their squared differences are weighted
    by channel, averaged over the pixels, and summed over the layers.
    """
    with torch.no_grad():
        pairs = zip(_features(net, weights, first), _features(net, weights, second), strict=True)
        total = 0.0
        for (one, other), head in zip(pairs, weights.heads, strict=True):
            difference = (_unit(one) - _unit(other)).square()
            total += float(functional.conv2d(difference, head).mean())
        return total


def _features(net: Trunk, weights: Weights, image: Tensor) -> Iterator[Tensor]:
    """Yield the output [1, C, h, w] of each compared convolution after its ReLU."""
    shift, scale = image.new_tensor(_SHIFT), image.new_tensor(_SCALE)
    x = ((image - shift) / scale).permute(2, 0, 1)[None]
    for layer, (weight, bias) in zip(net.layers, weights.trunk, strict=True):
        if layer.pools:
            x = functional.max_pool2d(x, net.window, 2)
        x = functional.relu(functional.conv2d(x, weight, bias, layer.stride, layer.padding))
        if layer.compared:
            yield x


def _unit(features: Tensor) -> Tensor:
    """Return features whose vector at each pixel is scaled to length 1."""
    return features / (_LEAST + features.square().sum(dim=1, keepdim=True)).sqrt()


def read_weights(net: Trunk, trunk: Path, heads: Path | None, setting: str) -> Weights:
    """Read and check the weights.

    Args:
        net: The network.
        trunk: File with the pretrained weights of the network.
        heads: File with the linear heads; None for the heads of an installed package.
        setting: The user's setting for the weights, such as `metrics.lpips`.

    Raises:
        UserError: A file is missing, contains no weights, or contains the weights of another
            network.
    """
    of_trunk = _read_trunk(net, trunk, f"{setting}.trunk")
    file, whose = (heads, heads.name) if heads is not None else _installed(net, setting)
    of_heads = _read_heads(net, file, f"{setting}.heads")
    return Weights(of_trunk, of_heads, f"{_described(net, trunk)}, linear heads of {whose}")


def _read_trunk(net: Trunk, path: Path, setting: str) -> tuple[tuple[Tensor, Tensor], ...]:
    todo = f"--set {setting}=FILE must name torchvision's {net.model}, such as {net.published}"
    tensors = {name.removeprefix("features."): tensor for name, tensor in _read(path, todo).items()}
    pairs = []
    for layer in net.layers:
        weight, bias = (_name(layer, parameter) for parameter in ("weight", "bias"))
        _check(path, tensors, {weight: layer.shape, bias: layer.shape[:1]}, todo)
        pairs.append((tensors[weight].float(), tensors[bias].float()))
    return tuple(pairs)


def _name(layer: Convolution, parameter: str) -> str:
    return f"{layer.layer}.{parameter}"


def _read_heads(net: Trunk, path: Path, setting: str) -> tuple[Tensor, ...]:
    todo = (
        f"--set {setting}=FILE must name the linear heads of LPIPS 0.1 for {net.name}, {net.heads}"
    )
    tensors = _read(path, todo)
    shapes: dict[str, tuple[int, ...]] = {
        f"lin{number}.model.1.weight": (1, layer.shape[0], 1, 1)
        for number, layer in enumerate(net.compared)
    }
    _check(path, tensors, shapes, todo)
    return tuple(tensors[name].float() for name in shapes)


def _installed(net: Trunk, setting: str) -> tuple[Path, str]:
    """Return the heads in an installed package and the package's name, without an import."""
    for package, folders in _PACKAGES:
        spec = find_spec(package)
        for location in (spec.submodule_search_locations or ()) if spec is not None else ():
            file = Path(location, *folders, net.heads)
            if file.is_file():
                return file, package
    raise UserError(
        f"no file with the linear heads of LPIPS for {net.name} is installed",
        where=setting,
        expected="a package that contains the heads "
        f"({', '.join((name for name, _ in _PACKAGES))})",
        todo=f"pip install torchmetrics, or name the file: --set {setting}.heads={net.heads}",
    )


def _read(path: Path, todo: str) -> Mapping[str, Tensor]:
    """Return the tensors of a file by name; code in the file is not executed."""
    if not path.is_file():
        raise UserError("the file of weights does not exist", where=path, todo=todo)
    try:
        if path.suffix == _SAFETENSORS:
            from safetensors.torch import load_file

            return load_file(path)
        # Load to the CPU, so that files written on a GPU can be read without a GPU.
        content = torch.load(path, map_location="cpu", weights_only=True)
    # torch does not document which exceptions it raises for damaged files.
    except Exception as error:
        # Do not show torch's own message, because it advises users to execute code from the file.
        raise _unreadable(path, f"{type(error).__name__} while reading", todo) from error
    if not isinstance(content, Mapping):
        raise _unreadable(path, f"an object of type {type(content).__name__}", todo)
    return {name: tensor for name, tensor in content.items() if isinstance(tensor, Tensor)}


def _unreadable(path: Path, found: str, todo: str) -> UserError:
    return UserError(
        "the file of weights cannot be read",
        where=path,
        expected="tensors by name, as .pth (a state dict) or .safetensors",
        found=found,
        todo=todo,
    )


def _check(
    path: Path, tensors: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]], todo: str
) -> None:
    """Raise an error if the weights belong to another network or are not finite."""
    for name, shape in shapes.items():
        tensor = tensors.get(name)
        if tensor is None or tuple(tensor.shape) != shape:
            problem = (
                "no tensor with that name" if tensor is None else f"shape {list(tensor.shape)}"
            )
        elif not bool(torch.isfinite(tensor).all()):
            problem = "numbers that are not finite"
        else:
            continue
        raise UserError(
            "the file contains the weights of another network",
            where=f"{path}: {name}",
            expected=f"shape {list(shape)}",
            found=problem,
            todo=todo,
        )


def _described(net: Trunk, path: Path) -> str:
    """Return a text that identifies a file by its name and content.

    Results with different weight files cannot be compared.
    """
    digest = sha256(path.read_bytes()).hexdigest()
    published = "" if digest.startswith(net.digest) else "not "
    return f"{path.name} (SHA-256 {digest[:16]}, {published}the file that torchvision publishes)"
