"""Inputs on which a parser once failed; every search begins with them, and every test run has them.

A new finding is written here as a change of a valid input, with a name that says what was wrong.
"""

import json
import struct
from collections.abc import Callable, Mapping, Sequence

from crossgrad_core.run.checkpoint import digest
from crossgrad_fuzz.case import Case
from crossgrad_fuzz.targets import TARGETS

#: Valid inputs -> the one that failed.
Change = Callable[[Sequence[Case]], Case]


def _replaced(seed: int, file: str, old: bytes, new: bytes) -> Change:
    """The valid input number `seed` with a piece of one file replaced."""

    def change(seeds: Sequence[Case]) -> Case:
        content = seeds[seed][file]
        assert old in content, (file, old)
        return {**seeds[seed], file: content.replace(old, new, 1)}

    return change


def _file(file: str, content: bytes) -> Change:
    """One file of the first valid input with other content."""
    return lambda seeds: {**seeds[0], file: content}


def _without(seed: int, file: str) -> Change:
    return lambda seeds: {name: data for name, data in seeds[seed].items() if name != file}


_BOMB = b"a: &a [x, x, x, x, x, x, x, x, x]\n" + b"".join(
    b"%c: &%c [%s]\n" % (new, new, b", ".join([b"*%c" % old] * 9))
    for old, new in zip(b"abcdefgh", b"bcdefghi", strict=True)
)
_LONG_HEADER = b"ply\nformat ascii 1.0\n" + b"comment\n" * 10_000 + b"end_header\n"
_STATE = "checkpoints/step-000007/state.json"
_PLY, _YAML = "model.ply", "run.yaml"


def _endless_track(seeds: Sequence[Case]) -> Case:
    """A point whose track has more elements than can be counted."""
    points = seeds[0]["points3D.bin"]
    return {**seeds[0], "points3D.bin": points[:51] + struct.pack("<Q", 2**63) + points[59:]}


def _twice(seeds: Sequence[Case]) -> Case:
    """Two points of one id, two cameras of one id."""
    content = seeds[0]["points3D.bin"]
    length = struct.unpack_from("<Q", content, 51)[0]
    record = content[8 : 59 + 8 * length]
    count = struct.pack("<Q", struct.unpack_from("<Q", content)[0] + 1)
    return {**seeds[0], "points3D.bin": count + record + content[8:]}


def _state_without(*keys: str) -> Change:
    """Return a change that removes a value from the state, whose digest is made right again."""

    def change(seeds: Sequence[Case]) -> Case:
        state = json.loads(seeds[0][_STATE])
        inner = state
        for key in keys[:-1]:
            inner = inner[key]
        del inner[keys[-1]]
        state["state_sha256"] = digest(state)
        return {**seeds[0], _STATE: json.dumps(state).encode()}

    return change


def _large(seed: int, at: int, size: bytes, room: int) -> Change:
    """A photo of another size, in a file that is so much longer."""

    def change(seeds: Sequence[Case]) -> Case:
        content = seeds[seed]["photo.img"]
        at_size = content.index(b"\xff\xc0") + 5 if at < 0 else at
        changed = content[:at_size] + size + content[at_size + len(size) :]
        return {"photo.img": changed + bytes(room)}

    return change


REGRESSIONS: Mapping[str, Mapping[str, Change]] = {
    "ply": {
        "digits of another script": _replaced(2, _PLY, b"vertex 2", "vertex ٢".encode()),
        "a digit that is no number": _replaced(2, _PLY, b"vertex 2", "vertex ²".encode()),
        "a count of 5,000 digits": _replaced(2, _PLY, b"vertex 2", b"vertex " + b"9" * 5000),
        "a count above 2^63 (ascii)": _replaced(
            2, _PLY, b"vertex 2", b"vertex 9223372036854775808"
        ),
        "a count above 2^63 before": _replaced(2, _PLY, b"camera 1", b"camera 9223372036854775808"),
        "no vertices": _replaced(2, _PLY, b"vertex 2", b"vertex 0"),
        "no vertices (binary)": _replaced(4, _PLY, b"vertex 2", b"vertex 0"),
        "digit groups": _replaced(2, _PLY, b"\n0.5 ", b"\n1_0 "),
        "a size that is infinite": _replaced(2, _PLY, b"0.5 0.5 0.5 0.5 0.5", b"99 99 99 99 99 "),
        "an endless header": _file(_PLY, _LONG_HEADER),
        "no such file": _without(0, _PLY),
        "vertices without properties": _file(
            _PLY, b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nend_header\n"
        ),
        "an offset in other digits": _replaced(1, _PLY, b"355140", "٣٥".encode()),
    },
    "colmap-binary": {
        "a track that is too long to count": _endless_track,
        "two points of one id": _twice,
    },
    "colmap-text": {
        "a negative width": _replaced(0, "cameras.txt", b" 24 16 ", b" -24 16 "),
        "a line that is cut short": _replaced(0, "cameras.txt", b"PINHOLE", b"PINHOLE24 16"),
        "no cameras": _file("cameras.txt", b""),
    },
    "scene": {
        "a name that leads nowhere": _replaced(3, "sparse/1/images.txt", b"0000.png", b"."),
        "a name that is too long": _replaced(3, "sparse/1/images.txt", b"0000.png", b"a" * 300),
        "a name that is not UTF-8": _replaced(3, "sparse/1/images.txt", b"0000.png", b"\xff.png"),
        "a name that moves the cursor": _replaced(
            3, "sparse/1/images.txt", b"0000.png", b"\x1b[2J.png"
        ),
    },
    "nerfstudio-scene": {
        "points of a name that is too long": _replaced(
            0, "transforms.json", b"cloud.ply", b"[" * 2000
        ),
    },
    "photo-headers": {
        "a JPEG of too many pixels": _large(0, -1, struct.pack(">HH", 1100, 1000), 3000),
        "a BMP of too many pixels": _large(14, 18, struct.pack("<ii", 2000, 1000), 0),
    },
    "photos": {
        "a chunk that claims gigabytes": _replaced(3, "photo.img", b"\0\0\4", b"\x7f\xff\4"),
        "a BMP of too many pixels": _large(14, 18, struct.pack("<ii", 2000, 1000), 0),
    },
    "settings": {
        "a bomb of aliases": _file(_YAML, _BOMB),
        "a list within itself": _file(_YAML, b"a: &a [*a]\n"),
        "lists without an end": _file(_YAML, b"a: " + b"[" * 5000),
        "a list as a key": _file(_YAML, b"? [a]\n: 1\n"),
        "a number that is none": _file(_YAML, b"steps: !!int abc\n"),
        "a truth that is none": _file(_YAML, b"steps: !!bool abc\n"),
        "a date that is none": _file(_YAML, b"steps: !!timestamp abc\n"),
        "a character beyond Unicode": _file(_YAML, b'a: "\\UFFFFFFFF"\n'),
        "half a character": _file(_YAML, b'scene: "\\uD800"\n'),
        "a path that no system takes": _file(_YAML, b'scene: "a\\0b"\n'),
        "a number of 5,000 digits": _file(_YAML, b"seed: " + b"9" * 5000),
        "options that are a number": _file(_YAML, b"observers: {progress: 3}\n"),
        "a setting of control characters": _file("set.txt", b"\0" * 2000 + b"=\0"),
        "infinite seconds": _file(_YAML, b"seconds: .inf\n"),
        "more than any settings": _file(_YAML, b"# \n" * 100_000),
        "a list of too many": _file(_YAML, b"a: [" + b"0," * 10_001 + b"]\n"),
    },
    "stored-config": {
        "a list": _file(_YAML, b"- 1\n"),
        "not UTF-8": _file(_YAML, b"\xff\xfe"),
        "a setting without a name": _file(_YAML, b"? \n"),
        "more than any settings": _file(_YAML, b"# \n" * 100_000),
        "a list of too many": _file(_YAML, b"a: [" + b"0," * 10_001 + b"]\n"),
    },
    "checkpoint": {
        "lists without an end": _file(_STATE, b"[" * 5000),
        "no random numbers": _state_without("generators", "sampler"),
        "no clock": _state_without("scalars", "clock"),
        "no step": _state_without("step"),
    },
    "labels": {"not UTF-8": _file("labels.csv", b"\xff"), "no end": _file("labels.csv", b'"a,b\n')},
    "metrics": {
        "not UTF-8": _file("metrics.csv", b"step\n\xff\n"),
        "a step that is none": _replaced(0, "metrics.csv", b"\n200,", b"\nx,"),
        "a step before the first": _replaced(0, "metrics.csv", b"\n200,", b"\n-2,"),
    },
    "diagnostics-table": {
        "more cells than columns": _file("table.csv", b"step\n3,4\n"),
        "not UTF-8": _file("table.csv", b"\xff\n"),
    },
    "scene-file": {
        "a scene without extent": _replaced(0, "scene.json", b'"scale": 0.5', b'"scale": 0.0'),
    },
    "lock": {"lists without an end": _file("run.lock", b"[" * 5000)},
    "rows": {
        "lists without an end": _file("rows.txt", b"[" * 5000),
        "a number that no float can be": _file("rows.txt", b"[[1" + b"0" * 400 + b"]]"),
        "not a number": _file("rows.txt", b"[[NaN, 1]]"),
        "more than float32 can hold": _file("rows.txt", b"[[1e39, 1]]"),
    },
    "camera-path": {
        "an axis whose square overflows": _replaced(0, "named.json", b"[1.0", b"[1e308"),
        "too narrow a view": _replaced(0, "named.json", b"50", b"1e-320"),
    },
    "summary": {
        "lists without an end": _file("summary.json", b"[" * 5000),
        "no object": _file("summary.json", b"3"),
    },
}


def known_of(name: str) -> list[Case]:
    """The inputs on which this parser once failed."""
    changes = REGRESSIONS.get(name, {})
    seeds = TARGETS[name].seeds() if changes else ()
    return [change(seeds) for change in changes.values()]
