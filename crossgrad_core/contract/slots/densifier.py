"""The densifier slot: a component clones, splits, grows, relocates and prunes primitives."""

from abc import abstractmethod
from typing import ClassVar

from crossgrad_core.contract.blocks import Edit, Parameters, PluginState
from crossgrad_core.contract.component import Component, hookimpl, with_state
from crossgrad_core.contract.contexts import DensifyContext, DensifyResult
from crossgrad_core.contract.schedule import Schedule

STATE = "densifier"


class Densifier(Component):
    """A method that collects per-view statistics in every step and edits the set of primitives.

    Attributes:
        needs: Screen statistics that the densifier needs in addition to the radii and the mean
            gradient (`pixels`, `abs_gradient`, `directions`, `count`), while
            `schedule.collects(step)`.
        tensors: Names of the parameter tensors that the backbone must provide.
        edits: True if the densifier ever edits the set of primitives.
        resets: True if the densifier resets opacities when the schedule requires it.
        reset_options: Options that have an effect only in runs with opacity resets. A subclass that
            reads such an inherited option in runs without resets must remove the option from this
            set.
        observes: True if the densifier collects statistics of the views that the steps render.
        budgeted: True if growth follows a budget of Gaussians that depends on the length of the
            run, unless the user sets a bound.
    """

    slot: ClassVar[str] = "densifiers"
    needs: ClassVar[frozenset[str]] = frozenset()
    tensors: ClassVar[frozenset[str]] = frozenset()
    edits: ClassVar[bool] = True
    resets: ClassVar[bool] = True
    reset_options: ClassVar[frozenset[str]] = frozenset()
    observes: ClassVar[bool] = True
    budgeted: ClassVar[bool] = False

    def window(self, schedule: Schedule) -> Schedule:
        """Return the schedule with the edit times of this densifier.

        The user's settings override these times.

        Args:
            schedule: The schedule of the run, with the times of 3DGS.
        """
        return schedule

    def started(self, parameters: Parameters) -> Parameters:
        """Return the initial parameters as this densifier changes them; by default unchanged."""
        return parameters

    @abstractmethod
    def densify(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        """Return the edit of this step and the new state.

        An edit must keep at least a tenth of the primitives of a model that trains well. A model
        does not recover from the loss of nearly all primitives.

        The core applies the edit to the rows of `per_primitive` in the *returned* state, too.
        """

    @hookimpl
    def crossgrad_densify(self, context: DensifyContext) -> DensifyResult:
        """Return this densifier's result for the hook."""
        answer = self.densify(context, context.state(STATE))
        edit, state = with_state(answer, Edit, self, "densify")
        return DensifyResult(edit, states={STATE: state})
