"""Settings of a run from a file, options and `--set`; each source overrides the previous one.

The result is a nested dictionary in the shape of `crossgrad_core.config.RunConfig`. The class
`RunConfig` validates this dictionary and reports unknown keys and invalid values.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeAlias

import yaml
from pydantic import ValidationError

from crossgrad_core.config import AUTO, ComponentChoice, RunConfig, current_name
from crossgrad_core.contract.component import Component
from crossgrad_core.contract.slots.recipe import Recipe
from crossgrad_core.defaults import CHAIN
from crossgrad_core.errors import UserError
from crossgrad_core.recipe.table import RULES, without_decided
from crossgrad_core.registry.entries import installed_as, load
from crossgrad_core.registry.slots import GROUPS, LISTS, MANY
from crossgrad_core.registry.validation import as_user_error
from crossgrad_core.run.options import OPTIONS
from crossgrad_core.run.results.config_file import unmarked
from crossgrad_core.system.yaml_values import described, read_mapping, read_yaml
from crossgrad_core.wording import listed, plural, singular, with_article

Settings: TypeAlias = dict[str, Any]

#: Setting that contains a list of components -> the option that adds a component to the list.
ADDING: Final = {"observers": "--observe", "metrics": "--metrics"}
#: Settings that contain the name and the options of a component, or of a chain of operators.
CHOICES: Final = tuple(singular(slot) for slot in GROUPS if slot not in MANY)
#: Settings that determine the length of a run.
LENGTHS: Final = tuple(
    (name,)
    for name in (
        *("steps", "max_views", "seconds", "revisions", "revised"),
        *("planned_seconds", "planned_views"),
    )
)
#: Other settings on which a recipe's decisions depend. If one of these settings changes, the recipe
#: decides again.
_DECIDING: Final = ("recipe", "backbone", "densifier", "operator", "sampler", "views_per_step")
#: Settings that are groups of other settings.
GROUPS_OF_SETTINGS: Final = ("data",)
_FILE: Final = (
    "the configuration file",
    "correct the file or the option; the config.yaml of a run is an example",
)
#: Name of a command-line option -> path of its setting.
_PLACES: Final = {option.name: option.path for option in OPTIONS}


def merged(
    config: Path | None, options: Mapping[str, object], assignments: Sequence[str]
) -> Settings:
    """Return the settings from a configuration file, options and assignments.

    Args:
        config: YAML file, or None.
        options: Option name -> value. None or an empty list means that the user did not give the
            option. A name may be the option of a component, as in `operator.c`.
        assignments: `KEY=VALUE` texts, values in YAML. Raises:
        UserError: The file cannot be read, or an assignment is malformed.
    """
    chosen = _places(options)
    assigned = list(map(_parsed, assignments))
    settings = _overlaid({} if config is None else _of_file(config), chosen, assigned)
    return _named_by_default(settings)


def name_file(
    error: UserError, config: Path, options: Mapping[str, object], assignments: Sequence[str]
) -> None:
    """Add the configuration file to an error if the wrong setting comes from the file.

    Args:
        error: An error about the result of `merged`. The function changes this error.
        config: The file, as given to `merged`.
        options: The options, as given to `merged`.
        assignments: The assignments, as given to `merged`.
    """
    key = error.where.removeprefix("--").split(".")[0].replace("-", "_")
    beside = {
        path[0]
        for path in [*_places(options), *(_parsed(assignment)[0] for assignment in assignments)]
    }
    if key in _of_file(config) and key not in beside:
        error.where = f"{error.where.removeprefix('--')} in {config}"
        error.args = (error.message(),)


def layered(layers: Sequence[Mapping[str, object]], assignments: Sequence[str] = ()) -> Settings:
    """Return the settings of several layers; later layers override earlier layers.

    Args:
        layers: Name of an option of `crossgrad run`, or key of a configuration file -> value. A
            layer that chooses another component drops the options that earlier layers gave to the
            previous component. A length replaces all lengths of earlier layers.
        assignments: `KEY=VALUE` texts as after `--set`, values in YAML. Assignments override all
            layers.

    Raises:
        UserError: An assignment, or a key with a dot, is malformed.
    """
    settings: Settings = {}
    for layer in layers:
        settings = _overlaid(settings, _places(_flat(layer)), [])
    settings = _overlaid(settings, {}, list(map(_parsed, assignments)))
    return _named_by_default(settings)


def with_recipe(settings: Mapping[str, Any]) -> Settings:
    """Return the settings, completed by the values that their recipe fixes.

    A configuration that a run wrote already contains the fixed settings.

    Raises:
        UserError: The recipe does not exist.
    """
    choice = settings.get("recipe")
    if not isinstance(choice, Mapping) or "name" not in choice or settings.get("decided"):
        return dict(settings)
    fixed = load(Recipe, choice["name"]).settings
    return layered([fixed, settings]) if fixed else dict(settings)


def parsed(settings: Mapping[str, Any]) -> RunConfig:
    """Return the validated configuration.

    Raises:
        UserError: A setting does not exist or has a wrong value.
    """
    try:
        return RunConfig.model_validate(settings)
    except ValidationError as error:
        raise as_user_error(
            error,
            RunConfig,
            subject="a run",
            todo="docs/settings.md lists all settings, `crossgrad run --help-all` all options",
        ) from error


def _flat(layer: Mapping[str, object]) -> Settings:
    """Return the layer with one key for each setting of a group, such as `data.split`."""
    flat: Settings = {}
    for name, value in layer.items():
        if name in GROUPS_OF_SETTINGS and isinstance(value, dict):
            flat |= {f"{name}.{inner}": setting for inner, setting in value.items()}
        else:
            flat[name] = value
    return flat


def _places(options: Mapping[str, object]) -> dict[tuple[str, ...], object]:
    """Return a dict from the path of each setting to the user's value.

    Values of None and empty lists are left out.

    Raises:
        UserError: A value is not a rule, or the same rule is both added and removed.
    """
    places: dict[tuple[str, ...], object] = {}
    for name, value in options.items():
        if not (value is None or (isinstance(value, list) and not value)):
            path = _PLACES.get(name, tuple(name.split(".")))
            if path == (RULES,):
                rules: dict[tuple[str, ...], object] = {
                    (RULES, rule): rule_options
                    for rule, rule_options in _rules(name, value).items()
                }
                if twice := [path[-1] for path in places.keys() & rules.keys()]:
                    raise UserError(
                        "the same rule is added and removed",
                        where="--rule, --no-rule",
                        found=listed(sorted(twice)),
                        todo="leave out one of the two options",
                    )
                places |= rules
            else:
                places[path] = _plain(value)
    return places


def _rules(option: str, value: object) -> Mapping[str, object]:
    """Return a dict from the name of each rule to its options, True or False.

    True selects the rule with its default options. False removes the rule.

    Raises:
        UserError: A value is not a rule.
    """
    if isinstance(value, Mapping) and "name" not in value:
        return {str(name): _plain(options) for name, options in value.items()}
    options_by_rule: dict[str, object] = {}
    for item in _items(value):
        choice = _named(RULES, item)
        if not isinstance(choice, dict) or not isinstance(choice.get("name"), str):
            raise UserError(
                "the list of rules contains an entry that is not a rule",
                where=RULES,
                expected="names of rules, or a mapping of names to options",
                found=repr(item),
                todo="`crossgrad plugins list --slot rules` shows all rules",
            )
        options = {key: setting for key, setting in choice.items() if key != "name"}
        options_by_rule[choice["name"]] = option != "no_rule" and (options or True)
    return options_by_rule


def _overlaid(
    settings: Settings,
    chosen: Mapping[tuple[str, ...], object],
    assigned: Sequence[tuple[tuple[str, ...], object]],
) -> Settings:
    """Return the earlier settings, overridden by the settings that were given later."""
    lengths = {*chosen, *(path for path, _ in assigned)} & {*LENGTHS}
    had = {(key,) for key, value in settings.items() if value is not None} & {*LENGTHS}
    if lengths:
        # A new length replaces all settings of the earlier length, including its time budget and
        # the step of `stop_after`.
        timed = bool(had & {("seconds",), ("planned_seconds",)}) and ("seconds",) not in lengths
        gone = had | ({("stop_after",)} if had else set()) | ({("clock",)} if timed else set())
        settings = {key: value for key, value in settings.items() if (key,) not in gone}
    settings = _opened(settings, [*chosen, *(path for path, _ in assigned)])
    # Set names first, because a new component drops the options of the previous component.
    for given in (list(chosen.items()), assigned):
        for path, value in sorted(given, key=lambda pair: not _is_name(pair[0])):
            _assign(settings, path, value)
    return settings


def _opened(settings: Settings, paths: Sequence[tuple[str, ...]]) -> Settings:
    """Return the settings without the decisions that the recipe must make again.

    The recipe makes all decisions again if the length of the run or a setting in `_DECIDING`
    changes.
    """
    opened = dict(settings)
    if {path[0] for path in paths} & {*_DECIDING, *(name for (name,) in LENGTHS)}:
        without_decided(opened)
    elif decided := opened.get("decided"):
        names = {".".join(path[:2]) for path in paths}
        opened["decided"] = {name: why for name, why in decided.items() if name not in names}
    return opened


def _named_by_default(settings: Settings) -> Settings:
    return {key: _with_default_name(key, value) for key, value in settings.items()}


def _with_default_name(key: str, value: object) -> object:
    """Return a component choice with a name; a missing name is replaced by the default name."""
    if key not in CHOICES or not isinstance(value, dict) or "name" in value:
        return value
    default = RunConfig.model_fields[key].default
    return {"name": default.name if isinstance(default, ComponentChoice) else AUTO, **value}


def _of_file(path: Path) -> Settings:
    """Return the settings of a file."""
    return unmarked(_normalized(read_mapping(path, *_FILE)), path)


def _normalized(settings: Settings) -> Settings:
    """Return the settings with every component as a mapping of its name and options."""
    named = {current_name(key, settings): value for key, value in settings.items()}
    return {key: _long_form(key, value) for key, value in named.items()}


def _long_form(key: str, value: object) -> object:
    if key in CHOICES and value is not None:
        return _choice(key, value)
    if key in LISTS and value is not None:
        return [_named(key, item) for item in _items(value)]
    return value


def _choice(key: str, value: object) -> object:
    """Return one component choice for `a`, and a list of choices for `a+b` or for a list."""
    chain = isinstance(value, list | tuple) or (isinstance(value, str) and "+" in value)
    return [_named(key, item) for item in _items(value)] if chain else _named(key, value)


def _items(value: object) -> Iterable[object]:
    """Return the parts of a chain or list; a mapping name -> options also counts as a list."""
    match value:
        case str():
            return value.split("+")
        case list() | tuple():
            return value
        case dict() if "name" not in value:
            return [_with_name(name, options) for name, options in value.items()]
        case _:
            return [value]


def _with_name(name: str, options: object) -> object:
    """Return the component choice `name` with its options; wrong options are refused later."""
    if options is None:
        return {"name": name}
    return {"name": name, **options} if isinstance(options, dict) else {name: options}


def _named(key: str, value: object) -> object:
    """Return a component choice `{"name": ..., option: ...}`; other values are refused later."""
    if isinstance(value, str):
        return {"name": value.strip()}
    kind = value if isinstance(value, type) else type(value)
    return _component(key, kind, value) if issubclass(kind, Component) else value


def _component(key: str, kind: type[Component], value: object) -> Settings:
    """Return the choice (name and options) of a component given as a class or as an instance.

    Raises:
        UserError: The component belongs to another slot, or no installed package offers it.
    """
    slot = key if key in MANY else plural(key)
    where = f"{key}, {kind.__module__}:{kind.__qualname__}"
    if getattr(kind, "slot", None) != slot:
        raise UserError(
            f"class {kind.__name__} cannot be used as {with_article(singular(slot))}",
            where=where,
            expected=f"a subclass of crossgrad_core.plugin.{singular(slot).capitalize()}",
            found=", ".join(base.__name__ for base in kind.__bases__),
            todo=f"`crossgrad plugins list --slot {slot}` shows the installed components",
        )
    entry = installed_as(kind)
    if entry is None:
        raise UserError(
            f"{singular(slot)} {kind.__name__} is not installed as a plugin",
            where=where,
            expected=f"a class that an installed package offers in the group {GROUPS[slot]}: "
            "config.yaml stores the name of each component, which is needed to resume "
            "the run",
            todo=f"`crossgrad plugins new NAME --slot {slot}` creates a package for the class",
        )
    if not isinstance(value, Component):
        return {"name": entry.name}
    return {"name": entry.name, **value.model_dump(mode="json", exclude_unset=True)}


def _plain(value: object) -> object:
    """Return a copy of a value as YAML would read it: NumPy numbers become Python numbers."""
    match value:
        case Path():
            return str(value)
        case Mapping():
            return {name: _plain(item) for name, item in value.items()}
        case list() | tuple():
            return type(value)(map(_plain, value))
    to_python = getattr(value, "item", None)
    return to_python() if callable(to_python) and getattr(value, "ndim", None) == 0 else value


def _parsed(assignment: str) -> tuple[tuple[str, ...], object]:
    key, equals, text = assignment.partition("=")
    path = tuple(part.strip() for part in key.split("."))
    if not equals or not all(path):
        raise UserError(
            "the value of --set has the wrong form",
            where="--set",
            expected="KEY=VALUE",
            found=repr(assignment),
            todo="write for example --set operator.c=0.4",
        )
    try:
        return path, read_yaml(text)
    except yaml.YAMLError as error:
        raise UserError(
            f"the value of --set {key} is not valid YAML",
            where=f"--set {key}",
            expected="a number, a word, or a quoted text",
            found=f"{text!r}: {described(error)}",
            todo="put quotes around text with special characters",
        ) from error


def _is_name(path: tuple[str, ...]) -> bool:
    return len(path) == 1 or path[-1] == "name"


def _assign(settings: Settings, path: tuple[str, ...], value: object) -> None:
    """Set the value at a path. A new component starts without the old component's options."""
    path = (current_name(path[0]), *path[1:])
    key, *rest = path
    if key in CHOICES and rest in ([], ["name"]) and isinstance(value, str | type):
        settings[key] = _renamed(settings.get(key), _choice(key, value))
    elif key in LISTS and not rest and value is not None:
        settings[key] = _extended(_in_list(_listed(settings, key)), _long_form(key, value))
    elif key == RULES and value is True and len(rest) == 1:
        used = _holder(settings, path)
        used[rest[0]] = used.get(rest[0]) or {}
    elif not rest:
        settings[key] = _long_form(key, value)
    else:
        if key in LISTS:
            settings[key] = _listed(settings, key)
        _holder(settings, path)[path[-1]] = value


def _listed(settings: Settings, key: str) -> object:
    """Return the current list of components, or the default list if the user gave no list."""
    given = settings.get(key)
    if given is not None:
        return given
    return [choice.model_dump() for choice in RunConfig.model_fields[key].default]


def _in_list(value: object) -> list[object]:
    return value if isinstance(value, list) else [value]


def _links(value: object) -> list[Settings]:
    """Return the component choices in a setting, which may be one component or a list."""
    return [choice for choice in _in_list(value) if isinstance(choice, dict)]


def _renamed(old: object, new: object) -> object:
    """Return the new choice; components whose names do not change keep their options."""
    renamed = [
        _with_options(_links(old), choice) if isinstance(choice, dict) else choice
        for choice in _in_list(new)
    ]
    return renamed if isinstance(new, list) else renamed[0]


def _with_options(old: list[Settings], new: Settings) -> Settings:
    """Return the new choice with the options of an old choice that has the same name or no name."""
    for link in old:
        if link.get("name", new["name"]) == new["name"]:
            return {**link, **new}
    return new


def _extended(old: list[object], new: object) -> list[object]:
    """Return the old list extended by the new choices.

    If both lists contain the same component, its options are merged. The later validation refuses
    values that are not component choices, and new names that occur twice.
    """
    extended, names = list(old), [link.get("name") for link in _links(new)]
    named = [(row, link) for row, link in enumerate(old) if isinstance(link, dict)]
    for choice in _in_list(new):
        options: Settings = choice if isinstance(choice, dict) else {}
        name = options.get("name")
        same = [(row, link) for row, link in named if name and link.get("name") == name]
        if same and names.count(name) == 1:
            row, link = same[0]
            extended[row] = {**link, **options}
        elif choice not in extended:
            extended.append(choice)
    return extended


def _holder(settings: Settings, path: tuple[str, ...]) -> Settings:
    """Return the dictionary that contains the last key of a path; create a missing dictionary."""
    holder: object = settings
    for depth in range(len(path) - 1):
        holder = _inner(holder, path, depth)
    match holder:
        case dict():
            return holder
        case list():
            raise _whose(holder, path)
        case _:
            raise _no_options(path, len(path) - 1)


def _inner(holder: object, path: tuple[str, ...], depth: int) -> object:
    """Return the value inside `holder` with the key `path[depth]`."""
    part = path[depth]
    match holder:
        case dict():
            left_out = path[0] == RULES and depth and holder.get(part) in (True, False)
            if holder.get(part) is None or left_out:
                holder[part] = {}
            return holder[part]
        case list():
            for link in _links(holder):
                if link.get("name") == part:
                    return link
            raise _whose(holder, path)
        case _:
            raise _no_options(path, depth)


def _no_options(path: tuple[str, ...], depth: int) -> UserError:
    return UserError(
        f"{'.'.join(path[:depth])} has no options of its own",
        where=f"--set {'.'.join(path)}",
        todo=f"set its value directly: --set {'.'.join(path[:depth])}=VALUE",
    )


def _whose(links: list[object], path: tuple[str, ...]) -> UserError:
    names = [str(link.get("name")) for link in _links(links)]
    whole = f"for all of them: --operator {CHAIN} --set 'operator.links=[{listed(names)}]'"
    return UserError(
        f"{path[0]} is a list, and the key does not say which component of the list is meant",
        where=f"--set {'.'.join(path)}",
        expected=listed(f"{path[0]}.{name}.{path[-1]}" for name in names),
        todo=f"{ADDING[path[0]]} NAME adds one" if path[0] in ADDING else whole,
    )
