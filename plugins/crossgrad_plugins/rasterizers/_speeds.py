"""The speed of each rasterizer on a device, for lists that do not import the rasterizers.

These functions are the entry points of the group `crossgrad.rasterizers.speed`. `Rasterizer.speed`
defines the scale.
"""

from typing import Final

#: The module of gswarp, and the module of the package that gswarp requires.
GSWARP_PACKAGES: Final = ("gswarp", "warp")


def gsplat(device: str) -> float:
    """Return the speed of gsplat; 0 if its package or a compiler is missing."""
    return 100.0 if device == "cuda" and not gsplat_missing() else 0.0


def gswarp(device: str) -> float:
    """Return the speed of gswarp; 0 if a package is missing."""
    return 80.0 if device == "cuda" and not gswarp_missing() else 0.0


def numba(device: str) -> float:
    """Return the speed of the compiled kernels."""
    return 10.0 if device == "cpu" else 0.0


def torch(device: str) -> float:
    """Return the speed of the reference rasterizer."""
    return 1.0 if device in {"cpu", "cuda"} else 0.0


def gsplat_missing() -> str:
    """Return what gsplat lacks and how to install it; empty if nothing is missing."""
    from crossgrad_plugins.rasterizers.gpu.missing import compiler_missing, package_missing

    return package_missing("gsplat") or compiler_missing("gsplat") or ""


def gswarp_missing() -> str:
    """Return what gswarp lacks and how to install it; empty if nothing is missing."""
    from crossgrad_plugins.rasterizers.gpu.missing import package_missing

    return package_missing(*GSWARP_PACKAGES) or ""
