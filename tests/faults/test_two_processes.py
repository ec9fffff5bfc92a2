"""Two processes at one folder: one works, the other is refused, and nothing is mixed."""

import pytest
from crossgrad_faults import laws
from crossgrad_faults.runs import Nursery


@pytest.fixture
def second(reference, tmp_path):
    nursery = Nursery(tmp_path, reference.nursery.environment, reference.scene)
    yield nursery
    nursery.close()


def at_once(reference, second, *command):
    reference.nursery.start(*command)
    second.start(*command)
    return sorted((reference.nursery.wait(), second.wait()), key=lambda end: end.code)


@pytest.mark.slow
def test_a_second_run_into_the_same_folder_is_refused(reference, second, tmp_path):
    folder = tmp_path / "run"
    works, refused = at_once(reference, second, *reference.command(folder))
    assert (works.code, refused.code) == (0, 2), refused.said
    assert str(folder) in refused.said
    laws.parses(folder)
    laws.same_bits(reference.folder, folder)


@pytest.mark.slow
def test_a_second_resume_of_the_same_run_is_refused(reference, second, tmp_path):
    folder = tmp_path / "run"
    end = reference.nursery.run(*reference.command(folder, "--stop-after", "20"))
    assert end.code == 0, end.said
    works, refused = at_once(reference, second, "run", "--resume", str(folder))
    assert (works.code, refused.code) == (0, 2), refused.said
    laws.parses(folder)
    laws.same_bits(reference.folder, folder)
