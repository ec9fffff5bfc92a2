"""The observer slot: watches run events and may wrap the seams."""

from typing import ClassVar

from crossgrad_core.contract.component import Component


class Observer(Component):
    """A plugin that implements event hooks or wraps seams (`@hookimpl(wrapper=True)`).

    Attributes:
        needs_separate_gradients: Whether it looks at the gradients of single views; the run then
            keeps them apart, which costs memory and changes no bit of the training.
    """

    slot: ClassVar[str] = "observers"
    needs_separate_gradients: ClassVar[bool] = False
