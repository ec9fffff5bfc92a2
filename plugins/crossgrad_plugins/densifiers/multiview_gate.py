"""A wrapper around another densifier: only primitives with errors in several views may grow."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, cast

from pydantic import BeforeValidator, Field, PlainSerializer
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import (
    Densifier,
    DensifyContext,
    Edit,
    Parameters,
    PluginState,
    Schedule,
    Selection,
    UserError,
    build_component,
    component_name,
    plain_component,
    set_for_nothing,
)
from crossgrad_plugins.densifiers.error_pixel_counts import CountsMarkedPixels

#: Prefix of the names of the gate's own values in the state. It separates these values from the
#: values of the wrapped densifier.
OWN = "gate/"
#: Hooks of the wrapped densifier that the gate calls itself.
_ANSWERED = frozenset({"crossgrad_densify", "crossgrad_validate_selection"})


def densifier_of(value: object) -> Densifier:
    """Return a densifier from a densifier, a name, or a mapping `{name: ..., option: ...}`."""
    if not isinstance(value, Densifier):
        choice = {"name": value} if isinstance(value, str) else value
        if not isinstance(choice, Mapping) or "name" not in choice:
            raise ValueError("must be a densifier's name, or a name with options")
        options = {key: option for key, option in choice.items() if key != "name"}
        value = build_component(Densifier, str(choice["name"]), options)
    further = {hook for hook in dir(value) if hook.startswith("crossgrad_")} - _ANSWERED
    if further or not value.edits or isinstance(value, CountsMarkedPixels):
        raise ValueError(
            f"{component_name(value)} cannot be used inside another densifier: it has "
            "further hooks, never edits, or renders several views itself"
        )
    return value


class MultiViewGate(CountsMarkedPixels):
    """Lets another densifier grow only primitives that have errors in several views.

    A primitive may grow if its Gaussians are blended in more than `importance` erroneous pixels per
    view on average. The option `of` names the other densifier, which decides how a primitive grows
    and which primitives are pruned. For anchors, use `anchor` or `octree`; for Gaussians, use any
    densifier that clones and splits.
    """

    of: Annotated[Densifier, BeforeValidator(densifier_of), PlainSerializer(plain_component)] = (
        Field(cast("Any", "adc"), description="inner densifier: adc, anchor, octree")
    )

    @property
    @override
    def needs(self) -> frozenset[str]:  # type: ignore[override]
        """The statistics that the wrapped densifier needs, and the pixel count of the gate."""
        return self.of.needs | {"count"}

    @property
    @override
    def tensors(self) -> frozenset[str]:  # type: ignore[override]
        """The tensors that the wrapped densifier edits."""
        return self.of.tensors

    @property
    @override
    def resets(self) -> bool:  # type: ignore[override]
        """True if the wrapped densifier resets opacities."""
        return self.of.resets

    @property
    @override
    def observes(self) -> bool:  # type: ignore[override]
        """True if the gate or the wrapped densifier collects statistics of views."""
        return self.count == "running" or self.of.observes

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect; see `HasUnusedOptions`."""
        idle = self.idle_counting(renders=False)
        inner = set_for_nothing(self.of, replace(selection, densifier=self.of))
        if inner:
            idle["of"] = "; ".join(f"{name}: {why}" for name, why in inner.items())
        return idle

    @override
    def window(self, schedule: Schedule) -> Schedule:
        return self.of.window(schedule)

    @override
    def started(self, parameters: Parameters) -> Parameters:
        return self.of.started(parameters)

    @override
    def densify(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        gate, inner = _parted(state)
        gate = self.counted(context, gate) if context.schedule.collects(context.step) else gate
        may_grow = None
        if context.schedule.densifies(context.step):
            seen = self.importance_of(gate)
            may_grow = seen.above(self.importance).any(dim=1)
            gate = PluginState()
        edit, inner = self.of.densify(replace(context, may_grow=may_grow), inner)
        if may_grow is not None:
            self._check(edit, may_grow)
        return edit, _joined(gate, inner)

    def _check(self, edit: Edit, may_grow: Tensor) -> None:
        """Raise an error if the wrapped densifier grew a primitive that may not grow."""
        if edit.source is None or edit.fresh is None:
            return
        if not bool(may_grow[edit.source[edit.fresh]].all()):
            raise UserError(
                f"densifier {component_name(self.of)} grew Gaussians that the gate does not "
                "allow to grow",
                where="densifier multiview-gate",
                expected="a densifier that respects `context.may_grow`",
                todo="choose another densifier with --set densifier.of=NAME, or use it without "
                "the gate",
            )


def _parted(state: PluginState) -> tuple[PluginState, PluginState]:
    """Split a state into the values of the gate and the values of the wrapped densifier."""
    gate, inner = (
        {
            field: {
                name.removeprefix(OWN): value
                for name, value in getattr(state, field).items()
                if name.startswith(OWN) == mine
            }
            for field in ("values", "tensors", "per_primitive")
        }
        for mine in (True, False)
    )
    return PluginState(**gate), PluginState(**inner)


def _joined(gate: PluginState, inner: PluginState) -> PluginState:
    """Join the values of the gate and of the wrapped densifier in one state."""
    per_primitive = {OWN + name: rows for name, rows in gate.per_primitive.items()}
    return replace(inner, per_primitive={**inner.per_primitive, **per_primitive})
