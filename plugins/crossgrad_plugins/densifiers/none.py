"""No density control: the set of primitives does not change."""

from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import NO_EDIT, Densifier, DensifyContext, Edit, PluginState


class NoDensification(Densifier):
    """Never edits the primitives, and needs no statistics."""

    edits: ClassVar[bool] = False
    resets: ClassVar[bool] = False
    observes: ClassVar[bool] = False

    @override
    def densify(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        return NO_EDIT, state
