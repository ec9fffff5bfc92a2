"""Element-wise functions do not depend on the number of threads."""

import pytest
import torch

from crossgrad_core.numerics.elementwise import BLOCK, logsigmoid, sigmoid, sigmoid_
from crossgrad_core.numerics.threads import configure_threads

FUNCTIONS = {
    "sigmoid": (sigmoid, torch.sigmoid),
    "sigmoid_": (lambda values: sigmoid_(values.detach().clone()), torch.sigmoid),
    "logsigmoid": (logsigmoid, torch.nn.functional.logsigmoid),
}


pytestmark = pytest.mark.usefixtures("keeps_threads")


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_bits_do_not_depend_on_the_number_of_threads(name):
    mine, _ = FUNCTIONS[name]
    generator = torch.Generator().manual_seed(0)
    for size in (BLOCK, 50_000, 100_000, 126_003):
        values = 3.0 * torch.randn(size, generator=generator)
        found = []
        for threads in (1, 2):
            configure_threads(threads)
            found.append(mine(values))
        assert torch.equal(*found)


def test_the_bits_of_gradients_do_not_depend_on_the_number_of_threads():
    generator = torch.Generator().manual_seed(0)
    values, upstream = torch.randn(2, 126_003, generator=generator)
    found = []
    for threads in (1, 2):
        configure_threads(threads)
        leaf = values.clone().requires_grad_()
        sigmoid(leaf).backward(upstream)
        found.append(leaf.grad)
    assert torch.equal(*found)


def test_second_order_gradients_pass_through_every_block():
    values = torch.linspace(-5.0, 5.0, BLOCK + 1, dtype=torch.float64).requires_grad_()
    (first,) = torch.autograd.grad(sigmoid(values).sum(), values, create_graph=True)
    (second,) = torch.autograd.grad(first.sum(), values)
    known = torch.sigmoid(values.detach())
    assert torch.allclose(second, known * (1 - known) * (1 - 2 * known), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("shape", [(), (0,), (7, 3), (BLOCK + 1, 3)])
def test_elementwise_functions_agree_with_torch(name, shape):
    mine, theirs = FUNCTIONS[name]
    values = torch.linspace(-90.0, 90.0, max(1, torch.Size(shape).numel()))[
        : torch.Size(shape).numel()
    ].view(shape)
    assert torch.allclose(mine(values), theirs(values), rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("name", ["sigmoid", "logsigmoid"])
def test_gradients_pass_through_every_block(name):
    mine, theirs = FUNCTIONS[name]
    values = torch.linspace(-5.0, 5.0, 3 * BLOCK + 5, dtype=torch.float64)
    gradients = []
    for function in (mine, theirs):
        leaf = values.clone().requires_grad_()
        function(leaf).square().sum().backward()
        gradients.append(leaf.grad)
    assert torch.allclose(*gradients, rtol=1e-12, atol=0.0)
