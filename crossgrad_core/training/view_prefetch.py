"""Which views the next steps will draw, so that their photos can be decoded ahead."""

from collections import deque
from copy import deepcopy
from dataclasses import replace

import numpy as np

from crossgrad_core.contract.sampler import STATE
from crossgrad_core.contract.state import EMPTY_STATE, PluginState
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.step import sample_context
from crossgrad_core.training.view_target import photo_camera

#: Views, or where they are more those of two steps, that are foreseen.
_VIEWS, _STEPS = 8, 2


class Prefetcher:
    """Lets the sampler draw ahead on copies of its random stream and its state.

    A guess, which only decides what is decoded first: a sampler that looks at the losses of the
    step before may draw other views then. Nothing that the run itself uses is touched.

    Args:
        setup: The run.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._draws: deque[tuple[int, ...]] = deque()
        self._step = 0
        self._rng = np.random.default_rng(0)
        self._state: PluginState = EMPTY_STATE
        self._blind = False

    def update(self, state: TrainState) -> None:
        """Names the photos of the steps after `state.step` to those who decode them."""
        setup = self._setup
        if self._blind or not setup.photos_ahead.useful:
            return
        try:
            self._follow(state)
            self._draw(state)
            views = [setup.train_views[index] for draw in self._draws for index in draw]
        except Exception:  # The step itself will say what is wrong.
            self._blind = True
            return
        scale = max(state.last.scales, default=1.0) if state.last is not None else 1.0
        small = setup.scaled_photos
        wanted = [v for v in views if not small.holds(v, photo_camera(setup, v, scale))]
        setup.photos_ahead.expect(wanted)

    def _follow(self, state: TrainState) -> None:
        """Forgets the step that was taken, and all others where it drew something else."""
        if self._draws and self._step - len(self._draws) == state.step - 1:
            drawn = self._draws.popleft()
            if state.last is not None and state.last.views == drawn:
                return
        elif self._draws and self._step - len(self._draws) == state.step:
            return
        self._draws.clear()
        self._step = state.step
        self._rng = deepcopy(state.rngs[STATE])
        self._state = state.states.get(STATE, EMPTY_STATE)

    def _draw(self, state: TrainState) -> None:
        setup = self._setup
        while self._step < setup.schedule.total and not self._enough():
            context = replace(
                sample_context(setup, state, self._step + 1),
                rng=self._rng,
                states={**state.states, STATE: self._state},
            )
            draw, self._state = setup.sampler.sample(context, self._state)
            self._draws.append(tuple(map(int, draw.views)))
            self._step += 1

    def _enough(self) -> bool:
        return len(self._draws) >= _STEPS and sum(map(len, self._draws)) >= _VIEWS
