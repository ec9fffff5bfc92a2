"""`crossgrad run`: train, evaluate, export.

The options are generated from the fields of the settings classes.
"""

from collections.abc import Callable, Iterator, Mapping
from inspect import Parameter, Signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from crossgrad_core.config import CHANGEABLE
from crossgrad_core.contract.flags import CONFIGURATION, HEADINGS, RESULTS, SCENE
from crossgrad_core.defaults import PREPARING_READER, VIEWER
from crossgrad_core.errors import UserError
from crossgrad_core.run.options import OPTIONS, Option
from crossgrad_core.system.command_options import print_all_options
from crossgrad_core.system.startup import announce
from crossgrad_core.wording import listed

if TYPE_CHECKING:
    from crossgrad_core.config import ComponentChoice

#: Options that apply to one call of `crossgrad run` only. A resumed run may get other values.
_OF_THE_COMMAND: Final = frozenset(
    {
        "resume",
        "accept_scene",
        "accept_plugins",
        "check",
        "quiet",
        "verbose",
        "view",
        "host",
        "port",
    }
)


def refuse_beside_resume(run: Path, given: Mapping[str, object]) -> None:
    """Refuse options given with `--resume` that the resumed run would ignore.

    Args:
        run: The folder of the run to resume.
        given: Option name -> value. None, False or an empty list means that the user did not give
            the option.

    Raises:
        UserError: The resumed run would ignore an option; the message names the option as the user
            typed it.
    """
    typed = list(_typed(given))
    if typed:
        raise UserError(
            "settings and the scene cannot be changed when a run is resumed",
            where=listed(typed),
            expected="--device, --threads, --stop-after, --accept-scene, --accept-plugins, "
            "--check, --view, -q and -v only",
            todo=f"leave {'it' if len(typed) == 1 else 'them'} out to continue {run}, or leave "
            "--resume out to start a new run",
        )


def _typed(given: Mapping[str, object]) -> Iterator[str]:
    for name, value in given.items():
        if value in (None, False, []) or name in CHANGEABLE | _OF_THE_COMMAND:
            continue
        if name == "scene":
            yield "SCENE"
        elif name == "assignments" and isinstance(value, list):
            keys = (str(assignment).partition("=")[0] for assignment in value)
            yield from (f"--set {key}" for key in keys if key.strip() not in CHANGEABLE)
        else:
            yield f"--{name.replace('_', '-')}"


def _parameter(name: str, kind: object, info: object, default: object = None) -> Parameter:
    return Parameter(
        name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info]
    )


def _own(
    name: str,
    kind: object,
    *flags: str,
    heading: str = RESULTS,
    metavar: str | None = None,
    help: str,  # noqa: A002 - typer's name
    common: bool = True,
) -> Parameter:
    """Return the parameter of an option that is not a setting."""
    info = typer.Option(
        *flags, rich_help_panel=heading, metavar=metavar, help=help, hidden=not common
    )
    return _parameter(name, kind, info, default=False if kind is bool else None)


#: Options that are not settings. In the help, these options are before the settings, after the
#: first setting about results, or at the end.
_FRONT: Final = (
    _own(
        "config",
        Path | None,
        "--config",
        heading=CONFIGURATION,
        metavar="FILE",
        help="YAML file of settings, such as the config.yaml of a run. Options on the "
        "command line override the file.",
    ),
    _own(
        "assignments",
        list[str] | None,
        "--set",
        heading=CONFIGURATION,
        metavar="KEY=VALUE",
        help="Set one setting, such as operator.c=0.4. Repeatable. Overrides all other sources.",
    ),
)
_RESUMING: Final = (
    _own(
        "resume",
        Path | None,
        "--resume",
        metavar="RUN",
        help="Continue the stopped run in this folder, with bitwise equal results.",
    ),
    _own(
        "accept_scene",
        bool,
        "--accept-scene",
        common=False,
        help="Train although points, poses and photos of the scene do not match. With "
        "--resume: although photos, masks or points have changed.",
    ),
    _own(
        "accept_plugins",
        bool,
        "--accept-plugins",
        common=False,
        help="With --resume: continue with other versions of the packages that train the run.",
    ),
)
_LAST: Final = (
    _own(
        "prepare",
        bool,
        "--prepare",
        heading=SCENE,
        help="SCENE is a folder of photos without poses. First estimate the poses, as `crossgrad "
        "prepare` does, and write the scene to the folder SCENE-scene.",
    ),
    _own(
        "dry_run",
        bool,
        "--dry-run",
        help="Check everything and print the resolved settings without training. With --prepare, "
        "the poses are still estimated.",
    ),
    _own(
        "check",
        bool,
        "--check",
        common=False,
        help="Decode all photos before training, to find damaged photos early.",
    ),
    _own(
        "view",
        bool,
        "--view",
        common=False,
        help="Show the run in a browser while it trains; the output names the address. Needs "
        "the extra view.",
    ),
    _own(
        "host",
        str | None,
        "--host",
        metavar="ADDRESS",
        common=False,
        help="With --view: address that the viewer listens on. Default: 127.0.0.1, which only "
        "this machine reaches.",
    ),
    _own(
        "port",
        int | None,
        "--port",
        metavar="N",
        common=False,
        help="With --view: port of the viewer. Default: 8080.",
    ),
    _own("quiet", bool, "--quiet", "-q", help="Print only errors and the result."),
    _own("verbose", bool, "--verbose", "-v", help="Print every decision and event."),
    _parameter(
        "help_all",
        bool,
        typer.Option(
            "--help-all",
            is_eager=True,
            expose_value=False,
            callback=print_all_options,
            help="Show all options and exit.",
        ),
        default=False,
    ),
)


def _parameters() -> Iterator[Parameter]:
    """Yield all parameters of the command in the order of its help."""
    for option in OPTIONS:
        if not option.flag.heading:
            yield _setting(option)
    yield from _FRONT
    for heading in HEADINGS:
        first, *others = (option for option in OPTIONS if option.flag.heading == heading)
        yield _setting(first)
        if heading == RESULTS:
            yield from _RESUMING
        yield from map(_setting, others)
    yield from _LAST


def _setting(option: Option) -> Parameter:
    """Return the parameter of a setting; its value is None if the user gives no value."""
    flag = option.flag
    info = (
        typer.Option(
            f"--{option.name.replace('_', '-')}",
            metavar=flag.metavar,
            help=option.help,
            rich_help_panel=flag.heading,
            hidden=not flag.common,
        )
        if flag.heading
        else typer.Argument(metavar=flag.metavar, help=option.help, show_default=False)
    )
    return _parameter(option.name, option.kind | None, info)


def _with_options(function: Callable[..., None]) -> Callable[..., None]:
    """Return the function with a signature that lists all options; typer reads this signature."""
    parameters = list(_parameters())
    function.__dict__["__signature__"] = Signature(parameters)
    function.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return function


@_with_options
def run(**given: Any) -> None:  # noqa: ANN401 - typed by the schema
    """Train on a scene, evaluate, and write the results to a folder.

    Every setting has a default. The run writes all settings to config.yaml in its folder. The
    command `crossgrad run --config config.yaml` repeats the run.
    """
    announce(quiet=given["quiet"])
    if given["resume"] is not None:
        refuse_beside_resume(given["resume"], given)
    from crossgrad_core.run.settings import merged, name_file

    settings = {option.name: given[option.name] for option in OPTIONS}
    if given["prepare"]:
        settings["reader"] = settings["reader"] or PREPARING_READER
    config, assignments = given["config"], given["assignments"] or []
    wanted = merged(config, settings, assignments)

    from crossgrad_core.run import app

    viewer = _viewer(**{name: given[name] for name in ("view", "host", "port")})
    try:
        code = app.run(
            wanted,
            resume=given["resume"],
            dry_run=given["dry_run"],
            verbosity=-1 if given["quiet"] else int(given["verbose"]),
            accept_scene=given["accept_scene"],
            accept_plugins=given["accept_plugins"],
            check=given["check"],
            viewer=viewer,
        )
    except UserError as error:
        if config is not None:
            name_file(error, config, settings, assignments)
        raise
    raise typer.Exit(code)


def _viewer(*, view: bool, host: str | None, port: int | None) -> "ComponentChoice | None":
    """Return the observer of `--view`; None without `--view`."""
    from crossgrad_core.config import ComponentChoice

    options = {name: value for name, value in (("host", host), ("port", port)) if value is not None}
    if view:
        return ComponentChoice.model_validate({"name": VIEWER, **options})
    if options:
        raise UserError(
            f"--{min(options)} has no effect without --view",
            where=f"--{min(options)}",
            todo="add --view, or leave it out",
        )
    return None
