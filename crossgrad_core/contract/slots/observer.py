"""The observer slot: watches run events and may wrap the hooks."""

from typing import ClassVar

from crossgrad_core.contract.component import Component


class Observer(Component):
    """A plugin that implements event hooks or wraps hooks (`@hookimpl(wrapper=True)`).

    It ends no run: it catches what can fail. It changes the model through answers only, answers
    finite numbers to finite ones, keeps at most 0.1 MB of each step in memory, and holds up a step
    by less than 0.1 s per call on a small scene (events are off the clock).

    Attributes:
        needs_separate_gradients: Whether it looks at the gradients of single views; the run then
            keeps them apart, which costs memory and changes no bit of the training.
    """

    slot: ClassVar[str] = "observers"
    needs_separate_gradients: ClassVar[bool] = False
