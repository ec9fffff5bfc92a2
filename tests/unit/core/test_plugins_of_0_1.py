"""A plugin that was written for 0.1 gets one error: what has changed, where, and what to do."""

import sys

import pytest
from support.distributions import write_distribution

from crossgrad_core.cli.main import main
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import load

OPERATOR = '''
import numpy as np
from crossgrad_core.plugin import Operator

class Louder(Operator):
    """Counts the view with the larger loss more."""

    def transform(self, gramians, context, state, rng):
        return np.ones((len(gramians), 1, 2)), state
'''
GROUPING = '''
from crossgrad_core.plugin import Grouping

class Near(Grouping):
    """All views are near."""

    def label(self, scene, views, rng):
        return ("near",) * len(views)
'''
DENSIFIER = '''
from typing import ClassVar
from crossgrad_core.plugin import Densifier, NO_EDIT

class Still(Densifier):
    """Edits nothing."""

    blocks: ClassVar[frozenset[str]] = frozenset({"means"})

    def densify(self, context, state):
        return NO_EDIT, state
'''


@pytest.fixture
def offered(tmp_path, monkeypatch):
    """Installs one plugin of the text, under the name `old`, and answers with its file."""

    def put(slot, text, name):
        folder = tmp_path / slot
        write_distribution(folder, "old-plugins", {slot: {"old": f"made_up_old:{name}"}},
                           {"made_up_old": text})  # fmt: skip
        monkeypatch.syspath_prepend(folder)
        return folder / "made_up_old.py"

    yield put
    sys.modules.pop("made_up_old", None)


def line_of(file, text):
    lines = file.read_text().splitlines()
    return f"{file}:{1 + next(n for n, line in enumerate(lines) if text in line)}"


@pytest.mark.parametrize(
    ("slot", "text", "name", "line", "todo"),
    [
        ("operators", OPERATOR, "Louder", "def transform", "GramianOperator"),
        ("groupings", GROUPING, "Near", "def label", "fit(self, scene, rng, probe=None) -> Rule"),
        ("densifiers", DENSIFIER, "Still", "class Still", "`tensors`"),
    ],
)
def test_a_class_of_0_1_is_told_what_to_write_now(offered, slot, text, name, line, todo):
    file = offered(slot, text, name)
    with pytest.raises(UserError, match="old is written for an older crossgrad") as refused:
        load(slot, "old")
    assert line_of(file, line) in refused.value.where
    assert todo in refused.value.todo and "old-plugins" in refused.value.todo


@pytest.mark.parametrize(
    ("line", "todo"),
    [
        ("from crossgrad_core.plugin import NoEdit", "NO_EDIT is Edit()"),
        ("from crossgrad_core.plugin import Labelling", "Rule"),
        ("from crossgrad_core.plugin import ViewGradients", "SeparateGradients"),
        (
            "from crossgrad_core.contexts import ViewSample",
            "crossgrad_core.plugin, whose names stay",
        ),
        ("import crossgrad_core.optimizer.adam", "crossgrad_core.plugin, whose names stay"),
    ],
)
def test_an_import_of_0_1_is_told_where_the_name_is_now(offered, line, todo):
    file = offered("operators", f"{OPERATOR}\n{line}\n", "Louder")
    with pytest.raises(UserError, match="cannot be imported") as refused:
        load("operators", "old")
    assert line_of(file, line) in refused.value.where
    assert todo in refused.value.todo


def test_another_error_of_an_import_stays_what_it_is(offered):
    offered("operators", "import crossgrad_nowhere\n", "Louder")
    with pytest.raises(UserError, match="cannot be imported") as refused:
        load("operators", "old")
    assert "0.1" not in refused.value.todo


def test_the_command_shows_one_error_and_no_traceback(offered, tmp_path, capsys):
    offered("operators", OPERATOR, "Louder")
    with pytest.raises(SystemExit) as ended:
        main(["run", "--operator", "old", "--out", str(tmp_path / "run"), "--steps", "1"])
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert "error: operator old is written for an older crossgrad" in said
    assert "Traceback" not in said and not (tmp_path / "run").exists()
