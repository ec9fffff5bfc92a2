"""Dot products of a few float32 rows in float64; each row is read only once.

Within a call, the compiler may reorder sums to use vector registers. Products of float32 numbers
are exact in float64. Squares of float32 numbers are 0 or lie between 1e-90 and 1e77, so that a
float64 sum of them neither underflows nor overflows.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import sum_device

Row = NDArray[np.float32]
Out = NDArray[np.float64]


@sum_device
def dots_1(a: Row, out: Out) -> None:
    """Compute the upper triangle of the Gramian of one row."""
    aa = 0.0
    for i in range(a.size):
        x = np.float64(a[i])
        aa += x * x
    out[0, 0] = aa


@sum_device
def dots_2(a: Row, b: Row, out: Out) -> None:
    """Compute the upper triangle of the Gramian of two rows."""
    aa = ab = bb = 0.0
    for i in range(a.size):
        x, y = np.float64(a[i]), np.float64(b[i])
        aa += x * x
        ab += x * y
        bb += y * y
    out[0, 0], out[0, 1], out[1, 1] = aa, ab, bb


@sum_device
def dots_3(a: Row, b: Row, c: Row, out: Out) -> None:
    """Compute the upper triangle of the Gramian of three rows."""
    aa = ab = ac = bb = bc = cc = 0.0
    for i in range(a.size):
        x, y, z = np.float64(a[i]), np.float64(b[i]), np.float64(c[i])
        aa += x * x
        ab += x * y
        ac += x * z
        bb += y * y
        bc += y * z
        cc += z * z
    out[0, 0], out[0, 1], out[0, 2] = aa, ab, ac
    out[1, 1], out[1, 2], out[2, 2] = bb, bc, cc


@sum_device
def dots_4(a: Row, b: Row, c: Row, d: Row, out: Out) -> None:
    """Compute the upper triangle of the Gramian of four rows."""
    aa = ab = ac = ad = bb = bc = bd = cc = cd = dd = 0.0
    for i in range(a.size):
        x, y, z, w = np.float64(a[i]), np.float64(b[i]), np.float64(c[i]), np.float64(d[i])
        aa += x * x
        ab += x * y
        ac += x * z
        ad += x * w
        bb += y * y
        bc += y * z
        bd += y * w
        cc += z * z
        cd += z * w
        dd += w * w
    out[0, 0], out[0, 1], out[0, 2], out[0, 3] = aa, ab, ac, ad
    out[1, 1], out[1, 2], out[1, 3] = bb, bc, bd
    out[2, 2], out[2, 3], out[3, 3] = cc, cd, dd


@sum_device
def dots_2x2(a: Row, b: Row, c: Row, d: Row, out: Out) -> None:
    """Compute the four dot products of row a or b with row c or d."""
    ac = ad = bc = bd = 0.0
    for i in range(a.size):
        x, y, z, w = np.float64(a[i]), np.float64(b[i]), np.float64(c[i]), np.float64(d[i])
        ac += x * z
        ad += x * w
        bc += y * z
        bd += y * w
    out[0, 0], out[0, 1], out[1, 0], out[1, 1] = ac, ad, bc, bd
