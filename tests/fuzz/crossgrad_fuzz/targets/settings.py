"""Settings: YAML files and `--set` texts, up to the validated configuration of a run; grids."""

import random
from collections.abc import Sequence
from pathlib import Path

from crossgrad_core.config import RunConfig
from crossgrad_core.registry import validation
from crossgrad_core.registry.entries import build
from crossgrad_core.run import settings
from crossgrad_core.run.settings import layered, merged, parsed
from crossgrad_core.system import yaml_values
from crossgrad_core.system.yaml_values import read_mapping, read_yaml, write_yaml
from crossgrad_fuzz.case import Case
from crossgrad_fuzz.mutate import NUMBERS, matcher
from crossgrad_fuzz.target import Target
from crossgrad_plugins.sweep import grid

_FILE, _SETS = "run.yaml", "set.txt"
#: PyYAML takes half a second for 64 KiB.
_MOST_BYTES = 1 << 11
#: Runs of a grid that are listed; the search would take long over more.
_LISTED = 1000
_USER = b"""\
# A run.
scene: photos/kite
steps: 3000
backbone: {name: vanilla, sh_degree: 2}
operator: [preconditioner, {name: cagrad, c: 0.4}]
observers: [progress]
reading:
  max_size: 640
  init: points
revisions: [[10, 60]]
background: 0.1,0.2,0.3
"""
_CHAIN = (
    b"operator: pcgrad+cagrad\nobservers: {diagnostics: {every: 10}, progress: }\nseconds: 1e2\n"
)
_ALIASES = b"a: &a {x: 1}\ndata: &r {split: none}\nb: [*a, *a]\n"
_MANY = b"operator.c=0.4\noperator.name=cagrad\nviews=2\nseed=7\nobservers=progress\n"


def _seeds() -> Sequence[Case]:
    resolved = _written(RunConfig(steps=5, seed=3)).encode()
    return [
        {_FILE: _USER, _SETS: b"data.max_size=320\n"},
        {_FILE: _CHAIN, _SETS: b"operator.cagrad.c=0.3\nobservers.diagnostics.every=5"},
        {_FILE: _ALIASES, _SETS: b"data=null\n"},
        {_FILE: b"", _SETS: _MANY},
        {_FILE: b"recipe: published\n", _SETS: b"rasterizer.max_alpha=0.99\noperator=a+b\n"},
        {_FILE: resolved, _SETS: b""},
    ]


def _parse(folder: Path) -> None:
    path = folder / _SETS
    text = path.read_bytes().decode("latin-1") if path.is_file() else ""
    given = {"out": Path("runs")}
    found = merged(folder / _FILE, given, [line for line in text.split("\n") if line])
    _checked(parsed(found))
    # As the arms of a sweep are laid over its base.
    _checked(parsed(layered([found, found])))


def _written(config: RunConfig) -> str:
    return write_yaml(config.model_dump(mode="json", exclude_defaults=True))


def _checked(config: RunConfig) -> None:
    """Components validate their own options."""
    for link in config.operators:
        build("operators", link.name, link.options)
    build("backbones", config.backbone.name, config.backbone.options)


def _bomb(data: bytes, rng: random.Random) -> bytes:
    """Lists of lists of ... one list, through aliases."""
    if rng.random() < 0.9:  # Reading as many values as there may be takes long.
        return data
    levels, width = rng.randrange(2, 12), rng.randrange(2, 12)
    lines = [b"a0: &a0 [x, x, x]"]
    lines += [
        b"a%d: &a%d [%s]" % (i + 1, i + 1, b", ".join([b"*a%d" % i] * width)) for i in range(levels)
    ]
    at = data.find(b"\n", rng.randrange(len(data) + 1)) + 1
    return data[:at] + b"\n".join(lines) + b"\n" + data[at:]


def _nested(data: bytes, rng: random.Random) -> bytes:
    """Something within itself, many times."""
    opening, closing = rng.choice(((b"[", b"]"), (b"{a: ", b"}"), (b"- ", b""), (b"? ", b"")))
    depth = rng.choice((3, 20, 40, 100))
    at = rng.randrange(len(data) + 1)
    return data[:at] + opening * depth + closing * rng.choice((depth, 0)) + data[at:]


def _parse_stored(folder: Path) -> None:
    stored = read_mapping(folder / _FILE, "the configuration of the run", "start a new run")
    config = parsed(stored)
    # What a run writes down is what it reads again.
    assert parsed(dict(read_yaml(_written(config)))) == config


def _stored_seeds() -> Sequence[Case]:
    return [{_FILE: case[_FILE]} for case in (_seeds()[0], _seeds()[-1])]


def _grid_seeds() -> Sequence[Case]:
    arms = (
        b"arms:\n- {name: one, settings: {views: 1}, by_scene: {kite: {steps: 5}}}\n- name: two\n"
    )
    own = b"  parameters: {rate: {values: [1, 2]}}\n"
    nested = (
        b"parameters:\n  operator: {parameters: {c: {values: [0.4, 0.5]}}}\n  steps: {value: 9}\n"
    )
    moved = b"parameters: {seed: {values: [1, 2]}, scene: {value: kite}}\nmetric: {name: ssim}\n"
    bomb = b"".join(b"  p%d: {values: [1, 2, 3, 4, 5, 6, 7]}\n" % i for i in range(7))
    return [
        {_FILE: b"scenes: [kite, null]\nseeds: [0, 1]\n" + arms + own},
        {_FILE: b"name: small\nbase: {steps: 3}\n" + nested},
        {_FILE: moved},
        {_FILE: b"parameters:\n" + bomb},
        {_FILE: b""},
        # What is refused, one of each kind.
        {_FILE: b"parameters: {a: [1], b: {min: 1, max: 2}, c: {value: 1, values: [1]}}\n"},
        {_FILE: b"seed: 1\nseeds: [1, 1]\nparameters: {seed: {value: 1}, scene: 3}\n"},
        {_FILE: b"seeds: [1, 1]\nscenes: [a/x, b/x]\narms: [{name: x}, {name: x}]\n"},
        {_FILE: b"base: {out: x, seed: 1}\narms: [{name: x, by_scene: {y: {}}}]\n"},
        {_FILE: b"parameters: {seed: 3, scene: 4}\n"},
    ]


def _parse_grid(folder: Path) -> None:
    found = grid.read_grid(folder / _FILE)
    runs = grid._number_of_runs(found)
    assert runs <= grid.MOST_RUNS
    if runs <= _LISTED:
        labels = [choice.label for choice in grid.choices(found)]
        assert len(labels) * len(found.seeds) * len(found.scenes) == runs


_WORDS = (
    *(b"&a ", b"*a", b"<<: *a", b"!!int ", b"!!float ", b"!!python/object:os.system ", b"!x "),
    *(b"!!set ", b"!!omap ", b"!!binary ", b"!!timestamp ", b"!!null ", b"? ", b"- ", b": "),
    *(b"---\n", b"...\n", b"%YAML 1.2\n", b"%TAG ! tag:x,2000:\n", b"|\n", b">\n", b'"\\0"'),
    *(b'"\\UFFFFFFFF"', b'"\\uD800"', b".nan", b".inf", b"-.inf", b"~", b"null", b"true", b"no"),
    *(b"[", b"]", b"{", b"}", b"steps: ", b"operator: ", b"observers: ", b"data: ", b"name: "),
    *(b"operator.c=", b"data.split=every", b"observers=", b"observers.progress.level=", b"."),
    *(b"seconds: ", b"revisions: ", b"background: white", b"grouping: lists", b"cagrad", b"mean"),
)

_FORMAT = (
    matcher(rb"[:=] *([-+.\w]+)", (*NUMBERS, b"[1]", b"{a: 1}", b"'x'", b".nan", b"[]", b"{}")),
    _bomb,
    _nested,
)

SETTINGS = Target(
    name="settings",
    seeds=_seeds,
    parse=_parse,
    parser={yaml_values: (), settings: (), validation: ()},
    words=_WORDS,
    mutators=_FORMAT,
    most_bytes=_MOST_BYTES,
)
STORED = Target(
    name="stored-config",
    seeds=_stored_seeds,
    parse=_parse_stored,
    parser={yaml_values: ()},
    words=_WORDS,
    mutators=_FORMAT,
    most_bytes=_MOST_BYTES,
)
GRID = Target(
    name="sweep-grid",
    seeds=_grid_seeds,
    parse=_parse_grid,
    parser={grid: ("with_scenes",)},
    words=(*_WORDS, b"values: ", b"value: ", b"parameters: ", b"arms: ", b"seeds: ", b"scenes: "),
    mutators=_FORMAT,
    most_bytes=_MOST_BYTES,
)
TARGETS = (SETTINGS, STORED, GRID)
