"""The contents of a checkpoint."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from crossgrad_core.contract.state import Json, PluginState


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Everything from which a run continues bit for bit.

    Attributes:
        step: Steps done.
        parameters: Tensor name -> parameter.
        exp_avg: Tensor name -> Adam's first moment.
        exp_avg_sq: Tensor name -> Adam's second moment.
        adam_steps: Tensor name -> number of Adam steps taken.
        plugins: Plugin name -> its state.
        generators: Stream name -> `bit_generator.state` of its NumPy generator.
        scalars: Counters, clocks and whatever else JSON can hold (tuples come back as lists).
    """

    step: int
    parameters: Mapping[str, Tensor]
    exp_avg: Mapping[str, Tensor] = field(default_factory=dict)
    exp_avg_sq: Mapping[str, Tensor] = field(default_factory=dict)
    adam_steps: Mapping[str, int] = field(default_factory=dict)
    plugins: Mapping[str, PluginState] = field(default_factory=dict)
    generators: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    scalars: Mapping[str, Json] = field(default_factory=dict)
