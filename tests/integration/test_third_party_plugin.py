"""The example plugin, installed by pip beside crossgrad as a stranger's package would be."""

import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest
import yaml
from support.scenes import write_tiny_scene

EXAMPLE = Path(__file__).parents[2] / "examples" / "plugin"


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """The interpreter of a fresh environment that sees everything installed in this one."""
    folder = tmp_path_factory.mktemp("third_party") / "venv"
    venv.create(folder, with_pip=False, symlinks=sys.platform != "win32")
    # Not --system-site-packages: this interpreter may itself be one of a virtual environment.
    here = sysconfig.get_path("purelib")
    scheme = {"base": str(folder), "platbase": str(folder)}
    there = Path(sysconfig.get_path("purelib", "venv", vars=scheme))
    (there / "host.pth").write_text(f"import site; site.addsitedir({here!r})\n")
    return Path(sysconfig.get_path("scripts", "venv", vars=scheme)) / "python"


@pytest.fixture(scope="module")
def crossgrad(python):
    """Runs a command of that environment, away from the checkout."""

    def run(*arguments, code=0):
        ended = subprocess.run(
            [python, "-m", "crossgrad_core", *map(str, arguments)],
            capture_output=True,
            text=True,
            cwd=python.parent,
            check=False,
        )
        assert ended.returncode == code, ended.stdout + ended.stderr
        return " ".join(ended.stdout.split()), ended.stderr

    return run


def install(python, source):
    """Offline and without dependencies: crossgrad is there already."""
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python]
    offline = ["--no-index", "--no-deps", "--no-build-isolation", "--force-reinstall"]
    subprocess.run([*pip, "install", *offline, source], check=True, capture_output=True)


@pytest.fixture(scope="module")
def installed(python, tmp_path_factory):
    source = tmp_path_factory.mktemp("source") / "plugin"
    shutil.copytree(EXAMPLE, source, ignore=shutil.ignore_patterns("__pycache__"))
    install(python, source)
    return source


@pytest.fixture
def broken(python, installed, tmp_path):
    """The same package with three defects, until the test is over."""
    source = tmp_path / "broken"
    shutil.copytree(installed, source)
    package = source / "crossgrad_example"
    replace(
        package / "equal_length.py",
        "np.maximum(context.present.sum(axis=1), 1)",
        "context.step / 1e9",
    )
    replace(package / "equal_length.py", "lengths = np.sqrt(", "lengths = np.sqrt(1e-8 + ")
    replace(package / "least_seen.py", "context.rng.random", "np.random.random")
    replace(package / "clip.py", "return answer.with_state", "answer.with_state")
    install(python, source)
    yield
    install(python, installed)


def replace(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.mark.usefixtures("installed")
def test_it_is_listed_and_shown(crossgrad):
    assert "equal-length crossgrad-example 0.1.0" in crossgrad("plugins", "list")[0]
    shown, _ = crossgrad("plugins", "show", "clip")
    assert "observer clip, from crossgrad-example 0.1.0" in shown
    assert "max_norm (float, default 1.0, > 0.0)" in shown


@pytest.mark.usefixtures("installed")
def test_it_keeps_the_contract(crossgrad):
    report, _ = crossgrad("plugins", "check", "crossgrad_example")
    assert "operator equal-length pass" in report
    assert "sampler least-seen pass" in report
    assert "observer clip pass" in report
    assert "command count-views pass" in report
    assert "14 of 14 plugins keep the contract of their slot" in report


@pytest.mark.usefixtures("broken")
def test_a_broken_one_fails_with_the_reasons(crossgrad):
    report, _ = crossgrad("plugins", "check", "crossgrad-example", code=1)
    assert "operator equal-length FAIL" in report
    assert "compare lengths with each other, never with a constant" in report
    assert "draws from the global generator of numpy" in report
    assert "the seam crossgrad_aggregate_gradients was not answered" in report
    assert "11 of 14 plugins keep the contract of their slot" in report


@pytest.mark.usefixtures("installed")
def test_its_command_is_one_of_crossgrad_s(crossgrad, tmp_path):
    scene = write_tiny_scene(tmp_path / "tiny", views=6)
    assert "count-views Count the training views of a scene." in crossgrad("--help")[0]
    assert crossgrad("count-views", scene)[0] == "tiny: 5 training views, read by colmap"


@pytest.mark.usefixtures("installed")
def test_a_run_uses_it_by_name(crossgrad, tmp_path):
    scene = write_tiny_scene(tmp_path / "scene", views=6)
    out = tmp_path / "run"
    choice = ["--sampler", "least-seen", "--operator", "equal-length", "--observe", "clip"]
    options = ["--set", "observers.clip.max_norm=1e-4", "--rasterizer", "torch"]
    crossgrad("run", scene, "--steps", 3, *choice, *options, "--out", out)
    written = yaml.safe_load((out / "config.yaml").read_text())
    assert written["sampler"]["name"] == "least-seen"
    assert written["operator"]["name"] == "equal-length"
    assert {"name": "clip", "max_norm": 1e-4} in written["observers"]


@pytest.mark.usefixtures("installed")
def test_what_is_not_there_is_refused_by_name(crossgrad, tmp_path):
    scene = write_tiny_scene(tmp_path / "scene", views=6)
    _, err = crossgrad("run", scene, "--operator", "equal-lenght", code=2)
    assert "did you mean 'equal-length'?" in err
