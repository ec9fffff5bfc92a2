"""Runs of a small scene that grows, saves, evaluates and ends within seconds."""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from crossgrad_faults import laws
from crossgrad_faults.nursery import ALONE

#: 60 steps with five edits, a reset, six checkpoints and seven evaluations.
OPTIONS = (
    *("--steps", "60", "--threads", "1", "--schedule-unit", "steps"),
    *("--set", "densify_from=10", "--set", "densify_every=10", "--set", "densify_until=55"),
    *("--set", "reset_every=30", "--save-every", "9", "--eval-every", "8"),
)
NURSERY = Path(__file__).with_name("nursery.py")


@dataclass(frozen=True)
class End:
    """How a command line ended.

    Attributes:
        code: Exit status, or minus the number of the signal that ended it.
        seconds: Wall time.
        events: Changes of the disk that were counted.
        said: What it printed.
    """

    code: int
    seconds: float
    events: int
    said: str


@dataclass
class Nursery:
    """Runs command lines in forks of one process (see `nursery`).

    Args:
        folder: For the output of the command lines.
        environment: Environment variables of the process.
        scene: On which it trains a step to load its kernels.
    """

    folder: Path
    environment: dict[str, str]
    scene: Path
    count: int = 0
    process: "subprocess.Popen[str]" = field(init=False)

    def __post_init__(self) -> None:
        command = ("run", str(self.scene), "--out", str(self.folder / "warm"))
        self.process = subprocess.Popen(
            [sys.executable, str(NURSERY), *command, *OPTIONS, "--quiet"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**self.environment, **ALONE},
            cwd=self.folder,
        )
        assert self._line() == {"ready": True}

    def run(
        self,
        *arguments: str,
        signals: Sequence[tuple[float, int]] = (),
        fault: Mapping[str, Any] | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> End:
        """Runs a command line, with signals after some seconds or a fault at some write."""
        self.start(*arguments, signals=signals, fault=fault, environment=environment)
        return self.wait()

    def start(
        self,
        *arguments: str,
        signals: Sequence[tuple[float, int]] = (),
        fault: Mapping[str, Any] | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """As `run`; returns at once."""
        self.count += 1
        output = self.folder / f"output-{self.count}.txt"
        job: dict[str, Any] = {"arguments": arguments, "signals": list(signals), "fault": fault}
        job |= {"output": str(output), "environment": dict(environment or {})}
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()

    def wait(self) -> End:
        """How what was started ended."""
        answer = self._line()
        output = self.folder / f"output-{self.count}.txt"
        # Who is killed at once has printed nothing.
        said = output.read_text(encoding="utf-8", errors="replace") if output.exists() else ""
        return End(**answer, said=said)

    def close(self) -> None:
        """Ends the process."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait(timeout=60)
        self.process.stdout.close()

    def _line(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        answer: dict[str, Any] = json.loads(self.process.stdout.readline())
        return answer


@dataclass(frozen=True)
class Undisturbed:
    """What a run is like that nothing happens to.

    Attributes:
        nursery: Where runs are started.
        scene: The scene.
        folder: The finished run.
        seconds: Its wall time.
        writes: Number of its changes of the disk.
    """

    nursery: Nursery
    scene: Path
    folder: Path
    seconds: float
    writes: int

    def command(self, folder: Path, *more: str) -> tuple[str, ...]:
        """The command line that trains into `folder`."""
        return ("run", str(self.scene), "--out", str(folder), *OPTIONS, *more)

    def finished(self, folder: Path) -> End:
        """Finishes a run after a fault: resumed, or started where nothing was written yet."""
        if (folder / "config.yaml").is_file():
            return self.nursery.run("run", "--resume", str(folder))
        return self.nursery.run(*self.command(folder))

    def recovers(self, folder: Path) -> None:
        """The law: all files parse, and the finished run has the bits of the undisturbed one."""
        if folder.is_dir():
            laws.parses(folder)
        end = self.finished(folder)
        if end.code == 2 and "the run is finished" in end.said:
            end = End(0, end.seconds, end.events, end.said)
        assert end.code == 0, end.said
        laws.parses(folder)
        laws.same_bits(self.folder, folder)
        left = [path for path in folder.rglob("*") if laws.is_scratch(path.relative_to(folder))]
        assert not left, f"left behind: {left}"


def undisturbed(nursery: Nursery, scene: Path, folder: Path) -> Undisturbed:
    """Trains the reference run."""
    fault = {"below": str(folder), "at": 0, "what": "kill"}
    run = Undisturbed(nursery, scene, folder, 0.0, 0)
    end = nursery.run(*run.command(folder), fault=fault)
    assert end.code == 0, end.said
    return Undisturbed(nursery, scene, folder, end.seconds, end.events)
