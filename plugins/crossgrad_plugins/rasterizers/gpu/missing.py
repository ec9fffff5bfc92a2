"""Packages and compilers that a rasterizer needs but does not find, and how to install them."""

import os
import re
import shutil
import subprocess
import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import torch


def package_missing(package: str, *others: str) -> str | None:
    """Return why a rasterizer cannot run because a package is missing, or None."""
    lacks = next((name for name in (package, *others) if find_spec(name) is None), None)
    if lacks is None:
        return None
    return (
        f"rasterizer {package} needs the package {lacks}, which is not installed: "
        f"pip install 'crossgrad[{package}]'"
    )


def compiler_missing(package: str) -> str | None:
    """Return why a package cannot compile its kernels when they are first used.

    The result is None if the package can compile its kernels, or if they are already compiled.
    """
    if is_compiled(package):
        return None
    nvcc, wanted = find_nvcc(), torch.version.cuda
    if nvcc is None:
        home = _cuda_home()
        return (
            f"rasterizer {package} compiles its kernels at first use, and nvcc was not "
            f"found{(f' in {home}, where CUDA_HOME or CUDA_PATH points' if home else '')}: "
            f"install the CUDA toolkit {wanted or ''} and set CUDA_HOME, or choose "
            "--rasterizer gswarp, which needs only a driver"
        )
    if shutil.which("ninja") is None and not _own_ninja().is_file():
        return (
            f"rasterizer {package} compiles its kernels, and ninja was not found: pip install ninja"
        )
    if shutil.which(os.environ.get("CXX", "c++")) is None:
        return (
            f"rasterizer {package} compiles its kernels, and no C++ compiler was found: install g++"
        )
    version = nvcc_version(nvcc)
    if version is not None and wanted is not None and version.split(".")[0] != wanted.split(".")[0]:
        return (
            f"rasterizer {package} cannot compile its kernels: nvcc ({nvcc}) belongs to "
            f"CUDA {version}, but torch {torch.__version__} was built for CUDA {wanted}; "
            "install the toolkit of that version and set CUDA_HOME, or install a torch "
            f"that was built for CUDA {version}"
        )
    return None


def is_compiled(package: str) -> bool:
    """Return True if a package is installed with compiled kernels; it is not imported."""
    spec = find_spec(package)
    folders = [] if spec is None else spec.submodule_search_locations or []
    return any(path for folder in folders for path in Path(folder).glob("csrc.*"))


@cache
def bring_ninja() -> None:
    """Add ninja from this Python's environment to PATH, so that torch finds it."""
    if shutil.which("ninja") is None:
        folders = [os.environ.get("PATH", ""), str(_own_ninja().parent)]
        os.environ["PATH"] = os.pathsep.join(filter(None, folders))


def _own_ninja() -> Path:
    """Return the path of ninja in this Python's environment."""
    return Path(sys.executable).parent / "ninja"


def find_nvcc() -> Path | None:
    """Return the CUDA compiler that torch would use."""
    if home := _cuda_home():
        nvcc = Path(home) / "bin" / "nvcc"
    else:
        nvcc = Path(shutil.which("nvcc") or "/usr/local/cuda/bin/nvcc")
    return nvcc if nvcc.is_file() else None


def _cuda_home() -> str:
    """Return the only folder in which torch searches for the compiler; empty if not set."""
    return os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH") or ""


@cache
def nvcc_version(nvcc: Path) -> str | None:
    """Return the CUDA version of a compiler, such as 12.4; None if unknown."""
    try:
        completed = subprocess.run([nvcc, "--version"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    match = re.search(r"release (\d+\.\d+)", completed.stdout)
    return match and match.group(1)
