"""The tensors of a checkpoint under unambiguous names in one safetensors file."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote, unquote

from torch import Tensor

from crossgrad_core.system.files import sync_file
from crossgrad_core.wording import showable

if TYPE_CHECKING:
    from crossgrad_core.run.checkpoint.contents import Checkpoint

_PLUGIN = "plugin"
_SYSTEM_ERROR = re.compile(r"\(os error (\d+)\)")


@dataclass
class Unpacked:
    """The tensors of a checkpoint file, sorted by what they belong to."""

    parameters: dict[str, Tensor] = field(default_factory=dict)
    exp_avg: dict[str, Tensor] = field(default_factory=dict)
    exp_avg_sq: dict[str, Tensor] = field(default_factory=dict)
    plugins: dict[str, dict[str, dict[str, Tensor]]] = field(default_factory=dict)

    def plugin(self, name: str) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """`tensors` and `per_primitive` of a plugin's state."""
        kinds = self.plugins.get(name, {})
        return kinds.get("tensors", {}), kinds.get("per_primitive", {})


def pack(checkpoint: "Checkpoint") -> dict[str, Tensor]:
    """Key -> contiguous CPU tensor that shares its memory with no other."""
    packed: dict[str, Tensor] = {}
    storages: set[int] = set()
    for path, tensor in _all(checkpoint):
        owned = tensor.detach().cpu().contiguous()
        storage = owned.untyped_storage()
        partial = storage.nbytes() != owned.numel() * owned.element_size()
        # safetensors refuses tensors that share memory.
        if partial or storage.data_ptr() in storages:
            owned = owned.clone()
        storages.add(owned.untyped_storage().data_ptr())
        packed["/".join(quote(part, safe="") for part in path)] = owned
    return packed


def packed_bytes(tensors: Mapping[str, Tensor]) -> int:
    """Size of the tensors in bytes."""
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())


def unpack(packed: Mapping[str, Tensor]) -> Unpacked:
    """The inverse of `pack`.

    Raises:
        ValueError: A key is none that `pack` makes.
    """
    tensors = Unpacked()
    for key, tensor in packed.items():
        match [unquote(part) for part in key.split("/")]:
            case ["parameters", name]:
                tensors.parameters[name] = tensor
            case ["exp_avg", name]:
                tensors.exp_avg[name] = tensor
            case ["exp_avg_sq", name]:
                tensors.exp_avg_sq[name] = tensor
            case ["plugin", plugin, ("tensors" | "per_primitive") as kind, name]:
                tensors.plugins.setdefault(plugin, {}).setdefault(kind, {})[name] = tensor
            case _:
                message = f"unknown tensor {key!r}"
                raise ValueError(message)
    return tensors


def write_tensors(path: Path, packed: dict[str, Tensor]) -> None:
    """Writes a safetensors file and waits until it is on the disk.

    Raises:
        OSError: Also where the library wraps what the system said, such as that the disk is full.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    try:
        path.touch()
        mode = path.stat().st_mode
        save_file(packed, path)
        # The library makes a file of its own, which nobody else may read.
        path.chmod(mode)
        sync_file(path)
    except SafetensorError as error:
        number = _SYSTEM_ERROR.search(str(error))
        if number is None:
            raise
        raise OSError(int(number.group(1)), str(error)) from error


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Reads a safetensors file into memory of our own.

    Raises:
        ValueError: It is not a readable safetensors file.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load, load_file

    try:
        if showable(str(path)) != str(path):  # The library opens names in UTF-8 only.
            return load(path.read_bytes())
        # Clones, because the library maps the file, which a later checkpoint may delete.
        return {key: tensor.clone() for key, tensor in load_file(path).items()}
    except SafetensorError as error:
        raise ValueError(str(error)) from error


def _all(checkpoint: "Checkpoint") -> Iterator[tuple[tuple[str, ...], Tensor]]:
    """Every tensor of a checkpoint with the path that names it."""
    for kind in ("parameters", "exp_avg", "exp_avg_sq"):
        tensors: Mapping[str, Tensor] = getattr(checkpoint, kind)
        for name, tensor in tensors.items():
            yield (kind, name), tensor
    for plugin, state in checkpoint.plugins.items():
        for name, tensor in state.tensors.items():
            yield (_PLUGIN, plugin, "tensors", name), tensor
        for name, tensor in state.per_primitive.items():
            yield (_PLUGIN, plugin, "per_primitive", name), tensor
