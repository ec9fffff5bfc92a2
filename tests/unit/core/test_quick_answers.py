"""`auto` asks readers and rasterizers without importing them, if their package announces how."""

import sys
from dataclasses import replace

import pytest
from support.distributions import write_distribution

from crossgrad_core.registry.entries import entries, find, load, quick_answer
from crossgrad_core.run.assemble import accepts
from crossgrad_core.run.rasterizers import Wanted, choose_rasterizer

ACCEPTS = "def made_up(path):\n    return (path / 'made-up.txt').is_file()\n"
FAILS = "def made_up(path):\n    raise RuntimeError('no answer')\n"
BROKEN = "raise RuntimeError('imported')\n"


@pytest.fixture
def install(tmp_path, monkeypatch):
    """A package whose reader cannot be imported, and which announces a quick answer."""

    def put(source):
        plugins = {
            "readers": {"made-up": "made_up_reader:Reader"},
            "readers.accepts": {"made-up": "made_up_quick:made_up"},
        }
        modules = {"made_up_reader": BROKEN, "made_up_quick": source}
        write_distribution(tmp_path / "site", "made-up", plugins, modules)
        monkeypatch.syspath_prepend(tmp_path / "site")

    yield put
    sys.modules.pop("made_up_quick", None)


@pytest.mark.parametrize(("slot", "method"), [("readers", "accepts"), ("rasterizers", "speed")])
def test_every_bundled_component_has_a_quick_answer(slot, method):
    for name, entry in entries(slot).items():
        assert quick_answer(entry) is not None, name
        assert callable(getattr(load(slot, name), method))


@pytest.mark.parametrize("device", ["cpu", "cuda", "mps"])
def test_quick_answers_of_rasterizers_agree_with_their_classes(device):
    for name, entry in entries("rasterizers").items():
        assert quick_answer(entry)(device) == load("rasterizers", name).speed(device)


def test_the_quick_answer_of_a_reader_does_not_import_the_reader(install, tmp_path):
    install(ACCEPTS)
    assert not accepts("made-up", tmp_path)
    (tmp_path / "made-up.txt").touch()
    assert accepts("made-up", tmp_path)


def test_a_reader_whose_quick_answer_fails_is_left_out(install, tmp_path, caplog):
    install(FAILS)
    assert not accepts("made-up", tmp_path)
    assert "reader made-up cannot be used: RuntimeError: no answer" in caplog.text


def test_a_quick_answer_of_another_package_is_ignored(install):
    install(ACCEPTS)
    entry = find("readers", "made-up")
    assert quick_answer(entry) is not None
    assert quick_answer(replace(entry, distribution="another")) is None


def test_a_rasterizer_with_a_quick_answer_that_cannot_be_imported_is_left_out(
    tmp_path, monkeypatch
):
    plugins = {
        "rasterizers": {"made-up": "made_up_rasterizer:Rasterizer"},
        "rasterizers.speed": {"made-up": "made_up_speed:speed"},
    }
    modules = {
        "made_up_rasterizer": BROKEN,
        "made_up_speed": "def speed(device):\n    return 500.0\n",
    }
    write_distribution(tmp_path, "made-up", plugins, modules)
    monkeypatch.syspath_prepend(tmp_path)
    name, notes = choose_rasterizer("auto", Wanted("cpu", "plain"))
    assert name == "numba"
    assert notes[0] == "rasterizer made-up is not used: rasterizer made-up cannot be imported"
    sys.modules.pop("made_up_speed", None)
