"""A disk that is full or read-only: one message, nothing damaged, and the run goes on later."""

import random
import shutil
import subprocess
import sys

import pytest
from crossgrad_faults import laws

WORDS = {"full": "not enough disk space", "readonly": "cannot write to this path"}


@pytest.mark.parametrize("what", WORDS)
def test_a_run_survives_if_every_write_fails_after_a_random_one(
    reference, thorough, tmp_path, what
):
    writes = range(1, reference.writes + 1)
    for at in random.Random(3).sample(writes, min(thorough, len(writes))):
        folder = tmp_path / str(at)
        fault = {"below": str(folder), "at": at, "what": what}
        end = reference.nursery.run(*reference.command(folder), fault=fault)
        assert "Traceback" not in end.said, end.said
        if end.code != 0:
            assert WORDS[what] in end.said, end.said
        reference.recovers(folder)


@pytest.mark.skipif(sys.platform != "linux", reason="tmpfs")
def test_a_run_survives_a_small_file_system_that_fills_up(reference, tmp_path):
    place = tmp_path / "small"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=96m", "tmpfs", str(place)]
    if not shutil.which("mount") or subprocess.run(mount, check=False).returncode:
        pytest.skip("file systems cannot be mounted here")
    try:
        _fill(place, leave=400_000)
        end = reference.nursery.run(*reference.command(place / "run"))
        assert end.code != 0
        assert WORDS["full"] in end.said
        (place / "ballast").unlink()
        if (place / "run").is_dir():
            laws.parses(place / "run")
        reference.recovers(place / "run")
    finally:
        subprocess.run(["umount", str(place)], check=True)


def _fill(place, leave):
    free = shutil.disk_usage(place).free - leave
    (place / "ballast").write_bytes(bytes(free))
