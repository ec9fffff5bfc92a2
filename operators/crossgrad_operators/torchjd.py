"""Use a Gramian weighting of TorchJD by name (optional dependency `torchjd`)."""

from collections.abc import Mapping
from typing import Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, PlainSerializer
from typing_extensions import override

from crossgrad_core.plugin import (
    GramianOperator,
    OperatorContext,
    PluginState,
    UserError,
    diagonals,
)

_Value: TypeAlias = bool | int | float | str


#: TorchJD weightings whose weights do not depend on the Gramian.
_FIXED = frozenset({"Constant", "Mean", "Random", "Sum"})


def _pairs(value: object) -> object:
    return tuple(value.items()) if isinstance(value, Mapping) else value


class TorchJD(GramianOperator):
    """Weights w = Weighting(G / trace G), for the weighting classes in torchjd.aggregation.

    The Gramian G is divided by its trace, because TorchJD compares G with absolute thresholds.
    Views without a gradient are left out of G. Weightings that store earlier steps raise an error,
    because a checkpoint could not save their state.
    """

    weighting: str = Field(
        "AlignedMTL",
        description="name of a TorchJD weighting, with or without the suffix `Weighting`",
    )
    options: Annotated[
        tuple[tuple[str, _Value], ...], BeforeValidator(_pairs), PlainSerializer(dict)
    ] = Field((), description="arguments of the weighting")

    @override
    def reads_gramians(self) -> bool:
        return self.weighting.removesuffix("Weighting") not in _FIXED

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        import torch

        weights = np.zeros(gramians.shape[:2])
        rule = self._built()
        # TorchJD uses the global random generator, so restore this generator afterwards.
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            torch.manual_seed(int(rng.integers(2**63)))
            for block, present in enumerate(context.present):
                chosen = np.flatnonzero(present)
                if chosen.size:
                    gramian = gramians[block][np.ix_(chosen, chosen)]
                    block_weights = rule(torch.from_numpy(gramian / np.trace(gramian)))
                    weights[block, chosen] = block_weights.double().numpy()
        return diagonals(weights), state

    def _built(self) -> Any:  # noqa: ANN401 - TorchJD may be absent
        try:
            from torchjd import aggregation
        except ImportError:
            raise UserError(
                "operator torchjd needs the package torchjd",
                todo='install it: pip install "crossgrad[torchjd]"',
            ) from None
        name = self.weighting.removesuffix("Weighting") + "Weighting"
        weighting = getattr(aggregation, name, None)
        if weighting is None:
            names = sorted(
                n.removesuffix("Weighting") for n in dir(aggregation) if "Weighting" in n
            )
            raise UserError(
                f"TorchJD has no weighting named {self.weighting!r}",
                where="operator.weighting",
                expected=f"one of {', '.join(filter(None, names))}",
                todo="choose one of these weightings with --set operator.weighting=NAME",
            )
        if hasattr(weighting, "reset"):
            raise UserError(
                f"TorchJD's {name} stores state between steps, so that a run could not be resumed",
                where="operator.weighting",
                todo="use crossgrad's operator of the same name, or another weighting",
            )
        return self._called(weighting)

    def _called(self, kind: Any) -> Any:  # noqa: ANN401
        try:
            return kind(**dict(self.options))
        except (ImportError, TypeError, ValueError) as error:
            raise UserError(
                f"TorchJD's {kind.__name__} cannot be created",
                where="operator.options",
                found=str(error),
                todo=f"set the arguments of {kind.__name__}: --set 'operator.options={{...}}'",
            ) from error
