"""A device of its own, in the machine's memory, that notes whenever the host would wait for it.

A tensor there is no CPU tensor: code that asks takes the way of a GPU. The host waits for one when
a value is read back from it, and when a tensor is copied there in the ordinary way: the copy comes
after all that the GPU still has to do.
"""

from typing import Any, Final

import torch
from torch.overrides import TorchFunctionMode
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

NAME: Final = "counted"
#: Operations whose result, or its shape, depends on values.
READING: Final = frozenset(
    {"_local_scalar_dense", "nonzero", "masked_select", "equal", "_unique2", "unique_consecutive"}
)
#: A copy to the device that is not `non_blocking`.
BLOCKING: Final = "a copy that waits"
#: How torch makes a backend of Python code; not every version has it.
REGISTER: Final = getattr(backend_registration, "_setup_privateuseone_for_python_backend", None)


def device() -> torch.device:
    """The device; registered when it is first asked for."""
    if torch._C._get_privateuse1_backend_name() != NAME:
        assert REGISTER is not None
        REGISTER(NAME)
    return torch.device(NAME, 0)


class Tensor(torch.Tensor):
    """A tensor on the device; `raw` is its content."""

    @staticmethod
    def __new__(cls, raw):
        return torch.Tensor._make_wrapper_subclass(
            cls,
            raw.size(),
            strides=raw.stride(),
            storage_offset=raw.storage_offset(),
            dtype=raw.dtype,
            device=device(),
        )

    def __init__(self, raw):
        self.raw = raw

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {}, [])


class _Values(TorchFunctionMode):
    """What turns Python's values to tensors and back, which no dispatch sees."""

    def __init__(self, reads):
        super().__init__()
        self.reads = reads

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        if func is torch.tensor:
            place = kwargs.pop("device", None)
            made = func(*args, **kwargs)
            return made if place is None else made.to(place)
        if func is torch.Tensor.new_tensor:
            like, values = args
            return torch.tensor(values, **{"dtype": like.dtype, **kwargs}).to(like.device)
        if func is torch.Tensor.tolist and isinstance(args[0], Tensor):
            self.reads.append("tolist")
            return args[0].raw.tolist()
        return func(*args, **kwargs)


class Reads(TorchDispatchMode):
    """Lets tensors be made on the device, and lists the operations that read values back."""

    def __init__(self):
        super().__init__()
        self.found: list[str] = []
        self._values = _Values(self.found)

    def __enter__(self):
        self._values.__enter__()
        return super().__enter__()

    def __exit__(self, *error):
        super().__exit__(*error)
        self._values.__exit__(*error)

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {}, self.found)


def _run(func: Any, args: Any, kwargs: dict[str, Any], reads: list[str]) -> Any:
    name = func.overloadpacket.__name__
    wanted = kwargs.get("device")
    of_device = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
    leaves = wanted is not None and torch.device(wanted).type == "cpu"
    by_mask = name.startswith("index") and any(
        isinstance(each, Tensor) and each.dtype in {torch.bool, torch.uint8}
        for each in tree_leaves(args[1] if name == "index" else args[1:2])
    )
    if of_device and (name in READING or by_mask or leaves):
        reads.append(f"{name} to the CPU" if leaves else name)
    elif _enters(name, args, kwargs, of_device=bool(of_device)):
        reads.append(BLOCKING)
    result = func(*tree_map(_raw, args), **tree_map(_raw, kwargs))
    if leaves or not (of_device or (wanted is not None and torch.device(wanted).type == NAME)):
        return result
    return tree_map(lambda each: Tensor(each) if isinstance(each, torch.Tensor) else each, result)


def _enters(name: str, args: Any, kwargs: dict[str, Any], *, of_device: bool) -> bool:
    """Whether values of the machine's memory are copied to the device, and waited for."""
    here = [t for t in tree_leaves(args) if isinstance(t, torch.Tensor) and type(t) is not Tensor]
    if name == "_to_copy":
        wanted = kwargs.get("device")
        there = wanted is not None and torch.device(wanted).type == NAME and not of_device
        return there and not kwargs.get("non_blocking")
    if name == "copy_":
        waits = not (kwargs.get("non_blocking") or (len(args) > 2 and args[2]))
        return of_device and bool(here) and waits
    return of_device and name.startswith("index") and bool(here)


def _raw(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.raw
    return torch.device("cpu") if isinstance(value, torch.device) else value
