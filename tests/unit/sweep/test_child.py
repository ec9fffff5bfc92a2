"""The process of a run, before it trains."""

import os
import subprocess
import sys

import pytest

from crossgrad_plugins.sweep import child

#: Becomes as nice as asked, in a session of its own, and prints how nice the session is.
NICE = """
import os
os.nice(5)
from crossgrad_plugins.sweep import child
child._be_as_nice_as_asked()
print(child._SESSION_NICENESS.read_text())
"""


@pytest.mark.skipif(not child._SESSION_NICENESS.exists(), reason="no automatic groups of sessions")
def test_the_session_of_a_run_has_the_niceness_of_the_sweep():
    done = subprocess.run(
        [sys.executable, "-c", NICE],
        start_new_session=True,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    # The tests themselves may be carried out with less priority.
    assert done.stdout.split()[-2:] == ["nice", str(min(19, os.nice(0) + 5))]


@pytest.mark.parametrize(("niceness", "said"), [(0, []), (7, ["7"])])
def test_the_session_niceness_is_written_only_if_nonzero(monkeypatch, tmp_path, niceness, said):
    place = tmp_path / "autogroup"
    monkeypatch.setattr(child, "_SESSION_NICENESS", place)
    monkeypatch.setattr(child.os, "nice", lambda _: niceness)
    child._be_as_nice_as_asked()
    assert [each.read_text() for each in tmp_path.iterdir()] == said


def test_a_system_without_session_niceness_is_supported(monkeypatch, tmp_path):
    monkeypatch.setattr(child, "_SESSION_NICENESS", tmp_path / "missing" / "autogroup")
    monkeypatch.setattr(child.os, "nice", lambda _: 7)
    child._be_as_nice_as_asked()
    assert list(tmp_path.iterdir()) == []
