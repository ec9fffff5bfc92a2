"""`kill -9` at any instant: every file parses, nothing is lost, a resumed run has the same bits."""

import random
import signal


def test_a_run_killed_at_random_instants_resumes_to_the_same_bits(reference, thorough, tmp_path):
    # Also during checkpoints, evaluations and the export, which take most of the time here.
    draw = random.Random(0)
    for number in range(thorough):
        folder = tmp_path / str(number)
        instant = draw.uniform(0.0, reference.seconds)
        reference.nursery.run(*reference.command(folder), signals=[(instant, signal.SIGKILL)])
        reference.recovers(folder)


def test_a_run_killed_again_while_resuming_resumes_to_the_same_bits(reference, thorough, tmp_path):
    draw = random.Random(1)
    for number in range(max(1, thorough // 10)):
        folder = tmp_path / str(number)
        command = reference.command(folder)
        while not (folder / "config.yaml").is_file():
            instant = draw.uniform(0.5, 1.0) * reference.seconds
            reference.nursery.run(*command, signals=[(instant, signal.SIGKILL)])
        for _ in range(3):
            instant = draw.uniform(0.0, reference.seconds)
            resume = ("run", "--resume", str(folder))
            reference.nursery.run(*resume, signals=[(instant, signal.SIGKILL)])
        reference.recovers(folder)


def test_a_run_killed_right_before_a_write_resumes_to_the_same_bits(reference, thorough, tmp_path):
    # Each opening, renaming and deleting of the run in turn, which no random instant would hit.
    writes = range(1, reference.writes + 1)
    for at in random.Random(2).sample(writes, min(thorough, len(writes))):
        folder = tmp_path / str(at)
        fault = {"below": str(folder), "at": at, "what": "kill"}
        end = reference.nursery.run(*reference.command(folder), fault=fault)
        assert end.code == -signal.SIGKILL
        reference.recovers(folder)
