"""Contract checks for initializers."""

from contextlib import suppress
from dataclasses import fields

import numpy as np

from crossgrad_core.contract.slots.initializer import Initializer, MorePoints
from crossgrad_core.errors import UserError
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import (
    Check,
    ContractError,
    Make,
    global_randomness_untouched,
    require,
)


def adds_points(make: Make[Initializer]) -> None:
    """Each added point has a position, a colour, a size above 0, and an opacity between 0 and 1.

    The size and the opacity may also be NaN. An initializer with `alone = True` is also tested on a
    scene without points. If an initializer finds no points, it may raise an error.
    """
    start = make()
    _require_points(start.more_points(sample_scene()))
    if start.alone:
        bare = sample_scene().with_points(np.zeros(0, np.int64))
        with suppress(UserError):
            _require_points(start.more_points(bare))


def _require_points(more: object) -> None:
    if more is None:
        return
    if not isinstance(more, MorePoints):
        raise ContractError(f"more_points() returned {type(more).__name__}, not MorePoints")
    count = len(more.positions)
    shapes = {"positions": (count, 3), "colors": (count, 3), "sizes": (count,)}
    for name, shape in {**shapes, "opacities": (count,)}.items():
        actual = getattr(more, name).shape
        require(actual == shape, f"{name} has the shape {actual}; {count} points need {shape}")
    require(more.colors.dtype == np.uint8, f"colors are {more.colors.dtype}, not uint8")
    require(bool(np.isfinite(more.positions).all()), "a position is not finite")
    sizes, opacities = more.sizes, more.opacities
    good = (np.isfinite(sizes) & (sizes > 0.0)) | np.isnan(sizes)
    require(good.all(), "a size is neither a number above 0 nor NaN")
    inside = ((opacities > 0.0) & (opacities < 1.0)) | np.isnan(opacities)
    require(inside.all(), "an opacity is neither between 0 and 1 nor NaN")


def answers_alike(make: Make[Initializer]) -> None:
    """A second call, even on a new object, returns equal points and equal messages."""
    scene = sample_scene()
    with global_randomness_untouched():
        one, other = make(), make()
        first, second = one.more_points(scene), other.more_points(scene)
        same_messages = one.messages(scene) == other.messages(scene)
    require(same_messages, "messages() returns different texts in two calls")
    require((first is None) == (second is None), "points are added in only one of two calls")
    if first is not None and second is not None:
        for field in fields(first):
            same = np.array_equal(getattr(first, field.name), getattr(second, field.name))
            require(same, f"{field.name} differ between two calls")


INITIALIZER_CHECKS: tuple[Check[Initializer], ...] = (*COMPONENT_CHECKS, adds_points, answers_alike)
