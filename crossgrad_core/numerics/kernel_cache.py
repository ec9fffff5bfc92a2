"""Disk cache of compiled kernels: the name of a file depends on all source files of its kernel.

A file contains one kernel for one signature: a SHA-256 checksum, then the key and the compiled
code. There is no common index file, which two processes could overwrite at the same time. A file is
written completely or not at all. A damaged file is ignored.
"""

import ast
import hashlib
import importlib.util
import logging
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, Protocol, cast

import llvmlite
import numba
from numba.core.caching import FunctionCache, NullCache
from numba.core.serialize import dumps
from typing_extensions import override

_DIGEST = 32
_FOLDERS = "numba_kernels"
_CORE = __name__.partition(".")[0]
_DUMPS = cast("Callable[[object], bytes]", dumps)
_LOG = logging.getLogger(__name__)
#: Log messages before and after the compilation of a kernel. `system/startup.py` reads these
#: messages.
_COMPILING, _COMPILED = "compiling %s", "compiled %s"


class Listener(Protocol):
    """A function that is called before a kernel is compiled."""

    def __call__(self, *, kept: bool) -> None:
        """Handle the event. `kept` is True if the compiled kernel will be stored on disk."""
        ...


_LISTENERS: list[Listener] = []


@contextmanager
def notes_on_missing(listener: Listener) -> Iterator[None]:
    """Inside the block, call the listener before each kernel that must be compiled."""
    _LISTENERS.append(listener)
    try:
        yield
    finally:
        _LISTENERS.remove(listener)


def cache_for(function: Callable[..., Any]) -> Any:  # noqa: ANN401 - Numba's caches are untyped
    """Return the cache of a kernel.

    The cache is on disk if a folder is writable; otherwise, nothing is cached.

    The folder is `NUMBA_CACHE_DIR` if this variable is set. If this variable is not set, the folder
    is `__pycache__` next to the kernel's file, or the user's cache folder.
    """
    try:
        return _DiskCache(function)
    except RuntimeError:  # Numba raises this error if no folder is writable.
        _tell_uncached(str(Path(function.__code__.co_filename).parent))
        return _NoCache(function)


@cache
def _tell_uncached(folder: str) -> None:
    """Warn that the kernels of a folder cannot be stored. Each folder causes only one warning."""
    _LOG.warning(
        "compiled kernels cannot be saved and are compiled again at every start: "
        "neither %s nor the user's cache folder is writable; set "
        "NUMBA_CACHE_DIR=FOLDER to use another folder",
        folder,
    )


def _name(function: Callable[..., Any]) -> str:
    return function.__qualname__.strip("_")


def _tell_compiling(name: str, *, kept: bool) -> None:
    _LOG.info(_COMPILING, name)
    for listener in _LISTENERS:
        listener(kept=kept)


class _NoCache(cast("Any", NullCache)):  # type: ignore[misc]
    """A replacement for the disk cache that stores nothing."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._name = _name(function)

    @override
    def load_overload(self, sig: object, target_context: object) -> None:
        """Return None, because nothing is stored."""
        _tell_compiling(self._name, kept=False)

    @override
    def save_overload(self, sig: object, cres: object) -> None:
        """Store nothing, but log that the kernel was compiled."""
        _LOG.info(_COMPILED, self._name)


class _DiskCache(cast("Any", FunctionCache)):  # type: ignore[misc]
    """Numba's function cache, but with the file format of this module."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._source = Path(function.__code__.co_filename)
        self._cache_file = _Files(Path(self._cache_path), self._impl.filename_base, self._source)

    @override
    def load_overload(self, sig: object, target_context: object) -> object | None:
        """Return the compiled function. Return None if the function must be compiled."""
        compiled = None
        # Ignore any error from a cache file, because the kernel can always be compiled.
        with suppress(Exception):
            compiled = super().load_overload(sig, target_context)
        if compiled is None:
            _tell_compiling(_name(self._py_func), kept=True)
        return cast("object | None", compiled)

    @override
    def save_overload(self, sig: object, data: object) -> None:
        """Store a compiled function on disk if possible."""
        _LOG.info(_COMPILED, _name(self._py_func))
        try:
            super().save_overload(sig, data)
        except OSError as error:
            # Saving can fail, for example if the disk is full. The compiled function can still be
            # used in this process.
            self.disable()
            _tell_unwritten(str(self._cache_path), str(error))

    @override
    def _index_key(self, sig: object, codegen: object) -> tuple[Any, ...]:
        versions = (numba.__version__, llvmlite.__version__)
        return (*super()._index_key(sig, codegen), versions, fingerprint(self._source))


@cache
def _tell_unwritten(folder: str, error: str) -> None:
    _LOG.warning("a compiled kernel could not be saved in %s: %s", folder, error)


class _Files:
    """The cache files of one kernel.

    Args:
        folder: Folder of the cache files.
        base: Prefix of the file names.
        source: Source file of the kernel.
    """

    def __init__(self, folder: Path, base: str, source: Path) -> None:
        self._folder = folder
        self._base = base
        self._source = source

    def load(self, key: object) -> object | None:
        """Return the data that is stored under the key; None without a valid file."""
        try:
            content = self._path(key).read_bytes()
        except OSError:
            return None
        digest, payload = content[:_DIGEST], content[_DIGEST:]
        if hashlib.sha256(payload).digest() != digest:
            return None
        stored, data = pickle.loads(payload)
        return cast("object", data) if stored == key else None

    def save(self, key: object, data: object) -> None:
        """Store data under the key.

        Delete files of the kernel that were compiled from older sources.
        """
        payload = _DUMPS((key, data))
        path = self._path(key)
        temporary = path.with_suffix(f".{os.getpid()}.tmp")
        try:
            temporary.write_bytes(hashlib.sha256(payload).digest() + payload)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
        self._drop_older()

    def flush(self) -> None:
        """Delete all cache files of the kernel."""
        for path in self._folder.glob(f"{self._base}.*"):
            path.unlink(missing_ok=True)

    @property
    def _generation(self) -> str:
        return f"{self._base}.{fingerprint(self._source)[:12]}"

    def _path(self, key: object) -> Path:
        digest = hashlib.sha256(repr(key).encode()).hexdigest()
        return self._folder / f"{self._generation}.{digest[:20]}.nbc"

    def _drop_older(self) -> None:
        for path in self._folder.glob(f"{self._base}.*"):
            if not path.name.startswith(self._generation) and path.suffix != ".tmp":
                # Another process may already have deleted the file, or may have the file open.
                with suppress(OSError):
                    path.unlink()


@cache
def fingerprint(source: Path) -> str:
    """Return the SHA-256 of all source files that may affect a kernel in `source`.

    Numba itself detects changes of the kernel's file, but not of files whose functions are inlined.
    The hash includes all files of the kernel's folder. The hash also includes all files that the
    files of this folder import from their own package or from the core. If an imported file is in a
    folder of kernels, its imports are included as well.
    """
    digest = hashlib.sha256()
    for path in sorted(_sources(source)):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _sources(source: Path) -> set[Path]:
    sources: set[Path] = set()
    waiting = set(source.parent.glob("*.py"))
    while waiting:
        path = waiting.pop()
        sources.add(path)
        if _FOLDERS in path.parts or path.parent == source.parent:
            waiting |= _imported(path) - sources
    return sources


@cache
def _imported(path: Path) -> frozenset[Path]:
    """Return the files that a file imports from its own package or from the core.

    The result is cached, because many kernel files import the same modules.
    """
    packages, files = {_CORE, _package_of(path)}, set[Path]()
    for node in ast.walk(ast.parse(path.read_bytes())):
        names = [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        for name in names:
            if name.partition(".")[0] in packages:
                files.update(_file_of(name))
    return frozenset(files)


def _package_of(path: Path) -> str:
    """Return the name of the top-level package that contains a file."""
    folder = path.parent
    while (folder.parent / "__init__.py").is_file():
        folder = folder.parent
    return folder.name


def _file_of(name: str) -> Iterator[Path]:
    spec = importlib.util.find_spec(name)
    if spec is not None and spec.origin is not None and spec.origin.endswith(".py"):
        yield Path(spec.origin)
