"""Ray: a local cluster of two nodes, one of which is killed midway."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from support import fake_run

from crossgrad_core.commands import UserError
from crossgrad_plugins.sweep.engines import Work, engine

pytestmark = pytest.mark.slow
TWO_NODES = Path(fake_run.__file__).with_name("two_nodes.py")


def test_a_killed_node_loses_no_run(tmp_path):
    command = [sys.executable, str(TWO_NODES), str(tmp_path / "grid"), str(tmp_path / "out")]
    command += ["kill", sys.executable, fake_run.__file__]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    assert said["killed"] and said["nodes"] >= 2
    assert said["states"] == ["finished"] * 6
    # Its run is begun again, unless it ended at that very moment.
    assert 6 <= said["begins"] <= 8


def test_a_missing_ray_cluster_is_refused(tmp_path):
    with pytest.raises(UserError, match="answer"):
        next(engine("ray")(Work([], tmp_path, tmp_path, 1, options={"address": "127.0.0.1:1"})))
