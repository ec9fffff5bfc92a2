"""plan.json: what a planner decided for a run, kept for those who go on with it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from crossgrad_core.system.files import text_bytes, write_atomically
from crossgrad_core.system.text_files import read_json

if TYPE_CHECKING:
    from crossgrad_core.contract.state import Json

FILE = "plan.json"


def write_plan(folder: Path, plan: "Mapping[str, Json] | None") -> None:
    """Writes plan.json, where there is a plan.

    Raises:
        UserError: The disk is full.
    """
    if plan is not None:
        text = json.dumps(dict(plan), indent=2, ensure_ascii=False)
        write_atomically(folder / FILE, text_bytes(f"{text}\n"))


def read_plan(folder: Path) -> "Mapping[str, Json] | None":
    """The plan of a run; None where there is none, or where the file is damaged."""
    path = folder / FILE
    if not path.is_file():
        return None
    try:
        content = read_json(path)
    except ValueError:
        return None
    return content if isinstance(content, dict) else None
