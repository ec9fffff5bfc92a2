"""YAML as users mean it: `1e-3` is a number, `no` is a word, a key that occurs twice is an error.

PyYAML follows YAML 1.1, where `1e-3` is a string, `no` is false and `12:30` is 750.
"""

import re
from collections.abc import Hashable
from typing import Any

import yaml
from typing_extensions import override
from yaml.nodes import MappingNode, ScalarNode

_REPLACED = {f"tag:yaml.org,2002:{name}" for name in ("bool", "int", "float", "timestamp")}
_DIGITS = list("-+0123456789.")


class _Loader(yaml.SafeLoader):
    """Reads scalars by the core schema of YAML 1.2 and refuses repeated keys."""

    @override
    def construct_mapping(self, node: MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """A mapping; raises where a key occurs twice."""
        seen: set[str] = set()
        for key, _ in node.value:
            if key.value in seen:
                problem = f"the key {key.value!r} occurs twice"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _integer(_: yaml.SafeLoader, node: ScalarNode) -> int:
    return int(node.value)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _REPLACED]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF")
)
_Loader.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(r"^[-+]?[0-9]+$"), _DIGITS)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(
        r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
    ),
    _DIGITS,
)
_Loader.add_constructor("tag:yaml.org,2002:int", _integer)


def read_yaml(text: str) -> object:
    """The value that a YAML text describes.

    Raises:
        yaml.YAMLError: The text is not YAML, or a key occurs twice.
    """
    # _Loader is a SafeLoader: it builds plain data only.
    return yaml.load(text, Loader=_Loader)
