"""The densifier slot: screen statistics -> clone, split, grow, relocate, prune."""

from abc import abstractmethod
from typing import ClassVar

from crossgrad_core.contract.blocks import Edit, Parameters, PluginState
from crossgrad_core.contract.component import Component, hookimpl, with_state
from crossgrad_core.contract.contexts import DensifyContext, DensifyResult
from crossgrad_core.contract.schedule import Schedule

STATE = "densifier"


class Densifier(Component):
    """Gathers per-view statistics in every step and edits the set of primitives.

    Attributes:
        needs: Screen statistics beyond the radii and the mean gradient that it needs
            (`pixels`, `abs_gradient`, `directions`, `count`), while `schedule.collects(step)`.
        tensors: Names of the parameter tensors that it needs a backbone to have.
        edits: Whether it ever edits the set of primitives.
        resets: Whether it resets opacities when the schedule says so.
        reset_options: Its options that count only in runs with resets; methods that inherit them
            and read them in other runs, too, name others.
        observes: Whether it gathers statistics of the views that the steps render.
        budgeted: Whether a run that names no bound leads its growth along the curve to the budget
            of its length, which is one of Gaussians.
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
        """The schedule with the times at which this method edits; what the user set wins over it.

        Args:
            schedule: The schedule of the run, with the times of 3DGS.
        """
        return schedule

    def started(self, parameters: Parameters) -> Parameters:
        """The initial parameters as this method wants them; by default untouched."""
        return parameters

    @abstractmethod
    def densify(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        """The edit of this step and the new state.

        An edit of a model that trains well keeps at least a tenth of its primitives: a model that
        loses nearly all of them at once cannot be trained back.

        The core gathers `state.per_primitive` of *the returned state* along with the edit.
        """

    @hookimpl
    def crossgrad_densify(self, context: DensifyContext) -> DensifyResult:
        """Answers the hook with this densifier's edit."""
        answer = self.densify(context, context.state(STATE))
        edit, state = with_state(answer, Edit, self, "densify")
        return DensifyResult(edit, states={STATE: state})
