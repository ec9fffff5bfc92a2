"""Stands for the process of a run in tests of sweeps: does at once what its settings say.

python fake_run.py CORES run --config FILE --out FOLDER ...
python fake_run.py CORES run --resume FOLDER ...
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

import yaml


def main():
    """Does what the setting `do` says, once for each process that is started."""
    arguments = sys.argv[1:]
    if "--resume" in arguments:
        folder = Path(arguments[arguments.index("--resume") + 1])
        settings = yaml.safe_load((folder / "config.yaml").read_text())
    else:
        folder = Path(arguments[arguments.index("--out") + 1])
        settings = yaml.safe_load(Path(arguments[arguments.index("--config") + 1]).read_text())
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "config.yaml").write_text(yaml.safe_dump(settings))
    with (folder / "starts.txt").open("a") as file:
        file.write(f"{os.getpid()} {arguments[0]} {os.environ['OMP_NUM_THREADS']} {os.getcwd()}\n")
    ACTS[settings["do"]](folder)


def finish(folder):
    ended(folder, "finished")


def fail(folder):
    ended(folder, "failed", "the loss is not finite")
    raise SystemExit(1)


def refuse(folder):
    (folder / "config.yaml").unlink()
    sys.stdout.write("note: about to be refused\nerror: there is no such thing\n  where:    here\n")
    raise SystemExit(2)


def die(folder):
    os.kill(os.getpid(), signal.SIGKILL)


def die_once(folder):
    if len((folder / "starts.txt").read_text().splitlines()) == 1:
        die(folder)
    finish(folder)


def go_on(folder):
    """Dies each time, and each time with a newer checkpoint, until the fifth."""
    count = len((folder / "starts.txt").read_text().splitlines())
    (folder / "checkpoints" / f"step-{count:06d}").mkdir(parents=True)
    if count < 5:
        die(folder)
    finish(folder)


def nap(folder):
    time.sleep(2.0)
    finish(folder)


def hang(folder):
    def stop(number, _frame):
        ended(folder, "stopped")
        os._exit(128 + number)

    signal.signal(signal.SIGTERM, stop)
    (folder / "ready").touch()
    time.sleep(60)


def eat(folder):
    signal.signal(signal.SIGTERM, lambda number, _frame: os._exit(128 + number))
    eaten = bytearray(300 * 2**20)
    time.sleep(60)
    assert eaten


def ended(folder, status, error=None):
    summary = {"status": status, "error": error, "overall": {"psnr": 20.0}}
    (folder / "summary.json").write_text(json.dumps(summary))


ACTS = {
    each.__name__: each for each in (finish, fail, refuse, die, die_once, go_on, hang, nap, eat)
}

if __name__ == "__main__":
    main()
