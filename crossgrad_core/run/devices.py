"""The device of a run: the user's choice, or a GPU if a rasterizer works on the GPU."""

import logging

import torch

from crossgrad_core.config import AUTO, ComponentChoice, RunConfig
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build, entries, load
from crossgrad_core.run.rasterizers import demands, fastest_able, speeds_on
from crossgrad_core.wording import in_one_line, sentences

_LOG = logging.getLogger(__name__)


def choose_device(name: str) -> torch.device:
    """Return the torch device of this name.

    Raises:
        UserError: The device does not exist on this machine.
    """
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise UserError(
            f"the device name {name!r} is unknown",
            where="--device",
            expected="auto, cpu, cuda or cuda:N",
            todo="leave --device out to run on a GPU if one can be used, or use --device cpu",
        ) from error
    if device.type not in {"cpu", "cuda"}:
        raise UserError(
            f"device type {device.type!r} is not supported",
            where="--device",
            expected="cpu or cuda",
            todo="use --device cpu",
        )
    if device.type == "cuda":
        _require_cuda(device)
    return device


def _require_cuda(device: torch.device) -> None:
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if (device.index or 0) < count:
        return
    # A torch build for AMD GPUs also uses the name CUDA for these GPUs.
    built_for = torch.version.cuda or torch.version.hip
    if built_for is None:
        found, todo = "a build without CUDA", "install a CUDA build of torch"
    elif count == 0:
        found = f"a build for CUDA {built_for}, but no usable GPU"
        todo = "run nvidia-smi, which shows whether there is a GPU and whether its driver works"
    else:
        found, todo = f"devices cuda:0 to cuda:{count - 1}", "choose one of these devices"
    raise UserError(
        f"torch cannot use the device {str(device)!r}",
        where="--device",
        found=f"torch {torch.__version__}: {found}",
        todo=f"use --device cpu, or {todo}",
    )


def with_device(config: RunConfig) -> tuple[RunConfig, tuple[str, ...]]:
    """Return the configuration with the device that `auto` chooses, and a note on this device.

    There is no note on a machine without a GPU.
    """
    if config.device != AUTO:
        return config, ()
    if not torch.cuda.is_available():
        return config.model_copy(update={"device": "cpu"}), ()
    gpu = torch.cuda.get_device_name()
    name, why = _rasterizer(config)
    why = why or _failure(config, name)
    if why:
        device, note = "cpu", f"device cpu: {gpu} is not used, because {why}"
    else:
        device, note = (
            "cuda",
            f"device cuda: rasterizer {name} works on {gpu} (use --device cpu to avoid the GPU)",
        )
    return config.model_copy(update={"device": device}), (note,)


def _rasterizer(config: RunConfig) -> tuple[str, str]:
    """Return the rasterizer for the GPU, and the reason against the GPU (empty without a reason).

    A rasterizer that the user did not choose must be faster on the GPU than every rasterizer on the
    CPU.
    """
    name = config.rasterizer.name
    if config.seconds is not None and config.clock == "cpu":
        return name, "--clock cpu does not count the time of a GPU"
    if name != AUTO:
        named = load(Rasterizer, name)
        runs = "cuda" in named.devices
        return name, named.missing("cuda") if runs else f"rasterizer {name} does not run on the GPU"
    on_cpu = max(speeds_on("cpu")[0].values(), default=0.0)
    speeds, notes = speeds_on("cuda")
    faster = {rasterizer: speed for rasterizer, speed in speeds.items() if speed > on_cpu}
    able = fastest_able(faster, demands(config, "cuda", *_trained(config)), notes)
    if able is not None:
        return able, ""
    return name, sentences(*notes, *_missing()) or "no installed rasterizer is faster on the GPU"


def _trained(config: RunConfig) -> tuple[Backbone, Densifier]:
    """Return the backbone that the rasterizer renders, and the densifier that needs its outputs."""
    backbone = build(Backbone, config.backbone.name, config.backbone.options)
    choice = config.densifier or ComponentChoice(name=AUTO)
    name = backbone.default_densifier if choice.name == AUTO else choice.name
    return backbone, build(Densifier, name, choice.options)


def _missing() -> list[str]:
    """Return the missing requirements of rasterizers for the GPU, and how to install them."""
    requirements = []
    for name in entries("rasterizers"):
        try:
            requirements.append(load(Rasterizer, name).missing("cuda"))
        except UserError:  # Another note already reports that the package cannot be imported.
            continue
    return requirements


def _failure(config: RunConfig, name: str) -> str:
    """Test the rasterizer on the GPU and return the problem; empty if it works."""
    _LOG.info("testing rasterizer %s on the GPU; the first time, compiling may take minutes", name)
    try:
        build(Rasterizer, name, config.rasterizer.options).self_test("cuda")
    except UserError as error:
        return sentences(error.what, *([] if error.found is None else [error.found]))
    except Exception as error:
        return f"rasterizer {name} failed: {in_one_line(error)}"
    return ""
