"""Contract checks for backbones: blocks, decoding, gradients, checkpoints, density control."""

from collections.abc import Mapping

import numpy as np
import torch
from safetensors.torch import load, save
from torch import Tensor

from crossgrad_core.contract.blocks import Edit, Parameters, apply_to_parameters, primitives_of
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.defaults import REFERENCE_RASTERIZER
from crossgrad_core.numerics.raster_constants import COEFFICIENTS
from crossgrad_core.registry import entries as registry
from crossgrad_core.registry.entries import build
from crossgrad_core.testing.fixtures import sample_camera, sample_phase, sample_scene
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import (
    Check,
    Make,
    cannot_tell,
    global_randomness_untouched,
    require,
)
from crossgrad_core.wording import listed

#: Steps in which decoding is checked: before training, after one step, and at the end.
_STEPS = (0, 1, 30_000)
#: Maximum change of each parameter from its initial value.
_STEP = 0.02
#: Largest difference and largest mean difference between two renders that should be equal except
#: for float32 rounding. Rounding can add or remove a Gaussian at the edge of its footprint, where
#: alpha is 1/255.
_PIXEL, _MEAN = 0.02, 2e-4


def created(backbone: Backbone, seed: int = 0) -> Parameters:
    """Create parameters for the sample scene, prepared for the first step."""
    scene = sample_scene()
    parameters = backbone.create(scene, np.random.default_rng(seed))
    return backbone.prepare(parameters, scene, sample_phase(0))


def blocks_cover_the_parameters(make: Make[Backbone]) -> None:
    """Every trained tensor is in exactly one block. Each per-primitive tensor has N rows."""
    backbone = make()
    blocks, parameters = backbone.blocks(), created(backbone)
    names = [block.name for block in blocks]
    require(len(set(names)) == len(names), f"block names occur twice: {listed(names)}")
    held = [tensor for block in blocks for tensor in block.tensors]
    require(len(set(held)) == len(held), f"a tensor belongs to two blocks: {listed(held)}")
    missing = sorted(set(held) - set(parameters))
    require(not missing, f"blocks contain tensors that create() does not return: {listed(missing)}")
    trained = {name for name, tensor in parameters.items() if tensor.requires_grad}
    loose = sorted(trained - set(held))
    require(not loose, f"trained tensors that belong to no block: {listed(loose)}")
    rows = primitives_of(blocks, parameters)
    for block in blocks:
        single = len(block.tensors) > 1 or block.tensors[0] == block.name
        require(single, f"the single-tensor block {block.name} must have the name of its tensor")
        for name in block.tensors if block.per_primitive else ():
            row_count = parameters[name].shape[0]
            require(row_count == rows, f"{name} has {row_count} rows for {rows} Gaussians")


def the_default_densifier_is_there(make: Make[Backbone]) -> None:
    """The default densifier is installed, and the blocks contain the tensors that it edits."""
    backbone = make()
    densifier = registry.load(Densifier, backbone.default_densifier)
    lacks = densifier.tensors - {name for block in backbone.blocks() for name in block.tensors}
    what = f"default_densifier: {backbone.default_densifier}"
    require(not lacks, f"{what} needs the tensors {listed(sorted(lacks))}, which no block contains")


def created_from_the_scene(make: Make[Backbone]) -> None:
    """Initial parameters are finite float32 leaf tensors on the CPU.

    Equal seeds give equal parameters.
    """
    with global_randomness_untouched():
        one, other = created(make()), created(make())
    require(primitives_of(make().blocks(), one) > 0, "create() returns no Gaussians")
    for name, tensor in one.items():
        good = tensor.is_leaf and tensor.device.type == "cpu" and tensor.dtype == torch.float32
        require(good or not tensor.requires_grad, f"{name} is not a float32 leaf tensor on the CPU")
        require(tensor.isfinite().all(), f"{name} is not finite")
        require(
            torch.equal(tensor, other[name]), f"{name} differs between two calls with the same seed"
        )


def decoding_has_the_shape(make: Make[Backbone]) -> None:
    """Decoding returns valid Gaussians in all phases of training and evaluation."""
    backbone = make()
    parameters = created(backbone)
    rows = primitives_of(backbone.blocks(), parameters)
    for step in _STEPS:
        for training in (True, False):
            phase = sample_phase(step, training=training)
            _require_valid(backbone.decode(parameters, sample_camera(), phase), rows)


def _require_valid(gaussians: Gaussians, primitives: int) -> None:
    misfit = gaussians.misfit()
    require(misfit is None, f"decode() returns inconsistent Gaussians: {misfit}")
    number, kind = len(gaussians), gaussians.means.dtype
    require(kind.is_floating_point, f"means have the type {kind}, which is not a floating type")
    bands = 1 if gaussians.sh_rest is None else 1 + gaussians.sh_rest.shape[1]
    require(
        bands in COEFFICIENTS, f"there are {bands} coefficients, which is none of {COEFFICIENTS}"
    )
    decoded = gaussians.decoded
    whole = decoded is None or decoded.shape == (primitives,)
    require(whole, f"decoded does not have the shape [{primitives}] of the primitives")
    kinds = {"origin": torch.int64, "slot": torch.int64, "decoded": torch.bool}
    for name, value in vars(gaussians).items():
        if isinstance(value, Tensor):
            wanted = kinds.get(name, kind)
            require(value.dtype == wanted, f"{name} is {value.dtype}; expected {wanted}")
            require(value.isfinite().all(), f"{name} is not finite")
    require((gaussians.scales > 0.0).all(), "a scale is not positive")
    inside = (gaussians.opacities >= 0.0).all() and (gaussians.opacities <= 1.0).all()
    require(inside, "an opacity is outside [0, 1]")
    origin = gaussians.origin
    if origin is None:
        require(
            number == primitives, f"{number} Gaussians for {primitives} primitives, without origin"
        )
    else:
        within = number == 0 or (int(origin.min()) >= 0 and int(origin.max()) < primitives)
        require(within, f"origin contains indices outside 0 to {primitives - 1}")


def positions_are_those_of_primitives(make: Make[Backbone]) -> None:
    """`positions` is empty, or names a tensor [N, 3] with one row for each primitive."""
    backbone = make()
    parameters = created(backbone)
    held = [name for block in backbone.blocks() if block.per_primitive for name in block.tensors]
    fitting = [name for name in held if parameters[name].shape[1:] == (3,)]
    message = (
        f"positions is {backbone.positions!r}; tensors [N, 3] of primitives: {listed(fitting)}"
    )
    require(backbone.positions in {"", *fitting}, message)


def axes_are_those_of_primitives(make: Make[Backbone]) -> None:
    """`axes` is empty, or names per-primitive tensors [N, 3] and [N, 4].

    Axes also require `positions`.
    """
    backbone = make()
    parameters = created(backbone)
    held = {name for block in backbone.blocks() if block.per_primitive for name in block.tensors}
    shapes = [tuple(parameters[n].shape[1:]) if n in held else None for n in backbone.axes]
    fit = not backbone.axes or (shapes == [(3,), (4,)] and backbone.positions != "")
    require(fit, f"axes is {backbone.axes!r}, positions {backbone.positions!r}; shapes {shapes}")


def gradients_reach_every_block(make: Make[Backbone]) -> None:
    """The decoded Gaussians of all views together depend on every trained block."""
    backbone = make()
    parameters = created(backbone)
    for view in sample_scene().train_views:
        gaussians = backbone.decode(parameters, view.camera, sample_phase())
        _weighted(gaussians).backward()  # type: ignore[no-untyped-call]
    for block in backbone.blocks():
        gradients = [parameters[name].grad for name in block.tensors]
        reached = any(gradient is not None and gradient.any() for gradient in gradients)
        frozen = block.lr.initial == 0.0
        require(reached or frozen, f"block {block.name} receives no gradient (lr {block.lr})")
        for gradient in gradients:
            finite = gradient is None or gradient.isfinite().all()
            require(finite, f"the gradient of block {block.name} is not finite")


def _weighted(gaussians: Gaussians) -> Tensor:
    """Return a weighted sum of all decoded values. Every value has a different weight."""
    names = ("means", "quats", "scales", "opacities", "colors", "sh_dc", "sh_rest")
    tensors = [getattr(gaussians, name) for name in names]
    given = [tensor.flatten() for tensor in tensors if tensor is not None]
    flat = torch.cat(given)
    weighted: Tensor = (flat * torch.linspace(0.5, 1.5, flat.numel())).sum()
    return weighted


def checkpoints_give_the_same_gaussians(make: Make[Backbone]) -> None:
    """Parameters that were saved and loaded decode to bit-identical Gaussians."""
    backbone = make()
    parameters = created(backbone)
    written = save({name: tensor.detach().contiguous() for name, tensor in parameters.items()})
    for training in (True, False):
        phase = sample_phase(training=training)
        with global_randomness_untouched():
            one = backbone.decode(parameters, sample_camera(), phase)
            other = make().decode(load(written), sample_camera(), phase)
        for name in (name for name, value in vars(one).items() if isinstance(value, Tensor)):
            same = torch.equal(getattr(one, name), getattr(other, name))
            require(same, f"{name} differs after a checkpoint; keep all state in the parameters")


def edits_keep_rows_together(make: Make[Backbone]) -> None:
    """After an edit, each row of each per-primitive tensor still belongs to its primitive."""
    backbone = make()
    before = created(backbone)
    rows = primitives_of(backbone.blocks(), before)
    # The edit removes the last two primitives, reverses the remaining primitives, and adds copies
    # of the first two at the end.
    source = torch.cat([torch.arange(rows - 3, -1, -1), torch.tensor([0, 1])])
    after = _edited(backbone, before, source)
    for block in backbone.blocks():
        for name in block.tensors if block.per_primitive else ():
            same = torch.equal(after[name], before[name][source])
            require(same, f"prepare() changes the trained tensor {name} after an edit")
    _require_valid(backbone.decode(after, sample_camera(), sample_phase()), rows)


def few_primitives_are_no_error(make: Make[Backbone]) -> None:
    """A model with one primitive or with no primitives can be prepared and decoded."""
    backbone = make()
    parameters = created(backbone)
    for rows in (1, 0):
        left = _edited(backbone, parameters, torch.arange(rows))
        _require_valid(backbone.decode(left, sample_camera(), sample_phase()), rows)


def _edited(backbone: Backbone, parameters: Parameters, source: Tensor) -> Parameters:
    new = apply_to_parameters(Edit(source=source), backbone.blocks(), parameters)
    return backbone.prepare(new, sample_scene(), sample_phase())


def parameters_stay_untouched(make: Make[Backbone]) -> None:
    """Decoding and baking do not change any parameter."""
    backbone = make()
    parameters = created(backbone)
    copies = {name: tensor.detach().clone() for name, tensor in parameters.items()}
    backbone.decode(parameters, sample_camera(), sample_phase())
    backbone.bake(parameters, sample_phase(training=False), [sample_camera()])
    _require_equal(parameters, copies)


def _require_equal(parameters: Mapping[str, Tensor], copies: Mapping[str, Tensor]) -> None:
    for name, tensor in parameters.items():
        require(torch.equal(tensor.detach(), copies[name]), f"decoding or baking changes {name}")


def baking_gives_plain_gaussians(make: Make[Backbone]) -> None:
    """Baked Gaussians for a PLY file have spherical harmonics and no autograd graph."""
    backbone = make()
    baked = backbone.bake(created(backbone), sample_phase(training=False), [sample_camera()])
    require(baked.sh_dc is not None and baked.colors is None, "bake() does not return sh_dc")
    require(not baked.means.requires_grad, "bake() returns tensors with a graph")
    require(len(baked) > 0, "bake() returns no Gaussians")
    finite = all(getattr(baked, name).isfinite().all() for name in ("means", "quats", "scales"))
    require(finite, "bake() returns Gaussians that are not finite")


def plain_ones_bake_what_they_draw(make: Make[Backbone]) -> None:
    """With `plain`, baked and decoded Gaussians give equal images for every camera."""
    backbone = make()
    if not backbone.plain:
        raise cannot_tell("the backbone does not declare that a standard PLY loses nothing (plain)")
    parameters, phase = _grown(created(backbone)), sample_phase(training=False)
    cameras = [view.camera for view in sample_scene().train_views]
    baked = backbone.bake(parameters, phase, cameras[:1])
    rasterizer, background = build(Rasterizer, REFERENCE_RASTERIZER, {}), torch.full((3,), 0.5)
    for camera in cameras:
        with torch.no_grad():
            decoded = backbone.decode(parameters, camera, phase)
            drawn, again = (
                rasterizer.render(gaussians, camera, background).image
                for gaussians in (decoded, baked)
            )
        error = (drawn - again).abs()
        require(
            error.max() < _PIXEL and error.mean() < _MEAN,
            "plain is True, but the render of bake differs from the render of decode by "
            f"up to {float(error.max()):.2g}, {float(error.mean()):.2g} on average; "
            f"expected at most {_PIXEL:g} and {_MEAN:g}: make bake return the Gaussians "
            "of decode, or set plain to False",
        )


def _grown(parameters: Parameters) -> Parameters:
    """Change the parameters, so that no value is as special as an initial value.

    All parameters become larger. With larger parameters, colours stay above 0. Below 0, colours
    from spherical harmonics are clamped, but plain colours are not.
    """
    rng = np.random.default_rng(5)

    def grown(tensor: Tensor) -> Tensor:
        step = torch.from_numpy(rng.uniform(0.0, _STEP, tuple(tensor.shape))).to(tensor)
        return (tensor.detach() + step).requires_grad_()

    return {
        name: grown(parameter) if parameter.requires_grad else parameter
        for name, parameter in parameters.items()
    }


def fitting_respects_the_user(make: Make[Backbone]) -> None:
    """`fitted_to` returns a note for each changed option.

    `fitted_to` never changes an option that the user set.
    """
    backbone = make()
    fitted, notes = backbone.fitted_to(sample_scene())
    explained = fitted == backbone or len(notes) > 0
    require(explained, "fitted_to() changes options but returns no note about the change")
    asked = type(backbone).model_validate(backbone.model_dump())
    require(
        asked.fitted_to(sample_scene())[0] == asked, "fitted_to() changes options that the user set"
    )


def passed_on_tensors_are_handed_over(make: Make[Backbone]) -> None:
    """A tensor in `passthrough` becomes part of the Gaussians unchanged.

    `decode` does not read the values of this tensor.
    """
    backbone = make()
    parameters = created(backbone)
    for name in parameters.keys() & set(backbone.passthrough.values()):
        parameters[name] = torch.full_like(parameters[name], torch.nan)
    for step in _STEPS:
        gaussians = backbone.decode(parameters, sample_camera(), sample_phase(step))
        for field, value in vars(gaussians).items():
            if value is not None and field in backbone.passthrough:
                kept = value is parameters.get(backbone.passthrough[field])
                require(kept, f"{field} is not the tensor that passthrough names")
            elif isinstance(value, Tensor):
                is_finite = bool(value.isfinite().all())
                require(is_finite, f"{field} is computed from a tensor that passthrough names")


BACKBONE_CHECKS: tuple[Check[Backbone], ...] = (
    *COMPONENT_CHECKS,
    blocks_cover_the_parameters,
    the_default_densifier_is_there,
    created_from_the_scene,
    decoding_has_the_shape,
    positions_are_those_of_primitives,
    axes_are_those_of_primitives,
    gradients_reach_every_block,
    checkpoints_give_the_same_gaussians,
    edits_keep_rows_together,
    few_primitives_are_no_error,
    parameters_stay_untouched,
    passed_on_tensors_are_handed_over,
    baking_gives_plain_gaussians,
    plain_ones_bake_what_they_draw,
    fitting_respects_the_user,
)
