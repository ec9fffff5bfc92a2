"""The observer slot: a component observes the events of a run and may wrap hooks."""

from typing import ClassVar

from crossgrad_core.contract.component import Component


class Observer(Component):
    """A plugin that implements event hooks or wraps hooks (`@hookimpl(wrapper=True)`).

    An observer must not end a run: it catches its own errors. An observer changes the model through
    hook results only, and returns finite numbers for finite inputs. An observer stores at most 0.1
    MB of memory per step. On a small scene, each call of an observer takes less than 0.1 s. The
    time of event hooks does not count as training time.

    Attributes:
        needs_separate_gradients: True if the observer reads the gradients of single views. The run
            then stores these gradients separately, which needs more memory. The training results
            are the same bit for bit.
    """

    slot: ClassVar[str] = "observers"
    needs_separate_gradients: ClassVar[bool] = False
