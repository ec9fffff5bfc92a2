"""Decoded Gaussians and their gradients do not depend on the number of threads."""

import numpy as np
import pytest
import torch

from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.testing.fixtures import sample_camera, sample_phase

FIELDS = ("means", "quats", "scales", "opacities", "colors", "sh_dc", "sh_rest")


pytestmark = pytest.mark.usefixtures("keeps_threads")


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("name", "options"),
    [*((name, {}) for name in entries("backbones")), ("scaffold", {"feature_bank": True})],
)
def test_decoding_gives_the_same_bits_on_any_number_of_threads(name, options, large_scene):
    backbone, _ = build("backbones", name, options).fitted_to(large_scene)
    trained = sorted(t for block in backbone.trained_blocks() for t in block.tensors)
    parameters = backbone.create(large_scene, np.random.default_rng(1))
    generator = torch.Generator().manual_seed(0)
    if "extra_levels" in parameters:
        parameters["extra_levels"] = torch.rand(len(parameters["levels"]), generator=generator)
    for tensor in trained:
        values = parameters[tensor].detach()
        noise = 0.3 * torch.randn(values.shape, generator=generator)
        parameters[tensor] = (values + noise).requires_grad_()
    found = []
    for threads in (1, 2):
        configure_threads(threads)
        ready = backbone.prepare(parameters, large_scene, sample_phase())
        gaussians = backbone.decode(ready, sample_camera(), sample_phase())
        decoded = [getattr(gaussians, field) for field in FIELDS]
        decoded = [tensor for tensor in decoded if tensor is not None]
        assert max(tensor.shape[0] for tensor in decoded) > 2**15
        differentiable = [tensor for tensor in decoded if tensor.requires_grad]
        weights = [torch.linspace(-1.0, 1.0, t.numel()).view_as(t) for t in differentiable]
        gradients = torch.autograd.grad(
            differentiable, [ready[tensor] for tensor in trained], weights, allow_unused=True
        )
        found.append([*decoded, *(gradient for gradient in gradients if gradient is not None)])
    one, two = found
    assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True))
