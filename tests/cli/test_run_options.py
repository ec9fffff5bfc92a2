"""The options of `crossgrad run` are the settings of RunConfig, each defined once."""

import inspect

import pytest
import yaml
from typer.main import get_command

from crossgrad_core.cli.main import app
from crossgrad_core.config import RunConfig
from crossgrad_core.contract.flags import HEADINGS
from crossgrad_core.errors import UserError
from crossgrad_core.run.options import OPTIONS
from crossgrad_core.run.settings import merged, parsed

#: What is no setting: asked of one start of the command.
OWN = {
    *("config", "assignments", "resume", "accept_scene", "accept_plugins", "prepare"),
    *("dry_run", "check", "quiet", "verbose", "view", "host", "port", "help_all"),
}
PARAMETERS = {each.name: each for each in get_command(app).commands["run"].params}


def test_every_setting_and_a_few_command_options_are_options_of_run():
    assert PARAMETERS.keys() - OWN == {option.name for option in OPTIONS}
    assert PARAMETERS.keys() >= OWN


@pytest.mark.parametrize("option", OPTIONS, ids=lambda option: option.name)
def test_type_help_and_heading_of_an_option_come_from_its_field(option):
    parameter = PARAMETERS[option.name]
    assert option.help == parameter.help
    assert option.help.endswith(".")
    assert option.flag.metavar == parameter.metavar
    assert option.flag.heading in ("", *HEADINGS)
    assert parameter.default is None  # What the user does not give is left to the schema.


def test_each_flag_has_the_name_of_its_setting_with_four_exceptions():
    renamed = {option.name: option.path for option in OPTIONS if option.name != option.path[-1]}
    assert renamed == {
        "views": ("views_per_step",),
        "observe": ("observers",),
        "rule": ("rules",),
        "no_rule": ("rules",),
    }


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("views", "str"),
        ("steps", "int"),
        ("seconds", "float"),
        ("out", "path"),
        ("schedule", "str"),
        ("init", "str"),
    ],
)
def test_option_types_follow_the_schema(name, kind):
    (option,) = (each for each in OPTIONS if each.name == name)
    assert option.kind.__name__.lower() == kind


def test_every_setting_of_the_core_has_a_description():
    silent = [name for name, field in RunConfig.model_fields.items() if not field.description]
    assert silent == ["data"]


def test_typer_accepts_the_generated_signature():
    from crossgrad_core.cli.run import run

    assert list(inspect.signature(run).parameters) == list(run.__annotations__)


@pytest.mark.parametrize("text", ["views: 3", "views_per_step: 3"])
def test_a_configuration_file_may_use_the_old_key_views(text, tmp_path):
    (tmp_path / "run.yaml").write_text(text)
    settings = merged(tmp_path / "run.yaml", {}, [])
    assert parsed(settings).views_per_step == 3
    assert parsed(yaml.safe_load(text)).views_per_step == 3


@pytest.mark.parametrize(
    "given", [({"views": 4}, []), ({}, ["views=4"]), ({}, ["views_per_step=4"])]
)
def test_an_option_on_the_command_line_overrides_the_old_key_views(given, tmp_path):
    (tmp_path / "run.yaml").write_text("views: 3")
    assert parsed(merged(tmp_path / "run.yaml", *given)).views_per_step == 4


def test_a_file_with_the_keys_views_and_views_per_step_is_refused(tmp_path):
    (tmp_path / "run.yaml").write_text("views: 3\nviews_per_step: 4")
    with pytest.raises(UserError, match="no option 'views'"):
        parsed(merged(tmp_path / "run.yaml", {}, []))
