"""Configurations of older versions, as this version has them.

A file says by its key `crossgrad` which version wrote it; up to 0.1 there was no such key.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from crossgrad_core.defaults import BARE_START, METRICS_OF_0_1, NO_EXPOSURE, RESOLUTION
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import load
from crossgrad_core.system.version import VERSION

#: The key that says which version wrote a configuration, and the version of this one.
KEY: Final = "crossgrad"
CURRENT: Final = ".".join(VERSION.split(".")[:2])
#: The key of what is written down beside the settings.
NOTES: Final = "notes"
#: What wrote files without the key.
_FIRST: Final = "0.1"
_KNOWN: Final = (_FIRST, CURRENT)
#: Granularities of 0.1 -> those of 0.2.
_GRANULARITIES: Final = {"tensor": "block", "group": "kind"}


def marked(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings with the version that writes them."""
    return {KEY: CURRENT, **settings}


def migrated(settings: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The settings of a file as this version has them, without version and notes.

    Args:
        settings: What a file holds, choices of components in their long form.
        path: The file.

    Raises:
        UserError: A version wrote it that is newer than this one, or none that there ever was.
    """
    version = str(settings.get(KEY, _FIRST))
    if version not in _KNOWN:
        raise UserError(
            "the configuration is of another version of crossgrad",
            where=f"{path}, {KEY}",
            expected=f"one of {', '.join(_KNOWN)}",
            found=version,
            todo=f"install crossgrad {version}, or remove the line if the file is of this version",
        )
    rest = {name: value for name, value in settings.items() if name not in {KEY, NOTES}}
    if version == _FIRST and "operator" in rest:
        rest["operator"] = _operators(rest["operator"])
    if version == _FIRST and "reading" in rest:
        rest["reading"] = _reading(rest["reading"], rest.get("scene"))
    if "revisions" in rest:
        # What a run wrote goes on, and is repeated, in its units, at its rates, with its columns,
        # and ends as it did.
        rest.setdefault("events", "steps")
        rest.setdefault("rate_factor", 1.0)
        rest.setdefault("beta1", 0.9)
        rest.setdefault("beta2", 0.999)
        rest.setdefault("position_lr", "extent")
        rest.setdefault("sh_start", 0.0)
        rest.setdefault("max_scale_ratio", 0.0)
        rest.setdefault("lr_tail", 0.0)
        rest.setdefault("growth", "free")
        rest.setdefault("dropout", 0.0)
        rest.setdefault("floaters", "keep")
        rest.setdefault("exposure", {"name": NO_EXPOSURE})
        rest.setdefault("start", {"name": BARE_START})
        rest.setdefault("resolution", {"name": RESOLUTION})
        rest.setdefault("metrics", [{"name": name} for name in METRICS_OF_0_1.split("+")])
    return rest


def _reading(value: object, scene: object) -> object:
    """How 0.1 read a scene: what it called `auto` held out each n-th photo wherever no list did."""
    if not isinstance(value, dict) or value.get("split") != "auto" or not isinstance(scene, str):
        return value
    from crossgrad_core.scene.split import has_lists  # Imports torch, which only this needs.

    return value if has_lists(Path(scene)) else {**value, "split": "every"}


def _operators(value: object) -> object:
    """Operators of 0.1, wherever they stand: alone, as links of a chain, as rules of blocks."""
    if isinstance(value, list):
        return [_operators(each) for each in value]
    if not isinstance(value, dict):
        return value
    inner = {name: _operators(each) for name, each in value.items()}
    return _with_granularity(inner) if "granularity" in inner else inner


def _with_granularity(operator: dict[str, Any]) -> dict[str, Any]:
    """The operator with what its granularity is called now; without one where it has none now.

    In 0.1 all operators had one, and it did nothing where there are no Gramians.
    """
    old = operator["granularity"]
    if _has_no_granularity(str(operator.get("name"))):
        return {name: option for name, option in operator.items() if name != "granularity"}
    return {**operator, "granularity": _GRANULARITIES.get(old, old)}


def _has_no_granularity(name: str) -> bool:
    try:
        return "granularity" not in load("operators", name).model_fields
    except UserError:  # Building the operator raises the error that explains it.
        return False
