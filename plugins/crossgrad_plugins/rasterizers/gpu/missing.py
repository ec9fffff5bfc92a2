"""Packages and compilers that a rasterizer lacks on this machine, and the way out."""

import os
import re
import shutil
import subprocess
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import torch


def package_missing(package: str, *others: str) -> str | None:
    """Why a rasterizer cannot run without its package and others; None where all are installed."""
    lacks = next((name for name in (package, *others) if find_spec(name) is None), None)
    if lacks is None:
        return None
    return (
        f"rasterizer {package} needs the package {lacks}, which is not installed: "
        f"pip install 'crossgrad[{package}]', or leave --rasterizer out"
    )


def compiler_missing(package: str) -> str | None:
    """Why a package cannot compile its kernels at first use; None where it can, or has them."""
    if is_compiled(package):
        return None
    nvcc, wanted = find_nvcc(), torch.version.cuda
    if nvcc is None:
        return (
            f"rasterizer {package} compiles its kernels when it is first used, and there is no "
            f"nvcc: install the CUDA toolkit {wanted or ''} and set CUDA_HOME, or choose "
            "--rasterizer gswarp, which needs a driver only"
        )
    if shutil.which(os.environ.get("CXX", "c++")) is None:
        return f"rasterizer {package} compiles its kernels and finds no C++ compiler: install g++"
    found = nvcc_version(nvcc)
    if found is not None and wanted is not None and found.split(".")[0] != wanted.split(".")[0]:
        return (
            f"rasterizer {package} cannot compile its kernels: nvcc ({nvcc}) is of CUDA {found}, "
            f"torch {torch.__version__} was built for CUDA {wanted}; install the toolkit of that "
            "version and set CUDA_HOME, or the torch that was built for this one"
        )
    return None


def is_compiled(package: str) -> bool:
    """Whether a package was installed with its kernels compiled; does not import it."""
    spec = find_spec(package)
    places = [] if spec is None else spec.submodule_search_locations or []
    return any(path for place in places for path in Path(place).glob("csrc.*"))


def find_nvcc() -> Path | None:
    """The CUDA compiler that torch would take."""
    homes = [os.environ.get("CUDA_HOME"), os.environ.get("CUDA_PATH")]
    given = [Path(home) / "bin" / "nvcc" for home in homes if home]
    on_path = shutil.which("nvcc")
    usual = [Path(on_path)] if on_path else [Path("/usr/local/cuda/bin/nvcc")]
    return next((nvcc for nvcc in (*given, *usual) if nvcc.is_file()), None)


@cache
def nvcc_version(nvcc: Path) -> str | None:
    """The CUDA version of a compiler, such as 12.4; None where it does not say."""
    try:
        told = subprocess.run([nvcc, "--version"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    found = re.search(r"release (\d+\.\d+)", told.stdout)
    return found and found.group(1)
