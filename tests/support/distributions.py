"""Installed packages made up on the spot, for tests of what offers plugins."""

from collections.abc import Mapping
from pathlib import Path

import pytest


def write_distribution(
    folder: Path,
    name: str,
    plugins: Mapping[str, Mapping[str, str]],
    modules: Mapping[str, str] | None = None,
    version: str = "1.0",
    requires: str = "",
) -> None:
    """Writes a package into a folder as an installer would; put the folder on `sys.path` to see it.

    Args:
        folder: Where to, as if it were site-packages; made where it is missing.
        name: Name of the distribution.
        plugins: Slot -> plugin name -> `module:Class`.
        modules: Name of a module, such as `top` or `package/module` -> its source.
        version: Version of the distribution.
        requires: What it requires, such as `crossgrad>=0.1,<0.2`.
    """
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir(parents=True)
    required = f"Requires-Dist: {requires}\n" if requires else ""
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n{required}"
    )
    sections = [
        "\n".join([f"[crossgrad.{slot}]", *(f"{key} = {value}" for key, value in each.items())])
        for slot, each in plugins.items()
    ]
    (info / "entry_points.txt").write_text("\n\n".join(sections) + "\n")
    for module, source in (modules or {}).items():
        file = folder / f"{module}.py"
        file.parent.mkdir(exist_ok=True)
        file.write_text(source)


def installed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, plugins: Mapping[str, Mapping[str, str]]
) -> None:
    """Lets a package offer plugins for the rest of a test.

    Args:
        folder: Where to write it.
        monkeypatch: Takes it back.
        plugins: Slot -> plugin name -> `module:Class`, importable already.
    """
    write_distribution(folder, "made-up", plugins)
    monkeypatch.syspath_prepend(folder)
