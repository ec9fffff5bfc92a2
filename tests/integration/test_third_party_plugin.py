"""The example plugin, installed by pip beside crossgrad as a stranger's package would be."""

import json
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest
import yaml
from support.scenes import write_tiny_scene

#: Carries out command lines one after the other, as starting takes longer than most of them.
COMMANDS = """
import contextlib, io, json, sys
from crossgrad_core.cli.main import main

for line in sys.stdin:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(json.loads(line))
            code = 0
        except SystemExit as end:
            code = end.code or 0
    print(json.dumps((code, out.getvalue(), err.getvalue())), flush=True)
"""
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
def crossgrad(python, installed):
    """Runs commands of that environment, away from the checkout."""
    command = [python, "-c", COMMANDS]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=python.parent, **pipes) as process:

        def run(*arguments):
            process.stdin.write(json.dumps([str(each) for each in arguments]) + "\n")
            process.stdin.flush()
            code, out, err = json.loads(process.stdout.readline())
            return code, " ".join(out.split()), err

        yield run


def checked(python, name):
    """What a fresh process says of a plugin: a package is imported once."""
    command = [python, "-m", "crossgrad_core", "plugins", "check", name]
    done = subprocess.run(command, capture_output=True, text=True, cwd=python.parent, check=False)
    return done.returncode, " ".join(done.stdout.split())


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
    """The installed package has three defects, until the test is over."""
    (package,) = python.parents[1].glob("**/site-packages/crossgrad_example")
    whole = shutil.copytree(package, tmp_path / "whole")
    replace(
        package / "equal_length.py",
        "np.maximum(context.present.sum(axis=1), 1)",
        "context.step / 1e9",
    )
    replace(package / "equal_length.py", "lengths = np.sqrt(", "lengths = np.sqrt(1e-8 + ")
    replace(package / "least_seen.py", "context.rng.random", "np.random.random")
    replace(package / "clip.py", "return answer.with_state", "answer.with_state")
    yield
    shutil.rmtree(package)
    shutil.copytree(whole, package)


def replace(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_the_example_plugins_are_listed_and_shown(crossgrad):
    assert "equal-length crossgrad-example 0.1.0" in crossgrad("plugins", "list")[1]
    code, shown, _ = crossgrad("plugins", "show", "clip")
    assert code == 0
    assert "observer clip, from crossgrad-example 0.1.0" in shown
    assert "max_norm (float, default 1.0, > 0.0)" in shown


def test_the_example_plugins_keep_their_contracts(crossgrad):
    code, report, _ = crossgrad("plugins", "check", "crossgrad_example")
    assert code == 0
    assert "operator equal-length pass" in report
    assert "sampler least-seen pass" in report
    assert "observer clip pass" in report
    assert "command count-views pass" in report
    assert "17 of 17 plugins fulfil the contract of their slot" in report


@pytest.mark.slow
@pytest.mark.usefixtures("broken")
def test_a_broken_example_plugin_fails_the_check_with_the_reasons(python):
    code, report = checked(python, "crossgrad-example")
    assert code == 1
    assert "operator equal-length FAIL" in report
    assert "compare lengths with each other, never with a constant" in report
    assert "draws from the global generator of numpy" in report
    assert "no plugin returned a result for the hook crossgrad_aggregate_gradients" in report
    assert "14 of 17 plugins fulfil the contract of their slot" in report


def test_the_command_of_the_example_package_is_a_command_of_crossgrad(crossgrad, tmp_path):
    scene = write_tiny_scene(tmp_path / "tiny", views=6)
    assert "count-views Count the training views of a scene." in crossgrad("--help")[1]
    counted = crossgrad("count-views", scene)
    assert counted[:2] == (0, "tiny: 5 training views, read by colmap")


def test_a_run_uses_the_example_plugins_by_name(crossgrad, tmp_path):
    scene = write_tiny_scene(tmp_path / "scene", views=6)
    out = tmp_path / "run"
    choice = ["--sampler", "least-seen", "--operator", "equal-length", "--observe", "clip"]
    options = ["--set", "observers.clip.max_norm=1e-4", "--rasterizer", "torch"]
    code, _, err = crossgrad("run", scene, "--steps", 3, *choice, *options, "--out", out)
    assert code == 0, err
    written = yaml.safe_load((out / "config.yaml").read_text())
    assert written["sampler"]["name"] == "least-seen"
    assert written["operator"]["name"] == "equal-length"
    assert {"name": "clip", "max_norm": 1e-4} in written["observers"]


def test_an_unknown_plugin_is_refused_with_a_suggestion(crossgrad, tmp_path):
    scene = write_tiny_scene(tmp_path / "scene", views=6)
    code, _, err = crossgrad("run", scene, "--operator", "equal-lenght")
    assert code == 2
    assert "did you mean 'equal-length'?" in err
