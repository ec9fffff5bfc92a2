"""Beside --resume the user's own words are named, and each message has a way out."""

from pathlib import Path

import pytest

from crossgrad_core.cli.main import main
from crossgrad_core.cli.run import CHANGEABLE, refuse_beside_resume
from crossgrad_core.errors import UserError
from crossgrad_core.run.load_run import CHANGEABLE as OF_A_RUN
from crossgrad_core.run.load_run import _config


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["a scene"], "SCENE"),
        (["--max-size", "100"], "--max-size"),
        (["--observe", "diagnostics"], "--observe"),
        (["--operator", "sum", "--steps", "5"], "--operator, --steps"),
        (["--set", "operator.c=0.4", "--set", "device=cpu"], "--set operator.c"),
        (["--config", "run.yaml"], "--config"),
        (["--out", "other"], "--out"),
        (["--dry-run"], "--dry-run"),
    ],
    ids=lambda words: words[0] if isinstance(words, list) else "",
)
def test_options_that_a_resumed_run_ignores_are_named_as_the_user_typed_them(
    arguments, named, capsys
):
    with pytest.raises(SystemExit, match="2"):
        main(["run", *arguments, "--resume", "runs/one", "-q"])
    rows = dict(line.split(":", 1) for line in capsys.readouterr().err.splitlines())
    assert rows["error"].strip() == "settings and the scene cannot be changed when a run is resumed"
    assert rows["  where"].strip() == named
    assert "continue runs/one" in rows["  to do"] and "--resume out" in rows["  to do"]


def test_settings_that_may_change_on_resume_are_accepted():
    given = dict.fromkeys(("scene", "config", "steps")) | {"assignments": ["threads=2"]}
    given |= {"device": "cpu", "threads": 2, "stop_after": 9, "quiet": True, "dry_run": False}
    refuse_beside_resume(Path("run"), given)
    assert CHANGEABLE == OF_A_RUN


def test_ignored_settings_of_the_python_api_are_named_as_settings(tmp_path):
    with pytest.raises(UserError) as raised:
        _config(tmp_path, {"scene": "x", "views": 2, "device": "cpu"})
    assert raised.value.where == "settings scene, views"
