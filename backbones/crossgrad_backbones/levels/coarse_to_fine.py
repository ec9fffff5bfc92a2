"""Which levels may be trained when: from coarse to fine (Octree-GS, progressive training)."""

from itertools import accumulate


def opening_steps(span: float, count: int, factor: float) -> tuple[float, ...]:
    """The steps at which `count` further levels open, the last one at `span`.

    The time between two openings shrinks by `factor` from one to the next: a geometric series with
    the first term span (1 - q) / (1 - q^count), q = 1 / factor.
    """
    q = 1.0 / factor
    terms = [q**i for i in range(count)]
    scale = span / sum(terms) if terms else 0.0
    return tuple(accumulate(scale * term for term in terms))


def allowed_top(step: int, openings: tuple[float, ...], initial: int) -> int:
    """The finest level that may be trained at a step."""
    return initial + sum(step >= opening for opening in openings)
