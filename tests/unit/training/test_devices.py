"""Errors for missing devices distinguish the possible causes."""

import pytest
import torch

from crossgrad_core.errors import UserError
from crossgrad_core.run.devices import choose_device


@pytest.fixture
def build(monkeypatch):
    """A build of torch that sees so many GPUs."""

    def of(cuda, devices, hip=None):
        monkeypatch.setattr(torch.version, "cuda", cuda)
        monkeypatch.setattr(torch.version, "hip", hip)
        monkeypatch.setattr(torch.cuda, "is_available", lambda: devices > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: devices)

    return of


@pytest.mark.parametrize(
    ("cuda", "devices", "name", "found", "todo"),
    [
        (None, 0, "cuda", "a build without CUDA", "install a CUDA build of torch"),
        ("12.4", 0, "cuda", "a build for CUDA 12.4, but no usable GPU", "nvidia-smi"),
        ("12.4", 0, "cuda:1", "a build for CUDA 12.4, but no usable GPU", "nvidia-smi"),
        ("12.4", 2, "cuda:2", "devices cuda:0 to cuda:1", "choose one of these devices"),
    ],
)
def test_a_missing_device_is_reported_with_a_remedy(build, cuda, devices, name, found, todo):
    build(cuda, devices)
    with pytest.raises(UserError) as raised:
        choose_device(name)
    assert repr(name) in raised.value.what
    assert found in raised.value.found
    assert todo in raised.value.todo and "use --device cpu" in raised.value.todo
    assert ("install" in raised.value.todo) == (cuda is None)


@pytest.mark.parametrize("name", ["cuda", "cuda:0", "cuda:1"])
def test_available_devices_are_accepted(build, name):
    build("12.4", 2)
    assert choose_device(name) == torch.device(name)


@pytest.mark.parametrize("name", ["gpu", "mps", "cuda:x", "cpu:x"])
def test_unknown_device_names_are_refused_with_a_remedy(name):
    with pytest.raises(UserError) as raised:
        choose_device(name)
    assert "--device" in raised.value.where and raised.value.todo
