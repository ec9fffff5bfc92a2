"""Test inputs for operators: K gradients that are periodic, or short enough for exact sums."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Rows = NDArray[np.float64]
#: `LARGE`: number of elements of the largest cases. `EXACT`: number of elements of the largest case
#: that is not periodic.
LARGE = 10_000_000
EXACT = 10_000


@dataclass(frozen=True, eq=False)
class Case:
    """K gradients with H + R * Q elements.

    A gradient starts with a head of H elements, followed by R copies of a pattern of Q elements.

    A Gramian is a sum over elements. Gramians can therefore be computed exactly even for large R.

    Attributes:
        name: Name of the case in the table.
        head: [K, H] float64 values of the head.
        pattern: [K, Q] float64 values of the pattern.
        copies: Number of copies R.
        dtype: Type of the gradients. The head and the pattern are rounded to this type.
        absent: Indices of the views that do not touch the block.
    """

    name: str
    head: Rows
    pattern: Rows
    copies: int = 0
    dtype: torch.dtype = torch.float32
    absent: frozenset[int] = frozenset()

    @property
    def views(self) -> int:
        """The number of views K."""
        return len(self.head)

    @property
    def size(self) -> int:
        """The number of elements P."""
        return int(self.head.shape[1] + self.copies * self.pattern.shape[1])

    @cached_property
    def exact_head(self) -> Rows:
        """[K, H] values of the head that the operator receives.

        The values are rounded, and zero for absent views.
        """
        return self._rounded(self.head)

    @cached_property
    def exact_pattern(self) -> Rows:
        """[K, Q] values of the pattern that the operator receives.

        The values are rounded, and zero for absent views.
        """
        return self._rounded(self.pattern)

    def gradients(self) -> list[Tensor | None]:
        """Return the K gradients as new tensors; None for absent views."""
        head = torch.from_numpy(self.exact_head).to(self.dtype)
        pattern = torch.from_numpy(self.exact_pattern).to(self.dtype)
        return [
            None if k in self.absent else torch.cat([head[k], pattern[k].repeat(self.copies)])
            for k in range(self.views)
        ]

    def _rounded(self, rows: Rows) -> Rows:
        rounded = torch.from_numpy(rows).to(self.dtype).double().numpy().copy()
        rounded[sorted(self.absent)] = 0.0
        return rounded


def short(
    name: str,
    rows: object,
    dtype: torch.dtype = torch.float32,
    absent: frozenset[int] = frozenset(),
) -> Case:
    """Return a case that is not periodic. The argument `rows` is [K, P]."""
    head = np.asarray(rows, np.float64)
    return Case(name, head, np.zeros((len(head), 0)), 0, dtype, absent)


def cases(large: int = LARGE, exact: int = EXACT) -> list[Case]:
    """Return all test cases.

    Periodic cases have up to `large` elements. Other cases have up to `exact` elements.
    """
    return [
        *_ordinary(exact),
        *_ratios(),
        *_angles(),
        *_opposed(),
        *_missing(),
        *_dependent(),
        *_magnitudes(),
        *_not_finite(),
        *_many_views(),
        *_types(),
        *_long(large),
    ]


def _rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def _ordinary(exact: int) -> Iterator[Case]:
    yield short("plain", _rng(0).standard_normal((2, 64)))
    yield short("conflict", [[1.0, 0.25, 0.5], [-0.75, 1.0, 0.125]])
    yield short("P = 0", np.zeros((2, 0)))
    yield short("P = 1", [[1.5], [-0.5]])
    yield short(f"P = {exact}", _rng(1).standard_normal((2, exact)))
    yield short("disjoint", [[1.0, 2.0, 0.0, 0.0], [0.0, 0.0, 3.0, 1.0]])


def _ratios() -> Iterator[Case]:
    """Yield cases with a cosine of -1/2 and very different gradient norms."""
    for power in (3, 6, 12, 20, 30):
        yield short(f"ratio 1e{power}", _at_cosine(-0.5, 1.0, 10.0**-power))
    yield short("ratio 1e30 up", _at_cosine(-0.5, 1e-15, 1e15))
    rows = _rng(2).standard_normal((3, 8))
    yield short("ratios 1e12, K = 3", rows * np.array([[1e6], [1.0], [1e-6]]))
    rows = _rng(3).standard_normal((4, 8))
    yield short("ratios 1e30, K = 4", rows * np.array([[1e15], [1e5], [1e-5], [1e-15]]))


def _at_cosine(cosine: float, first: float, second: float) -> Rows:
    along = np.array([1.0, 0.0, 0.0])
    turned = np.array([cosine, np.sqrt(1 - cosine**2), 0.0])
    return np.stack([first * along, second * turned])


def _angles() -> Iterator[Case]:
    """Yield cases with cosines close to -1 and +1. Here eps is the sine of the angle."""
    for eps in (1e-2, 1e-4, 1e-5):
        yield short(f"cos -1 + {eps**2 / 2:.0e}", [[1.0, 0.0], [-1.0, eps]])
        yield short(f"cos 1 - {eps**2 / 2:.0e}", [[1.0, 0.0], [1.0, eps]])
    yield short("cos -1 + 1e-16", [[1.0, 0.0], [-1.0, 1.4e-8]])
    yield short("cos 1 - 1e-16", [[1.0, 0.0], [1.0, 1.4e-8]])
    yield short("cos -1 + 5e-9, ratio 1e6", [[1e6, 0.0], [-1.0, 1e-4]])


def _opposed() -> Iterator[Case]:
    g = _rng(4).standard_normal(32).astype(np.float32).astype(np.float64)
    yield short("opposite", [g, -g])
    yield short("opposite 2 : 1", [2 * g, -g])
    thrice = (3 * g).astype(np.float32)
    yield short("opposite 3 : 1", [thrice, -thrice / 3])
    yield short("opposite 1e12 : 1", [g * 2.0**40, -g])
    yield short("opposite pair, K = 3", [g, -g, np.roll(g, 1)])
    corners = [[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]
    yield short("simplex, K = 4", corners)


def _missing() -> Iterator[Case]:
    g = _rng(5).standard_normal((3, 16))
    yield short("zero row", g[:2] * [[1.0], [0.0]])
    yield short("all zero", np.zeros((2, 16)))
    yield short("absent view", g[:2], absent=frozenset({1}))
    yield short("zero row, K = 3", g * [[1.0], [0.0], [1.0]])


def _dependent() -> Iterator[Case]:
    g = _rng(6).standard_normal((4, 16))
    yield short("duplicate", [g[0], g[0]])
    yield short("duplicate, K = 3", [g[0], g[0], g[1]])
    yield short("doubled, K = 3", [g[0], 2 * g[0], g[1]])
    yield short("rank 2, K = 4", _rng(7).integers(-4, 5, (4, 2)))
    yield short("rank 3, K = 8", _rng(8).integers(-4, 5, (8, 3)))


def _magnitudes() -> Iterator[Case]:
    g = _rng(9).standard_normal((2, 24))
    yield short("entries 1e-30", g * 1e-30)
    yield short("entries 1e+30", g * 1e30)
    yield short("subnormal", g * 1e-41)
    yield short("mixed 1e-30 to 1e+30", g * 10.0 ** np.linspace(-30, 30, 24))
    yield short("subnormal, 1e+30", np.stack([g[0] * 1e-41, g[1] * 1e30]))


def _not_finite() -> Iterator[Case]:
    g = _rng(10).standard_normal((3, 16))
    nan, inf = g.copy(), g.copy()
    nan[1, 3] = np.nan
    inf[0, 5] = np.inf
    yield short("NaN in one view", nan)
    yield short("infinity in one view", inf[:2])
    yield short("all views NaN", np.full((2, 4), np.nan))


def _many_views() -> Iterator[Case]:
    for views in (1, 3, 4, 5, 8, 12, 16):
        yield short(f"K = {views}", _rng(20 + views).standard_normal((views, 40)))
    # The cosines of all pairs are about -0.04, so that each view conflicts with all other views.
    rows = _centred(_rng(40).standard_normal((16, 60)))
    yield short("K = 16, all conflict", rows)
    rows = _rng(41).standard_normal((8, 40)) * 10.0 ** np.linspace(0, 12, 8)[:, None]
    yield short("K = 8, ratios 1e12", rows)


def _centred(rows: NDArray[np.float64]) -> Rows:
    centred: Rows = rows - 0.8 * rows.mean(axis=0)
    return centred


def _types() -> Iterator[Case]:
    g = _rng(50).standard_normal((3, 64))
    yield short("bfloat16", g, torch.bfloat16)
    yield short("float16", g, torch.float16)
    yield short("float16 subnormal", g * 1e-6, torch.float16)
    yield short("float64", g, torch.float64)
    yield short("float64 1e200", g * [[1e200], [1e190], [1e200]], torch.float64)


def _long(large: int) -> Iterator[Case]:
    pattern = _rng(60).standard_normal((2, 1000)) + np.array([[0.3], [-0.3]])
    empty = np.zeros((2, 0))
    yield Case(f"P = {large:.0e}", empty, pattern, large // 1000)
    head = np.array([[1e4, 0.0], [0.0, -1e4]])
    yield Case(f"one of {large:.0e} dominates", head, pattern, large // 1000)
    four = _rng(61).standard_normal((4, 1000))
    yield Case(f"P = {large:.0e}, K = 4", np.zeros((4, 0)), four, large // 1000)
