"""A sweep that is killed loses and repeats nothing; its bits are those of an undisturbed one."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from crossgrad_faults import laws
from support.commands import ended
from support.scenes import write_tiny_scene

import crossgrad_core
from crossgrad_core.commands import write_settings
from crossgrad_plugins.sweep.app import Request, Sweep
from crossgrad_plugins.sweep.run_status import read_records

#: 60 steps with edits, checkpoints and evaluations.
BASE = {
    "steps": 60,
    "schedule_unit": "steps",
    "densify_from": 10,
    "densify_every": 10,
    "densify_until": 55,
    "save_every": 9,
    "eval_every": 20,
}
#: Kills in the short version and in the long one, and seeds of four configurations in it.
SHORT, LONG, SEEDS = 2, 20, 6
#: Seconds that a run is taken to need to its first checkpoint, at most.
SLOWEST = 20.0

#: A cluster of two nodes, one of which is killed midway.
TWO_NODES = Path(__file__).parents[1] / "support" / "two_nodes.py"


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    """24 short runs; 2 in the short version."""
    folder = tmp_path_factory.mktemp("sweep")
    write_tiny_scene(folder / "tiny", views=6, suffix=".jpg")
    content = {"scenes": ["tiny"], "base": BASE, "seeds": list(range(SEEDS))}
    content["parameters"] = {
        "sampler": {"values": ["epoch", "random"]},
        "backbone": {"values": ["vanilla", "mip"]},
    }
    if "FAULTS" not in os.environ:
        content |= {"seeds": [0, 1], "parameters": {}}
    path = folder / "grid.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def start(grid, out, *more):
    command = [sys.executable, "-m", "crossgrad_core", "sweep", str(grid), "--out", str(out), *more]
    with (out.parent / f"{out.name}.txt").open("ab") as file:
        return subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)


def said(out):
    return (out.parent / f"{out.name}.txt").read_text()


def children(pid):
    """The processes that a process started, and those that they did."""
    try:
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    except OSError:
        return []
    own = [int(each) for each in text.split()]
    return [*own, *(each for child in own for each in children(child))]


def begins(out):
    return [each for each in read_records(out / "workers") if each.event == "begun"]


def wait_for(happened, seconds=500.0):
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.05)


def kill(process, what):
    """Kills the sweep, one of its runs, or everything at once."""
    runs = children(process.pid)
    victims = {"sweep": [process.pid], "run": runs[:1], "all": [process.pid, *runs]}[what]
    for victim in victims:
        try:
            os.kill(victim, signal.SIGKILL)
        except ProcessLookupError:  # It ended meanwhile.
            continue


def finished(out):
    """Finished runs -> when their results were written."""
    found = {}
    for summary in (out / "runs").glob("*/summary.json"):
        if yaml.safe_load(summary.read_text())["status"] == "finished":
            found[summary.parent.name] = summary.stat().st_mtime_ns
    return found


@pytest.mark.slow
@pytest.mark.timeout(3600 if "FAULTS" in os.environ else 600)
def test_a_sweep_killed_at_random_instants_repeats_and_loses_no_run(grid, tmp_path):
    out = tmp_path / "sweep"
    draw = random.Random(0)
    long = "FAULTS" in os.environ
    alone = undisturbed(grid, tmp_path / "undisturbed")  # First: it compiles the kernels.
    seen, pace = {}, 0.0
    for number in range(LONG if long else SHORT):
        known = len(begins(out)) if out.exists() else 0
        process = start(grid, out)
        wait_for(lambda known=known, process=process: len(begins(out)) > known
                 or process.poll() is not None)  # fmt: skip
        began = time.monotonic()
        if number == 0:  # From the first checkpoint it is known how fast this machine is.
            wait_for(lambda: any(out.glob("runs/*/checkpoints/step-*")))
            pace = min(time.monotonic() - began, SLOWEST)
        time.sleep(draw.uniform(0.0, 2.0 * pace) if number else 0.0)
        kill(process, ("all", "sweep", "run")[number % 3])
        if number % 3 == 2:
            time.sleep(draw.uniform(0.0, pace))
            kill(process, "all")
        process.wait()
        seen |= {name: when for name, when in finished(out).items() if name not in seen}
    assert start(grid, out).wait() == 0, said(out)
    after = finished(out)
    assert after.keys() == alone.keys() == {path.name for path in (out / "runs").iterdir()}
    assert len(after) == (24 if long else 2)
    assert {name: after[name] for name in seen} == seen
    for name in after:
        events = [each for each in read_records(out / "workers") if each.run == name]
        ends = [n for n, each in enumerate(events) if each.status == "finished"]
        assert ends in ([], [len(events) - 1])
    laws.parses(out / "runs")
    for name in after:
        laws.same_bits(alone[name], out / "runs" / name)


def undisturbed(grid, folder):
    """Id -> folder of each run of a grid, carried out by itself in this process."""
    folder.mkdir()
    found = {}
    for job in Sweep(Request(grid, folder), read_only=True).plan.jobs:
        settings = folder / f"{job.id}.yaml"
        write_settings(settings, job.settings)
        found[job.id] = folder / job.id
        crossgrad_core.run(config=settings, out=found[job.id], threads=1, quiet=True)
    return found


@pytest.mark.skipif("FAULTS" not in os.environ, reason="minutes: `make faults`")
@pytest.mark.timeout(3600)
def test_a_sweep_on_a_ray_cluster_that_loses_a_node_gives_the_same_bits(grid, tmp_path):
    pytest.importorskip("ray")
    content = yaml.safe_load(grid.read_text())
    few = grid.with_name("few.yaml")
    few.write_text(yaml.safe_dump({**content, "seeds": [0]}))
    out = tmp_path / "ray"
    command = [sys.executable, str(TWO_NODES), str(few), str(out), "kill"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["killed"]
    assert told["states"] == ["finished"] * 4
    for name, folder in undisturbed(few, tmp_path / "undisturbed").items():
        laws.same_bits(folder, out / "runs" / name)


@pytest.fixture
def slow(tmp_path, monkeypatch):
    """A third party's observer, with which a run takes a minute until the file `go` is there."""
    folder = tmp_path / "stranger"
    info = folder / "slow-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: slow\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[crossgrad.observers]\nslow = slow_steps:Slow\n")
    (folder / "slow_steps.py").write_text(SLOW)
    found = (os.environ.get("PYTHONPATH"), str(folder))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, found)))
    monkeypatch.syspath_prepend(str(folder))
    return tmp_path / "go"


SLOW = """
import time
from pathlib import Path
from crossgrad_core.plugin import Observer, hookimpl

class Slow(Observer):
    go: str

    @hookimpl
    def crossgrad_step_end(self, record):
        end = time.monotonic() + 1
        while time.monotonic() < end and not Path(self.go).exists():
            time.sleep(0.05)
"""


@pytest.mark.slow
def test_an_interrupted_sweep_stops_its_runs_and_can_be_continued(grid, slow, tmp_path, capsys):
    out = tmp_path / "sweep"
    observer = json.dumps({"name": "slow", "go": str(slow)})
    more = ("--seed", "7", "--set", "steps=12", "--set", f"observers={observer}")
    process = start(grid, out, *more)
    wait_for(lambda: begins(out) if out.exists() else False)
    run = out / "runs" / begins(out)[0].run
    wait_for((run / "config.yaml").is_file)
    assert ended("sweep", grid, "--out", out, *more) == 2
    assert f"process {process.pid}, sweeping since" in capsys.readouterr().err
    assert ended("sweep", grid, "--out", out, *more, "--list") == 0
    assert f"{run.name}  training " in capsys.readouterr().out
    process.send_signal(signal.SIGINT)
    assert process.wait() == 130, said(out)
    ends = [each.status for each in read_records(out / "workers") if each.event == "ended"]
    assert set(ends) == {"stopped"}
    slow.touch()
    assert start(grid, out, *more).wait() == 0, said(out)
    assert run.name in finished(out)
