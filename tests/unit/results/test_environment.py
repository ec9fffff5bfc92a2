"""The record of the code version that made a run."""

import subprocess

from crossgrad_core.run.results.machine import commit


def git(folder, *arguments):
    who = ("-c", "user.name=a", "-c", "user.email=a@b")
    done = subprocess.run(
        ["git", *who, "-C", folder, *arguments], check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


def test_the_recorded_commit_marks_changed_files(tmp_path):
    package = tmp_path / "crossgrad_core"
    package.mkdir()
    for name in ("pyproject.toml", "crossgrad_core/a.py"):
        (tmp_path / name).write_text("one\n")
    assert commit(package) is None
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    head = git(tmp_path, "rev-parse", "--short=7", "HEAD")
    (tmp_path / "untracked").touch()
    assert commit(package) == head
    (package / "a.py").write_text("two\n")
    assert commit(package) == f"{head}+"


def test_an_installed_package_has_no_commit_even_inside_a_repository(tmp_path):
    git(tmp_path, "init", "-q")
    package = tmp_path / "venv" / "site-packages" / "crossgrad_core"
    package.mkdir(parents=True)
    (tmp_path / "pyproject.toml").touch()
    assert commit(package) is None
