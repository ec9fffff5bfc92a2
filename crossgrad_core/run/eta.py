"""How long a run of so many steps will take, told after its first steps."""

from crossgrad_core.run.results.lines import roughly
from crossgrad_core.training.budget import Length, seconds_ahead
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

#: Steps and training seconds to look at before anything is said; the very first step is left out.
LOOK_STEPS, LOOK_SECONDS = 3, 2.0
#: A run that takes less is over before an estimate helps.
WORTH_A_LINE = 60.0


class Forecast:
    """Another length; says once how long the rest of the run will take.

    Args:
        length: The length that decides.
    """

    def __init__(self, length: Length) -> None:
        self._length = length
        self._first: tuple[int, float] | None = None
        self._told = False

    def due(self, state: TrainState) -> bool:
        """When there is something to decide or to tell."""
        if self._first is None:
            self._first = state.step, state.clock.train
        return self._length.due(state) or self._is_time(state)

    def revised(self, setup: Setup, state: TrainState) -> Setup:
        """The setup with the length that now holds."""
        if self._length.due(state):
            setup = self._length.revised(setup, state)
        if self._is_time(state):
            self._tell(setup, state)
        return setup

    def _is_time(self, state: TrainState) -> bool:
        if self._told or self._first is None:
            return False
        step, seconds = self._first
        return state.step - step >= LOOK_STEPS and state.clock.train - seconds >= LOOK_SECONDS

    def _tell(self, setup: Setup, state: TrainState) -> None:
        self._told = True
        step, seconds = self._first or (0, 0.0)
        each = (state.clock.train - seconds) / (state.step - step)
        ahead = seconds_ahead(setup, state, each)
        if ahead < WORTH_A_LINE:
            return
        left = setup.schedule.total - state.step
        growth = ", growth included" if ahead > left * each else ""
        setup.hook.crossgrad_log(
            text=f"{left:,} more steps take {roughly(ahead)} (one takes {each * 1000:.0f} ms now"
            f"{growth}); --seconds S sets a time instead, and Ctrl-C keeps what there is"
        )
