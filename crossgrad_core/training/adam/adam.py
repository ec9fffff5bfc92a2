"""Adam on named tensors, in place, without building an optimizer object."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from math import nan
from typing import TypeAlias

import torch
from torch import Tensor
from torch.optim.adam import adam

from crossgrad_core.contract.blocks import AdamRule, AdamState
from crossgrad_core.training.adam.coefficients import (
    LARGEST,
    SMALLEST_NORMAL,
    TINY,
    Coefficients,
)

#: Elements: the parameter, its gradient, its first and second moments, and the coefficients of the
#: step.
Update: TypeAlias = tuple[Tensor, Tensor, Tensor, Tensor, Coefficients]


@torch.no_grad()
def adam_step(  # noqa: PLR0913 - all options of an optimizer step are arguments
    params: Mapping[str, Tensor],
    grads: Mapping[str, Tensor | None],
    state: AdamState,
    lrs: Mapping[str, float],
    rule: AdamRule = AdamRule(),  # noqa: B008 - the default is a frozen object
    scales: Mapping[str, float] | None = None,
    *,
    from_zero: Collection[str] = (),
) -> None:
    """Take one Adam step on every tensor that has a gradient; `params` and `state` change in place.

    A tensor without a gradient (None or absent) keeps its value, moments and step count. The
    constants in `coefficients` limit gradients that are too small or too large for float32
    arithmetic. For gradients of magnitude 1e-17 to 1e18, the result equals `torch.optim.Adam` up to
    rounding. As in torch, a NaN element of a gradient makes the corresponding element of the
    parameter NaN.

    Args:
        params: Floating-point tensors of any shape, by name.
        grads: Gradients with the shapes and types of `params`, by name.
        state: Moments and step counts; missing entries start at zero.
        lrs: Learning rate of every tensor that has a gradient.
        rule: Decay rates of the moments, and eps.
        scales: Factor for the gradient of each tensor, by name; not 0. None means a factor of 1 for
            all tensors.
        from_zero: Names of uninitialised tensors that have a gradient. The values of these tensors
            are set to zero before the step.

    Raises:
        ValueError: If an argument is out of range or a gradient does not have the shape and type of
            its tensor.

    Source: Kingma and Ba 2015, algorithm 1.
    """
    _check(params, grads, rule.betas)
    given = {name: grad for name in params if (grad := grads.get(name)) is not None}
    # A missing learning rate must raise its error before any step is counted.
    numbers = {name: (lrs[name], 1.0 if scales is None else scales[name]) for name in given}
    updates = []
    for name, grad in given.items():
        (lr, scale), param = numbers[name], params[name]
        step = counted(name, param, state, lr, rule, scale)
        step = replace(step, from_zero=True) if name in from_zero else step
        updates.append((param, grad, state.exp_avg[name], state.exp_avg_sq[name], step))
    update_tensors(updates)


def counted(
    name: str, param: Tensor, state: AdamState, lr: float, rule: AdamRule, scale: float
) -> Coefficients:
    """Increase the step count of a tensor and return the coefficients of the step.

    Args:
        name: Name of the tensor.
        param: The tensor.
        state: Moments and step counts; the entries of the tensor change.
        lr: Learning rate.
        rule: The Adam rule, as in `adam_step`.
        scale: Factor for the gradient.
    """
    if name not in state.steps:
        state.exp_avg[name] = torch.zeros_like(param, memory_format=torch.contiguous_format)
        state.exp_avg_sq[name] = torch.zeros_like(state.exp_avg[name])
        state.steps[name] = 0
    state.steps[name] += 1
    return replace(_coefficients(state.steps[name], lr, rule), scale=scale)


def update_tensors(updates: Iterable[Update]) -> None:
    """Apply one step to each tensor with a fused kernel (float32 on the CPU), else with torch."""
    fused = []
    for update in updates:
        param, grad, exp_avg, exp_avg_sq, step = update
        tensors = (param, exp_avg, exp_avg_sq)
        on_cpu = all(t.device.type == "cpu" and t.dtype == torch.float32 for t in (*tensors, grad))
        if on_cpu and all(t.is_contiguous() for t in tensors):
            fused.append(update)
            continue
        if step.from_zero:
            param.zero_()
        if param.is_cuda:
            update_on_gpu(*update)
        else:
            update_reference(*update)
    if fused:
        _update_fused(fused)


def _update_fused(updates: Sequence[Update]) -> None:
    from crossgrad_core.training.adam.numba_kernels.fused import update_at

    # The kernel receives only addresses. Keep references until the step is done. Without these
    # references, the contiguous copies of gradients would be freed too early.
    laid_out = [(p, g.contiguous(), m, v) for p, g, m, v, _ in updates]
    addresses = [[tensor.data_ptr() for tensor in four] for four in laid_out]
    sizes = [param.numel() for param, *_ in laid_out]
    update_at(addresses, sizes, [step for *_, step in updates])
    # NumPy wrote without autograd, so invalidate graphs that use the old values.
    for param, _, exp_avg, exp_avg_sq, _ in updates:
        # Older versions of torch accept only one tensor in each call.
        for tensor in (param, exp_avg, exp_avg_sq):
            torch.autograd.graph.increment_version(tensor)


def update_on_gpu(
    param: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, step: Coefficients
) -> None:
    """Apply one step with torch's fused Adam.

    In contrast to the CPU kernel, torch's Adam keeps subnormal numbers.

    On a GPU, a step does not check for infinite gradients. An infinite gradient makes the parameter
    NaN, and the check of the parameters reports this NaN.
    """
    grad = grad if step.scale == 1.0 else grad * step.scale
    grad = grad.nan_to_num(nan, nan, nan).clamp(-LARGEST, LARGEST)
    adam(
        [param],
        [grad],
        [exp_avg],
        [exp_avg_sq],
        [],
        # torch's Adam first adds 1 to the step count.
        [torch.full((), step.age - 1, dtype=torch.float32, device=param.device)],
        fused=True,
        amsgrad=False,
        beta1=step.beta1,
        beta2=step.beta2,
        lr=step.lr,
        weight_decay=0.0,
        eps=step.eps,
        maximize=False,
    )


def update_reference(
    param: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, step: Coefficients
) -> None:
    """Apply one step with plain torch operations, for any device and floating-point type."""
    grad = grad if step.scale == 1.0 else grad * step.scale
    grad = _without(grad.clamp(-LARGEST, LARGEST), TINY)
    exp_avg.mul_(step.beta1).add_(grad, alpha=1 - step.beta1)
    exp_avg.copy_(_without(exp_avg, TINY))
    grad = _without(grad, step.square_floor)
    exp_avg_sq.mul_(step.beta2).addcmul_(grad, grad, value=1 - step.beta2)
    exp_avg_sq.copy_(_without(exp_avg_sq, SMALLEST_NORMAL))
    root = exp_avg_sq.sqrt().mul_(step.root_scale).add_(step.eps)
    param.addcdiv_(exp_avg, root, value=-step.step_size)


def _without(values: Tensor, floor: float) -> Tensor:
    """Return the values, but 0 if the absolute value is below `floor`; NaN stays NaN."""
    return torch.where(values.abs() < floor, torch.zeros_like(values), values)


def _coefficients(count: int, lr: float, rule: AdamRule) -> Coefficients:
    (beta1, beta2), age = rule.betas, count * rule.age
    return Coefficients(
        beta1=beta1,
        beta2=beta2,
        lr=lr,
        age=age,
        eps=rule.eps,
    )


def _check(
    params: Mapping[str, Tensor],
    grads: Mapping[str, Tensor | None],
    betas: tuple[float, float],
) -> None:
    if not all(0 <= beta < 1 for beta in betas):
        raise ValueError(f"`betas` must lie in [0, 1); found {betas}")
    for name, param in params.items():
        grad = grads.get(name)
        if grad is not None and (grad.shape != param.shape or grad.dtype != param.dtype):
            mismatch = f"{list(grad.shape)} {grad.dtype} for {list(param.shape)} {param.dtype}"
            raise ValueError(
                f"the gradient of `{name}` must have the shape and type of the tensor; {mismatch}"
            )
