"""What `plugins check` finds of a package beside others, and of plugins that end the program."""

import sys

import pytest
from support.distributions import write_distribution

from crossgrad_core.registry.entries import load, offers
from crossgrad_core.testing.checking import check_entry
from crossgrad_core.testing.densifiers import DENSIFIER_CHECKS, DensifierRun

SAMPLER = """
import sys
from crossgrad_core.plugin import ViewSample, PluginState, Sampler, hookimpl

class Fixed(Sampler):
    '''Draws the first views.'''

    def sample(self, context, state):
        return ViewSample(tuple(range(context.views_per_step))), state

class Ends(Fixed):
    def sample(self, context, state):
        sys.exit(0)

class EndsWhenMade(Fixed):
    def model_post_init(self, context):
        sys.exit(0)
"""
BACKBONE = """
import sys
from crossgrad_core.registry.entries import load

class Misspelt(load("backbones", "vanilla")):
    default_densifier = "adx"

class Ends(Misspelt):
    def blocks(self):
        sys.exit(0)

class Sound(load("backbones", "vanilla")):
    pass
"""


@pytest.fixture
def installed(tmp_path, monkeypatch):
    def install(source, **plugins):
        write_distribution(tmp_path, "made-up-check", plugins, {"made_up_check": source})
        monkeypatch.syspath_prepend(tmp_path)

    yield install
    sys.modules.pop("made_up_check", None)


def failures(slot, name, distribution="made-up-check"):
    (entry,) = (e for e in offers(slot) if (e.name, e.distribution) == (name, distribution))
    return {each.check: each.failure for each in check_entry(entry) if each.failure is not None}


def test_a_component_name_of_another_package_fails_the_check(installed):
    installed(SAMPLER, samplers={"epoch": "made_up_check:Fixed", "made-up": "made_up_check:Fixed"})
    found = failures("samplers", "epoch")
    assert (
        "2 installed packages offer a sampler named 'epoch'"
        in found["its name is not used by another plugin"]
    )
    assert "crossgrad " in found["its name is not used by another plugin"]
    rest = {check for check in found if check != "its name is not used by another plugin"}
    assert rest == failures("samplers", "made-up").keys()


def test_a_command_name_of_the_core_fails_the_check(installed):
    source = 'def run():\n    """Runs."""\n'
    installed(source, commands={"run": "made_up_check:run"})
    assert failures("commands", "run") == {
        "its name is not used by another plugin": "the core has a command run, "
        "which is called instead"
    }


def test_a_plugin_that_calls_exit_fails_its_checks(installed):
    installed(SAMPLER, samplers={"ends": "made_up_check:Ends"})
    found = failures("samplers", "ends")
    assert found["every view comes"] == "SystemExit: 0"
    assert "options are frozen" not in found


def test_a_plugin_that_calls_exit_on_creation_fails_the_first_check(installed):
    installed(SAMPLER, samplers={"ends": "made_up_check:EndsWhenMade"})
    found = failures("samplers", "ends")
    assert found == {"it can be created with default options": "SystemExit: 0"}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["Misspelt", "Ends"])
def test_a_broken_backbone_of_another_package_does_not_fail_a_densifier(installed, kind):
    installed(BACKBONE, backbones={"aaa": f"made_up_check:{kind}"})
    for check in DENSIFIER_CHECKS:
        check(load("densifiers", "adc"))


def test_a_densifier_is_checked_with_a_bundled_backbone(installed):
    installed(BACKBONE, backbones={"aaa": "made_up_check:Sound", "zzz": "made_up_check:Sound"})
    for name in ("adc", "pixel", "none"):
        backbone = DensifierRun.of(load("densifiers", name)()).backbone
        assert type(backbone).__module__.startswith("crossgrad_backbones")


def test_a_misspelt_default_densifier_is_reported(installed):
    installed(BACKBONE, backbones={"aaa": "made_up_check:Misspelt"})
    assert list(failures("backbones", "aaa")) == ["the default densifier is there"]
    assert "'adx'" in failures("backbones", "aaa")["the default densifier is there"]
