import subprocess
import sys

import pytest

PROGRAM = """
import os, signal, sys
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap

signal.signal(signal.SIGTERM, lambda *_: print("handled"))
guard_pycolmap()
guard_pycolmap()
assert "pycolmap" in sys.modules
os.kill(os.getpid(), signal.SIGTERM)
from PIL import Image
Image.effect_noise((64, 64), 50).save(sys.argv[1])
print("saved")
"""


@pytest.mark.slow
def test_importing_pycolmap_changes_neither_signals_nor_png_files(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path / "a.png")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stdout.split(), done.stderr) == (0, ["handled", "saved"], "")
