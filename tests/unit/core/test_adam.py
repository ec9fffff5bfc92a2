"""Adam's fused kernel, its torch reference and torch.optim.Adam against one another."""

from dataclasses import replace

import numba
import pytest
import torch

from crossgrad_core.contract.blocks import AdamRule, AdamState
from crossgrad_core.training.adam.adam import (
    adam_step,
    update_on_gpu,
    update_reference,
    update_tensors,
)
from crossgrad_core.training.adam.coefficients import LARGEST, Coefficients

SHAPES = {"means": (50, 3), "f_rest": (50, 15, 3), "opacities": (50,), "empty": (0, 3)}
RATES = {"means": 1e-2, "f_rest": 1e-3, "opacities": 5e-2, "empty": 1.0}


def tensors(seed, scale=1.0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    return {
        name: (scale * torch.randn(shape, generator=generator)).to(dtype)
        for name, shape in SHAPES.items()
    }


def coefficients(step=3, lr=1e-2, eps=1e-15):
    return Coefficients(beta1=0.9, beta2=0.999, lr=lr, age=step, eps=eps)


@pytest.mark.parametrize("scale", [1.0, 1e-7, 1e-12, 1e12])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_fused_kernel_agrees_with_torch(dtype, scale):
    params, state = tensors(0, dtype=dtype), AdamState()
    theirs = {name: tensor.clone().requires_grad_() for name, tensor in params.items()}
    groups = [{"params": [theirs[name]], "lr": RATES[name]} for name in theirs]
    oracle = torch.optim.Adam(groups, eps=1e-15)
    for step in range(30):
        grads = tensors(step + 1, scale, dtype)
        if step % 3 == 2:
            grads["f_rest"] = None
        for name, grad in grads.items():
            theirs[name].grad = grad
        oracle.step()
        adam_step(params, grads, state, RATES)
    for name, param in params.items():
        torch.testing.assert_close(param, theirs[name].detach(), rtol=1e-5, atol=1e-6)
    assert state.steps == {"means": 30, "f_rest": 20, "opacities": 30, "empty": 30}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1e-26, 1e-18, 1e-15, 1.0, 1e18])
def test_gradients_are_scaled_before_every_other_operation(size, dtype):
    one, other = AdamState(), AdamState()
    params = {name: torch.zeros(300, dtype=dtype) for name in "xy"}
    scaled = {name: tensor.clone() for name, tensor in params.items()}
    for step in range(5):
        generator = torch.Generator().manual_seed(step)
        grads = {n: size * torch.randn(300, generator=generator).to(dtype) for n in params}
        adam_step(params, grads, one, {"x": 1e-2, "y": 1e-2})
        small = {"x": grads["x"] / 4, "y": grads["y"]}
        adam_step(scaled, small, other, {"x": 1e-2, "y": 1e-2}, scales={"x": 4.0, "y": 1.0})
    assert params["x"].any()
    for of, same in ((params, scaled), (one.exp_avg, other.exp_avg)):
        assert all(torch.equal(of[name], same[name]) for name in params)


@pytest.mark.parametrize("magnitude", [1e-45, 1e-32, 1e-22, 1e-19, 3e-18, 1e-10, 1.0, 1e15, 1e30])
def test_the_kernel_agrees_with_the_reference_at_every_magnitude(magnitude):
    generator = torch.Generator().manual_seed(4)
    size = 70_003  # more than one chunk, and a remainder
    grad = magnitude * torch.randn(size, generator=generator)
    param = torch.randn(size, generator=generator)
    past = grad.clamp(-LARGEST, LARGEST)
    ours = [param.clone(), 0.3 * past, (0.5 * past).square()]
    theirs = [tensor.clone() for tensor in ours]
    for step in range(1, 4):
        update_tensors([(ours[0], grad, ours[1], ours[2], coefficients(step))])
        update_reference(theirs[0], grad, theirs[1], theirs[2], coefficients(step))
    for mine, reference, tolerance in zip(ours, theirs, (1e-8, 0, 0), strict=True):
        assert torch.isfinite(mine).all()
        torch.testing.assert_close(mine, reference, rtol=2e-6, atol=tolerance)


@pytest.mark.parametrize("magnitude", [1e-12, 1e-6, 1.0, 1e15, 1e30])
@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_the_gpu_update_agrees_with_the_reference(magnitude, scale):
    """Use the fused Adam of PyTorch, which also runs on the CPU. Step counts may be fractions."""
    generator = torch.Generator().manual_seed(4)
    param = torch.randn(3000, generator=generator)
    ours = [param.clone(), torch.zeros(3000), torch.zeros(3000)]
    theirs = [tensor.clone() for tensor in ours]
    for step in range(1, 5):
        grad = magnitude * torch.randn(3000, generator=generator)
        numbers = replace(coefficients(0.75 * step), scale=scale)
        update_on_gpu(ours[0], grad, ours[1], ours[2], numbers)
        update_reference(theirs[0], grad, theirs[1], theirs[2], numbers)
    for mine, reference in zip(ours, theirs, strict=True):
        assert torch.isfinite(mine).all()
        rounding = 1e-6 * float(reference.abs().max())
        torch.testing.assert_close(mine, reference, rtol=1e-5, atol=rounding)


@pytest.mark.parametrize("bad", [torch.inf, -torch.inf, torch.nan])
def test_a_non_finite_gradient_makes_gpu_parameters_non_finite(bad):
    """A GPU step checks no gradient, so the parameters must show a non-finite gradient."""
    tensors = [torch.ones(3), torch.zeros(3), torch.zeros(3)]
    update_on_gpu(tensors[0], torch.tensor([1.0, bad, 1.0]), *tensors[1:], coefficients(1.0))
    assert tensors[0].isfinite().tolist() == [True, False, True]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_memory_of_moments_marked_as_zero_is_not_read(dtype):
    """All gradients in the second half of the tensor are zero."""
    grad = torch.cat([tensors(6)["means"].flatten(), torch.zeros(70_000)]).to(dtype)
    found = []
    for first, names in ((0.0, ()), (torch.nan, {"x"})):
        params, state = {"x": torch.full_like(grad, first)}, AdamState()
        for _ in range(2):
            params["x"].fill_(first)
            adam_step(params, {"x": grad}, state, {"x": 0.1}, from_zero=names)
        found.append(params["x"])
    assert found[0].any()
    assert torch.equal(*found)


def test_a_step_without_gradients_changes_nothing():
    params, state = tensors(5), AdamState()
    adam_step(params, tensors(6), state, RATES)
    before = {name: tensor.clone() for name, tensor in params.items()}
    moments = {name: tensor.clone() for name, tensor in state.exp_avg.items()}
    adam_step(params, {"means": None}, state, RATES)
    assert set(state.steps.values()) == {1}
    for name, param in params.items():
        assert torch.equal(param, before[name])
        assert torch.equal(state.exp_avg[name], moments[name])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_zero_gradient_with_zero_moments_changes_no_parameter(dtype):
    params, state = tensors(7, dtype=dtype), AdamState()
    before = {name: tensor.clone() for name, tensor in params.items()}
    for _ in range(3):
        grads = {name: torch.zeros_like(tensor) for name, tensor in params.items()}
        adam_step(params, grads, state, RATES)
    for name, param in params.items():
        assert torch.equal(param, before[name])


@pytest.mark.parametrize("size", [1e-45, 1e-38, 1e-30, 1e-25, 1e-23, 1e-20, 1e-17, 1e-15, 1e-10])
def test_a_small_gradient_never_moves_further_than_a_large_one(size):
    params, state = {"x": torch.zeros(8)}, AdamState()
    adam_step(params, {"x": torch.full((8,), size)}, state, {"x": 1e-2})
    assert torch.isfinite(params["x"]).all()
    assert params["x"].abs().max() <= 1.0001e-2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_moments_of_an_unseen_primitive_decay_to_zero_without_subnormals(dtype):
    params, state = {"x": torch.ones(100, dtype=dtype)}, AdamState()
    adam_step(params, {"x": torch.full((100,), 1e-16, dtype=dtype)}, state, {"x": 1e-3})
    for _ in range(400):
        adam_step(params, {"x": torch.zeros(100, dtype=dtype)}, state, {"x": 1e-3})
    assert not state.exp_avg["x"].any()
    normal = (state.exp_avg_sq["x"] == 0) | (state.exp_avg_sq["x"] >= 2.0**-126)
    assert normal.all()


def test_an_infinite_gradient_does_not_stop_its_parameter_permanently():
    params, state = {"x": torch.zeros(1)}, AdamState()
    adam_step(params, {"x": torch.tensor([torch.inf])}, state, {"x": 1e-2})
    assert params["x"].item() == pytest.approx(-1e-2)
    assert state.exp_avg_sq["x"].item() == pytest.approx(1e-3 * LARGEST**2, rel=1e-5)


def test_a_nan_gradient_changes_only_its_own_element():
    params, state = {"x": torch.zeros(3)}, AdamState()
    adam_step(params, {"x": torch.tensor([1.0, torch.nan, 1.0])}, state, {"x": 1e-2})
    assert torch.isnan(params["x"]).tolist() == [False, True, False]


def test_bits_do_not_depend_on_the_number_of_threads():
    before = numba.get_num_threads()
    results = []
    try:
        for threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):
            numba.set_num_threads(threads)
            params = {"x": torch.linspace(-1, 1, 200_001)}
            state = AdamState()
            for k in range(3):
                adam_step(params, {"x": torch.cos(k + params["x"])}, state, {"x": 1e-2})
            results.append(params["x"])
    finally:
        numba.set_num_threads(before)
    assert all(torch.equal(result, results[0]) for result in results)


def test_strided_and_contiguous_tensors_get_the_same_update():
    strided = torch.randn(3, 40, generator=torch.Generator().manual_seed(8)).T
    dense = strided.clone(memory_format=torch.contiguous_format).requires_grad_()
    grad = torch.ones(3, 40).T
    for param in (strided, dense):
        adam_step({"x": param}, {"x": grad}, AdamState(), {"x": 1e-2})
    torch.testing.assert_close(strided, dense.detach())


def test_a_graph_that_saved_old_values_raises_after_the_step():
    param = torch.ones(3, requires_grad=True)
    loss = (param * param).sum()
    adam_step({"x": param}, {"x": torch.ones(3)}, AdamState(), {"x": 1e-2})
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


@pytest.mark.parametrize(
    ("grad", "options"),
    [
        (torch.ones(4), {}),
        (torch.ones(3).double(), {}),
        (torch.ones(3), {"rule": AdamRule(betas=(0.9, 1.0))}),
    ],
)
def test_invalid_arguments_are_refused(grad, options):
    with pytest.raises(ValueError, match="must"):
        adam_step({"x": torch.ones(3)}, {"x": grad}, AdamState(), {"x": 1e-2}, **options)


@pytest.mark.parametrize("last", ["grad", "exp_avg", "exp_avg_sq"])
def test_only_elements_with_nonzero_gradient_or_moments_change(last):
    """Test every position of the first and last nonzero number. Runs of zeros are skipped."""
    size = 3 * 2**13 + 5
    rule = coefficients()
    for at in (0, 63, 64, 2**13 - 1, 2**13, 2 * 2**13 + 64, size - 1):
        longer = torch.zeros(
            2**16 + size
        )  # More than one chunk, so that several threads take part.
        tensors = {name: longer.clone() for name in ("grad", "exp_avg", "exp_avg_sq")}
        tensors[last][2**16 + at] = 0.25
        param = torch.linspace(-2.0, 2.0, len(longer))
        ours, theirs = ([param.clone(), *(t.clone() for t in tensors.values())] for _ in range(2))
        update_tensors([(ours[0], ours[1], ours[2], ours[3], rule)])
        update_reference(theirs[0], theirs[1], theirs[2], theirs[3], rule)
        for mine, other in zip(ours, theirs, strict=True):
            torch.testing.assert_close(mine, other, rtol=1e-6, atol=0.0)
            still = torch.ones(len(longer), dtype=torch.bool)
            still[2**16 + at] = False
            assert torch.equal(mine[still], other[still])
        assert (ours[3] != 0).any() or last == "exp_avg"


def test_tensors_of_any_size_in_one_call_get_the_same_update_as_alone():
    rng = torch.Generator().manual_seed(6)
    sizes = {"small": 7, "one": 2**16, "empty": 0, "more": 2**16 + 1, "many": 3 * 2**16 + 5}
    together = {name: torch.randn(size, generator=rng) for name, size in sizes.items()}
    together["exact"] = torch.randn(9, generator=rng, dtype=torch.float64)
    together["turned"] = torch.randn(4, 5, generator=rng).T
    apart = {name: tensor.clone() for name, tensor in together.items()}
    rates = {name: 1e-3 * (place + 1) for place, name in enumerate(together)}
    state, own = AdamState(), {name: AdamState() for name in together}
    for _ in range(3):
        grads = {
            name: torch.randn(t.shape, generator=rng, dtype=t.dtype) for name, t in together.items()
        }
        adam_step(together, grads, state, rates)
        for name, tensor in apart.items():
            adam_step({name: tensor}, {name: grads[name]}, own[name], rates)
    for name, tensor in apart.items():
        assert torch.equal(together[name], tensor), name
        assert torch.equal(state.exp_avg_sq[name], own[name].exp_avg_sq[name]), name


def test_a_missing_learning_rate_leaves_all_tensors_unchanged():
    params, state = {"x": torch.ones(3), "y": torch.ones(3)}, AdamState()
    with pytest.raises(KeyError):
        adam_step(params, {"x": torch.ones(3), "y": torch.ones(3)}, state, {"x": 1e-2})
    assert torch.equal(params["x"], torch.ones(3)) and not state.steps.get("x")


def test_a_nan_gradient_is_not_skipped():
    grad = torch.zeros(2**17)
    grad[100_000] = torch.nan
    tensors = [torch.ones(2**17), torch.zeros(2**17), torch.zeros(2**17)]
    update_tensors([(tensors[0], grad, tensors[1], tensors[2], coefficients())])
    assert [int(t.isnan().sum()) for t in tensors] == [1, 1, 1]
