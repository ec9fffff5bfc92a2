"""Functions that read and write YAML 1.2: `1e-3` is a number, and `no` is a word.

PyYAML follows YAML 1.1, where `1e-3` is a string, `no` is false and `12:30` is 750. PyYAML also
sets no limits on the length of numbers and on the depth of lists. With aliases, a file of a few
hundred bytes can contain a billion copies of one list. This module builds the values from PyYAML's
parse tree and limits their number and depth. A repeated key is an error.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from math import isnan
from pathlib import Path
from typing import Any, Final

import yaml
from typing_extensions import override
from yaml.error import Mark
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from crossgrad_core.errors import UserError
from crossgrad_core.system.input_files import open_file

#: Limits of a YAML text: number of bytes, number of values, nesting depth of lists and mappings,
#: and number of digits of a number. Each alias counts like the values that it copies.
MOST_BYTES: Final = 1 << 18
MOST_VALUES: Final = 10_000
DEEPEST: Final = 32
MOST_DIGITS: Final = 300

_TAG = "tag:yaml.org,2002:"
_DIGITS = list("-+0123456789.")
_REPLACED = {f"{_TAG}{name}" for name in ("bool", "int", "float", "timestamp", "merge", "value")}
_BOOL = re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$")
_INT = re.compile(r"^[-+]?[0-9]+$")
_FLOAT = re.compile(
    r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)
_NULL = re.compile(r"^(?:~|null|Null|NULL|)$")
_LINE_ENDS = re.compile("[\r\n\x85\u2028\u2029]")
# The characters \udc80 to \udcff are allowed, because they represent bytes of file names that are
# not UTF-8.
_IMPOSSIBLE = re.compile("[\0\ud800-\udc7f\udd00-\udfff]")


class _Loader(yaml.SafeLoader):
    """A loader with the core schema of YAML 1.2 and bounds on the number and depth of values."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._values = 0

    @override
    def compose_node(self, parent: Node | None, index: int) -> Node | None:
        """Return the next node; raise an error if there are too many nodes or nesting levels."""
        mark: Mark | None = self.peek_event().start_mark  # type: ignore[no-untyped-call]
        self._depth += 1
        self._values += 1
        if self._depth > DEEPEST:
            raise _error(f"lists or mappings are nested more than {DEEPEST} levels deep", mark)
        if self._values > MOST_VALUES:
            raise _error(f"the file contains more than {MOST_VALUES:,} values", mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


class _Dumper(yaml.SafeDumper):
    """A dumper that quotes words which YAML 1.1 or 1.2 would not read as strings."""

    @override
    def ignore_aliases(self, data: object) -> bool:
        return True


def _represented(dumper: _Dumper, text: str) -> ScalarNode:
    # Use double quotes for text with line ends, because PyYAML otherwise writes Unicode line ends
    # unescaped and reads these line ends as spaces.
    style = '"' if _LINE_ENDS.search(text) else None
    return dumper.represent_scalar(f"{_TAG}str", text, style)


_Dumper.add_representer(str, _represented)
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _REPLACED]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _class in (_Loader, _Dumper):
    _class.add_implicit_resolver(f"{_TAG}bool", _BOOL, list("tTfF"))
    _class.add_implicit_resolver(f"{_TAG}int", _INT, _DIGITS)
    _class.add_implicit_resolver(f"{_TAG}float", _FLOAT, _DIGITS)


def read_yaml(text: str) -> object:
    """Return the value of a YAML text as plain data; aliases become copies.

    Raises:
        yaml.YAMLError: The text is not YAML, exceeds a limit, contains a key twice, or contains a
            value that a setting cannot have.
    """
    if len(text) > MOST_BYTES:
        raise yaml.YAMLError(f"the file is larger than {MOST_BYTES // 1024} KiB")
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        return None if node is None else _Values().of(node, 0)
    except (ValueError, OverflowError) as error:
        # PyYAML raises these errors for escapes beyond Unicode and for extremely large numbers.
        raise yaml.YAMLError(f"an escape sequence or number is not valid ({error})") from error
    finally:
        loader.dispose()


def read_mapping(path: Path, what: str, todo: str) -> dict[str, Any]:
    """Return the mapping in a YAML file; an empty file gives an empty mapping.

    Args:
        path: The file.
        what: Name of the content for an error message, such as `the grid`.
        todo: Advice for an error message.

    Raises:
        UserError: The file is missing, is not YAML, or contains something other than a mapping.
    """
    try:
        with open_file(path) as file:
            settings = read_yaml(file.read(MOST_BYTES + 1).decode("utf-8-sig"))
    except (OSError, UnicodeDecodeError) as error:
        found = getattr(error, "strerror", None) or str(error)
        raise UserError(f"{what} cannot be read", where=path, found=found, todo=todo) from error
    except yaml.YAMLError as error:
        found = described(error)
        raise UserError(f"{what} is not valid YAML", where=path, found=found, todo=todo) from error
    if settings is None:
        return {}
    if not isinstance(settings, dict):
        raise UserError(
            f"{what} contains no settings",
            where=path,
            expected="lines such as `steps: 3000`",
            found=f"a {type(settings).__name__}",
            todo=todo,
        )
    return settings


def described(error: yaml.YAMLError) -> str:
    """Return one line about an error in a YAML text, with the position of the error."""
    if not isinstance(error, yaml.MarkedYAMLError):
        return " ".join(str(error).split())
    text = ", ".join(phrase for phrase in (error.context, error.problem) if phrase)
    mark = error.problem_mark or error.context_mark
    return f"{text} (line {mark.line + 1}, column {mark.column + 1})" if mark else text


def write_yaml(settings: Mapping[str, Any]) -> str:
    """Return the text from which `read_yaml` restores plain data."""
    text: str = yaml.dump(settings, Dumper=_Dumper, sort_keys=False, allow_unicode=True)
    return text


class _Values:
    """A builder of plain data from nodes; the values of aliases are copied and count again."""

    def __init__(self) -> None:
        self._count = 0

    def of(self, node: Node, depth: int) -> object:
        """Return the value of a node."""
        self._count += 1
        if self._count > MOST_VALUES:
            raise _error(
                f"the file contains more than {MOST_VALUES:,} values, including aliases",
                node.start_mark,
            )
        if depth > DEEPEST:
            raise _error(f"values are nested more than {DEEPEST} levels deep", node.start_mark)
        name = node.tag.removeprefix(_TAG)
        match node:
            case MappingNode() if name == "map":
                return dict(self._items(node, depth))
            case SequenceNode() if name == "seq":
                return [self.of(item, depth + 1) for item in node.value]
            case ScalarNode() if name in _SCALARS:
                return _scalar(node, name)
        raise _error(f"the tag {node.tag} is not supported", node.start_mark)

    def _items(self, node: MappingNode, depth: int) -> Iterator[tuple[str, object]]:
        seen: set[str] = set()
        for key, value in node.value:
            if not isinstance(key, ScalarNode):
                raise _error("a key is not a string", key.start_mark)
            name = _scalar(key, "str")
            if name in seen:
                raise _error(f"the key {name!r} occurs twice", key.start_mark)
            seen.add(str(name))
            yield str(name), self.of(value, depth + 1)


def _word(text: str) -> str:
    if _IMPOSSIBLE.search(text):
        raise ValueError("the file contains a character that is not allowed")
    return text


def _integer(text: str) -> int:
    if len(text) > MOST_DIGITS:
        raise ValueError("the file contains a number with too many digits")
    return int(text)


def _float(text: str) -> float:
    # Remove the dot, because YAML's `.inf` is `inf` in Python.
    value = float(text.replace(".", "", 1) if text.lower().endswith((".inf", ".nan")) else text)
    if isnan(value):
        raise ValueError("a value is NaN, which is not allowed in settings")
    return value


#: Name of a YAML tag -> pattern of valid values, and the function that builds a value.
_SCALARS: Final[dict[str, tuple[re.Pattern[str], Callable[[str], object]]]] = {
    "str": (re.compile("", re.DOTALL), _word),
    "null": (_NULL, lambda _: None),
    "bool": (_BOOL, lambda text: text.lower() == "true"),
    "int": (_INT, _integer),
    "float": (_FLOAT, _float),
}


def _scalar(node: ScalarNode, name: str) -> object:
    pattern, build = _SCALARS[name]
    try:
        if not pattern.match(node.value):
            raise _error(f"{node.value!r} is not a valid {name}", node.start_mark)
        return build(node.value)
    except ValueError as error:
        raise _error(str(error), node.start_mark) from error


def _error(problem: str, mark: Mark | None) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=mark)
