"""The densifier slot: screen statistics -> clone, split, grow, relocate, prune."""

from abc import abstractmethod
from typing import ClassVar

from crossgrad_core.contract.blocks import Parameters
from crossgrad_core.contract.component import Component, Selection
from crossgrad_core.contract.contexts import Densified, DensifyContext
from crossgrad_core.contract.hooks import hookimpl
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.contract.state import PluginState
from crossgrad_core.contract.topology import Edit, NoEdit

STATE = "densifier"


class Densifier(Component):
    """Gathers per-view statistics in every step and edits the set of primitives.

    Attributes:
        needs: Screen statistics beyond the radii and the mean gradient that it needs
            (`pixels`, `abs_gradient`, `directions`); given while `schedule.collects(step)`.
        blocks: Names of the parameter tensors that it needs a backbone to have.
        edits: Whether it ever edits the set of primitives.
        resets: Whether it resets opacities when the schedule says so.
    """

    slot: ClassVar[str] = "densifiers"
    needs: ClassVar[frozenset[str]] = frozenset()
    blocks: ClassVar[frozenset[str]] = frozenset()
    edits: ClassVar[bool] = True
    resets: ClassVar[bool] = True

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
    def densify(
        self, context: DensifyContext, state: PluginState
    ) -> tuple[Edit | NoEdit, PluginState]:
        """The edit of this step and the new state.

        The core gathers `state.per_primitive` of *the returned state* along with the edit.
        """

    @hookimpl
    def crossgrad_densify(self, context: DensifyContext) -> Densified:
        """Answers the seam with this densifier's edit."""
        edit, state = self.densify(context, context.state(STATE))
        return Densified(edit, states={STATE: state})

    @hookimpl
    def crossgrad_objections(self, selection: Selection) -> list[str]:
        """Refuses backbones and rasterizers that lack what this densifier needs."""
        return [*self._missing_blocks(selection), *self._missing_statistics(selection)]

    def _missing_blocks(self, selection: Selection) -> list[str]:
        have = {tensor for block in selection.backbone.blocks() for tensor in block.tensors}
        missing = sorted(self.blocks - have)
        if not missing:
            return []
        names = selection.names
        return [
            f"densifier {names['densifier']} edits the tensors {', '.join(missing)}, "
            f"which backbone {names['backbone']} does not have"
        ]

    def _missing_statistics(self, selection: Selection) -> list[str]:
        missing = sorted(self.needs - selection.rasterizer.provides)
        if not missing:
            return []
        names = selection.names
        return [
            f"densifier {names['densifier']} needs the screen statistics {', '.join(missing)}, "
            f"which rasterizer {names['rasterizer']} does not provide"
        ]
