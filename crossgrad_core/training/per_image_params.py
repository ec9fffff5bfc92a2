"""Exposure parameters for each photo: stored like the state of a plugin, with an Adam of their own.

Snapshots, rollback and checkpoints include all plugin states, and therefore also the exposure
parameters.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

from crossgrad_core.contract.blocks import EMPTY_STATE, AdamState, PluginState
from crossgrad_core.contract.scene import View
from crossgrad_core.errors import UserError
from crossgrad_core.system.checksums import warn_if_changed
from crossgrad_core.system.files import write_atomically
from crossgrad_core.system.text_files import read_json
from crossgrad_core.training.adam.adam import adam_step
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import NonFiniteError, TrainState
from crossgrad_core.wording import listed

#: Name of the file in the folder of a run.
PHOTO_VALUES: Final = "exposure.json"
#: Version of the file format. Increase this number if an older version of crossgrad could misread a
#: newer file.
PHOTO_VALUES_FORMAT: Final = 1
_TODO = "give the exposure.json of a run, or leave --exposure-from out"


def write_values(
    path: Path, exposure: str, photos: Sequence[str], values: Mapping[str, Tensor]
) -> None:
    """Write the exposure parameters of photos to a file.

    Args:
        path: The file.
        exposure: Name of the exposure model that uses the parameters.
        photos: Names of the photos.
        values: Tensor [P, ...] of each parameter, by name; one row for each photo.

    Raises:
        UserError: The disk is full, or the folder is not writable.
    """
    plain = {name: tensor.detach().cpu().tolist() for name, tensor in values.items()}
    rows = {
        photo: {name: of_all[row] for name, of_all in plain.items()}
        for row, photo in enumerate(photos)
    }
    content = {"format": PHOTO_VALUES_FORMAT, "exposure": exposure, "photos": rows}
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())


def read_values(path: Path, like: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """Return the parameters of each photo: name of the photo -> name of the parameter -> value.

    Args:
        path: The file.
        like: Name -> [P, ...] parameters of the present run. The file must contain the names and
            shapes of `like`.

    Raises:
        UserError: The file cannot be read, or contains the parameters of another exposure model.
    """
    content = _content(path)
    exposure = content.get("exposure", "another one")
    values_by_photo = {}
    for photo, values in content["photos"].items():
        if not isinstance(values, dict) or values.keys() != like.keys():
            names = listed(values) if isinstance(values, dict) else repr(values)
            raise _misfit(path, exposure, listed(like), f"{names} of photo {photo}")
        values_by_photo[photo] = {
            name: _value(path, exposure, values[name], tensor[0]) for name, tensor in like.items()
        }
    return values_by_photo


def _content(path: Path) -> dict[str, Any]:
    try:
        content = read_json(path)
    except (FileNotFoundError, ValueError) as error:
        raise UserError(
            "the file of photo parameters cannot be read", where=path, found=str(error), todo=_TODO
        ) from error
    if not isinstance(content, dict) or not _is_of_photos(content):
        raise UserError(
            "the file does not contain parameters of photos",
            where=path,
            expected=f"an object with the fields format ({PHOTO_VALUES_FORMAT}) and photos",
            found=str(list(content))[:80] if isinstance(content, dict) else type(content).__name__,
            todo=_TODO,
        )
    return content


def _is_of_photos(content: Mapping[str, Any]) -> bool:
    return content.get("format") == PHOTO_VALUES_FORMAT and isinstance(content.get("photos"), dict)


def _value(path: Path, exposure: object, plain: object, like: Tensor) -> Tensor:
    try:
        value = torch.tensor(plain, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise _misfit(path, exposure, "numbers", str(plain)[:80]) from error
    if value.shape != like.shape or not all(map(isfinite, value.flatten().tolist())):
        shape = f"finite numbers of shape {list(like.shape)}"
        raise _misfit(path, exposure, shape, str(plain)[:80])
    return value


def _misfit(path: Path, exposure: object, expected: str, found: str) -> UserError:
    return UserError(
        "the photo parameters in the file belong to another exposure model",
        where=path,
        expected=expected,
        found=f"{found}, written by exposure {exposure}",
        todo=f"choose --exposure {exposure}, or leave --exposure-from out",
    )


#: Key of the exposure parameters in `TrainState.states`.
STATE = "photos"
_VALUE, _FIRST, _SECOND, _COUNT = "value", "exp_avg", "exp_avg_sq", "count"
#: The parameters of one photo, by name; autograd collects their gradients.
Leaves = dict[str, Tensor]


def started(setup: Setup) -> PluginState | None:
    """Return the exposure parameters before the first step; None if the exposure has no parameters.

    Raises:
        UserError: The initial values are not finite float32 tensors with one row for each training
            photo.
    """
    parameters = setup.per_photo
    if not parameters:
        return None
    starts = {name: parameter.first() for name, parameter in parameters.items()}
    for name, start in starts.items():
        _check(setup, f"initializes parameter {name} with", start)
    tensors = {}
    for name, tensor in (known_starts(setup) or starts).items():
        start = tensor.detach().to(setup.device).clone(memory_format=torch.contiguous_format)
        tensors[f"{_VALUE}.{name}"] = start
        tensors[f"{_FIRST}.{name}"] = torch.zeros_like(start)
        tensors[f"{_SECOND}.{name}"] = torch.zeros_like(start)
    tensors[_COUNT] = torch.zeros(len(setup.train_views), dtype=torch.int64)
    return PluginState({"photos": [view.name for view in setup.train_views]}, tensors)


def known_starts(setup: Setup) -> Mapping[str, Tensor]:
    """Return initial values that include the values in the user's file; empty without a file.

    A photo that the file does not contain keeps its difference from the mean of the photos in the
    file.

    Raises:
        UserError: The file contains no training photo, or its values have wrong names or shapes.
    """
    path = setup.config.exposure_from
    if path is None:
        return {}
    starts = {name: parameter.first() for name, parameter in setup.per_photo.items()}
    warn_if_changed(path)
    values_by_photo = read_values(path, starts)
    names = [view.name for view in setup.train_views]
    rows = [row for row, name in enumerate(names) if name in values_by_photo]
    if not rows:
        raise UserError(
            "the file contains no values for the training photos",
            where=path,
            expected=f"photos such as {names[0]}",
            found=listed(list(values_by_photo)[:3]),
            todo="name the exposure.json of a run on this scene, or leave --exposure-from out",
        )
    merged = {}
    for name, start in starts.items():
        values = torch.stack([values_by_photo[names[row]][name] for row in rows])
        merged[name] = setup.exposure.shift(name, start, start[rows].mean(0), values.mean(0))
        merged[name][rows] = values
    return setup.exposure.project(merged)


def check_photos_are(setup: Setup, state: TrainState) -> None:
    """Check that the state contains parameters for exactly the training photos.

    Raises:
        UserError: The state contains the parameters of other photos.
    """
    held = state.states.get(STATE, EMPTY_STATE).values.get("photos", [])
    names = [view.name for view in setup.train_views] if setup.per_photo else []
    if held != names:
        raise UserError(
            "the checkpoint contains values of photos that the run does not train on",
            where=f"exposure {setup.selection.names['exposure']}",
            todo="resume with the same photos and the same split",
        )


def write_photos(setup: Setup, state: TrainState, path: Path) -> bool:
    """Write the parameters of all training photos.

    If the exposure has no parameters, write no file.

    Return True if a file was written.
    """
    values = _values(setup, state)
    if values:
        photos = [view.name for view in setup.train_views]
        write_values(path, setup.selection.names["exposure"], photos, values)
    return bool(values)


def leaves_of(setup: Setup, state: TrainState, index: int) -> Leaves:
    """Return copies of the parameters of a training photo; autograd collects their gradients."""
    values = _values(setup, state)
    return {name: rows[index].detach().clone().requires_grad_() for name, rows in values.items()}


def apply(setup: Setup, state: TrainState, view: View, image: Tensor) -> Tensor:
    """Apply the exposure model with its present parameters to a render of any view."""
    values = _values(setup, state)
    row = setup.row_of.get(view.name)
    if row is not None:
        view_values: Mapping[str, Tensor] = {name: rows[row] for name, rows in values.items()}
    else:
        view_values = setup.exposure.predict_unseen(view, setup.scene, values) if values else {}
    return setup.exposure.apply(image, view_values)


def take_photo_step(
    setup: Setup, state: TrainState, taken: Iterable[tuple[int, Leaves]], progress: float
) -> None:
    """Take an Adam step for the photos of the step, then project the parameters of all photos.

    A photo that occurs twice in the step takes one Adam step with the sum of its gradients.

    Args:
        setup: Setup of the run.
        state: The training state; its exposure parameters are replaced by new tensors.
        taken: For each drawn view: the row of its photo, and its parameters after the backward
            pass.
        progress: Completed share of the schedule, which determines the learning rates.

    Raises:
        NonFiniteError: A gradient is NaN or infinite.
        UserError: The projection does not return valid parameters for all photos.
    """
    if not setup.per_photo:
        return
    held = state.states[STATE]
    tensors = {name: tensor.clone() for name, tensor in held.tensors.items()}
    # Keep the step counts on the CPU. After a checkpoint is loaded, the step counts may be on the
    # GPU. With the counts on the GPU, reading a count in each step would wait for the GPU.
    tensors[_COUNT] = tensors[_COUNT].cpu()
    rates = {name: parameter.lr.at(progress) for name, parameter in setup.per_photo.items()}
    for row, gradients in _summed(taken).items():
        _check_gradients(setup, state, row, gradients)
        row_values = partial(_row, tensors, row, gradients)
        steps = dict.fromkeys(gradients, int(tensors[_COUNT][row]))
        moments = AdamState(row_values(_FIRST), row_values(_SECOND), steps)
        adam_step(row_values(_VALUE), gradients, moments, rates)
        tensors[_COUNT][row] += 1
    values = {name: tensors[f"{_VALUE}.{name}"] for name in setup.per_photo}
    for name, value in setup.exposure.project(values).items():
        _check(setup, f"projects parameter {name} to", value)
        tensors[f"{_VALUE}.{name}"] = value.detach()
    state.commit({STATE: PluginState(held.values, tensors)})


def _values(setup: Setup, state: TrainState) -> dict[str, Tensor]:
    held = state.states.get(STATE, EMPTY_STATE).tensors
    return {name: held[f"{_VALUE}.{name}"] for name in setup.per_photo}


def _summed(taken: Iterable[tuple[int, Leaves]]) -> dict[int, dict[str, Tensor]]:
    """Return the gradients of each photo's parameters, summed over all draws of the photo.

    The outer keys are rows of photos. The inner keys are names of parameters.
    """
    gradients_by_row: dict[int, dict[str, Tensor]] = {}
    for row, leaves in taken:
        gradients = gradients_by_row.setdefault(row, {})
        for name, leaf in leaves.items():
            if leaf.grad is not None:
                gradients[name] = gradients[name] + leaf.grad if name in gradients else leaf.grad
    return gradients_by_row


def _row(
    tensors: Mapping[str, Tensor], row: int, names: Iterable[str], kind: str
) -> dict[str, Tensor]:
    """Return the rows of one photo for a kind of tensor, as views that allow changes in place."""
    return {name: tensors[f"{kind}.{name}"][row] for name in names}


def _check_gradients(
    setup: Setup, state: TrainState, row: int, gradients: Mapping[str, Tensor]
) -> None:
    for name, gradient in gradients.items():
        if not _is_finite(gradient):
            view = setup.train_views[row].name
            raise NonFiniteError(state.step, (view,), f"the gradient of the photo's {name}")


def _is_finite(tensor: Tensor) -> bool:
    """Return True if the tensor is finite or on a GPU.

    On a GPU, the values are not checked, because the next loss of the photo shows the error.
    """
    return not tensor.is_cpu or bool(torch.isfinite(tensor).all())


def _check(setup: Setup, does: str, value: Tensor) -> None:
    photos = len(setup.train_views)
    right = value.ndim > 0 and value.shape[0] == photos and value.dtype == torch.float32
    if right and _is_finite(value):
        return
    raise UserError(
        f"exposure {setup.selection.names['exposure']} {does} invalid photo parameters",
        expected=f"finite float32 tensors of {photos} rows, one for each training photo",
        found=f"{value.dtype} of shape {list(value.shape)}",
        todo="choose another --exposure, or repair the plugin",
    )
