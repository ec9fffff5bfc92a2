"""A run's configuration as flat settings, without what tells no arms apart."""

from collections.abc import Iterator, Mapping
from typing import Any, Final, TypeAlias

#: A value of a setting as text, such as `0.4`, `scaffold` or `pcgrad+soft`.
Settings: TypeAlias = dict[str, str]

#: The value of a setting that is not set.
ABSENT: Final = "-"
#: Where a run lies, how long it is, and what only watches it.
_NO_ARM: Final = frozenset(
    {
        *("crossgrad", "scene", "seed", "out"),
        *("steps", "max_views", "seconds", "revisions", "planned_seconds", "stop_after", "clock"),
        *("eval_every", "eval_from", "save_every", "threads", "max_nonfinite_blocks"),
        *("observers", "metrics", "exporter"),
        *("data.cache_mib", "data.disk_mib", "data.masks"),
    }
)


def settings_of(config: Mapping[str, Any]) -> Settings:
    """Setting -> value, of those that can make an arm.

    A setting that is null is not set: its value is `-`. A component is `backbone` and its options
    `backbone.sh_degree`; a chain of operators is `operator` with the names joined by `+`, and its
    options `operator.1.c`.
    """
    return {
        name: _text(value)
        for name, value in _flat("", config)
        if not _NO_ARM & {name, name.partition(".")[0]}
    }


def _flat(name: str, value: object) -> Iterator[tuple[str, object]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _flat(name if key == "name" and name else f"{name}.{key}".strip("."), inner)
    elif isinstance(value, list) and any(isinstance(each, Mapping) for each in value):
        links = [each for each in value if isinstance(each, Mapping)]
        yield name, "+".join(str(link.get("name")) for link in links)
        for number, link in enumerate(links):
            options = {key: inner for key, inner in link.items() if key != "name"}
            yield from _flat(f"{name}.{number}", options)
    else:
        yield name, value


def _text(value: object) -> str:
    if value is None:
        return ABSENT
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return ",".join(_text(each) for each in value)
    return str(value)
