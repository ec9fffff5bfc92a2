"""Runs in the kernel of a notebook: the page on Python, and a run that is interrupted."""

import re
from pathlib import Path

import pytest
from support.notebook import errors, executed, shown
from support.same_bits import bits
from support.scenes import write_tiny_scene

PAGE = Path(__file__).parents[2] / "docs" / "python.md"
#: Long enough to be interrupted on the way.
STEPS = 120
RUN = f"""
import crossgrad_core as cg
run = cg.run("SCENE", out="run", steps={STEPS}, eval_every={STEPS}, save_every={STEPS})
"""
SAME = f"""
import crossgrad_core as cg
cg.run("SCENE", out="same", steps={STEPS}, eval_every={STEPS}, save_every={STEPS}, quiet=True)
"""


@pytest.fixture
def folder(tmp_path):
    write_tiny_scene(tmp_path / "SCENE", views=9)
    return tmp_path


@pytest.mark.slow
def test_the_code_on_the_python_page_runs_in_a_notebook(folder):
    blocks = re.findall(
        r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
    assert len(blocks) > 5
    notebook = executed(blocks, folder)
    assert errors(notebook) == []
    assert "\r" in shown(notebook.cells[0], "stderr")  # The bar goes back to the start of its line.
    assert re.search(r"\d+%\|.*\d/\d", shown(notebook.cells[0], "stderr"))
    assert not any(shown(cell, "stderr") for cell in notebook.cells[1:7])
    assert (folder / "first.ply").stat().st_size > 1000


@pytest.mark.slow
def test_an_interrupted_cell_stops_its_run_and_resuming_gives_the_same_bits(folder):
    log = folder / "run" / "log.txt"
    stopped = executed([RUN], folder, lambda: log.is_file() and "step 24/" in log.read_text())
    (error,) = errors(stopped)
    assert error.startswith("KeyboardInterrupt: the run is stopped")
    assert "stopping: the current state is saved" in shown(stopped.cells[0], "stderr")
    resume = 'import crossgrad_core as cg\nprint(cg.open("run").summary["step"])\n'
    resume += 'print(cg.resume("run").summary["status"])'
    notebook = executed([resume, SAME], folder)
    assert errors(notebook) == []
    step, status = shown(notebook.cells[0], "stdout").split()
    assert 24 <= int(step) < STEPS and status == "finished"
    assert bits(folder / "run", {str(STEPS)}) == bits(folder / "same")
