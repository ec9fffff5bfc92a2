"""PLY files of Gaussians: header, binary and ascii tables, comments."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.system import ply_table
from crossgrad_fuzz.case import Case
from crossgrad_fuzz.mutate import COUNTS, NUMBERS, matcher
from crossgrad_fuzz.target import Target
from crossgrad_plugins.exporters import file_units as units
from crossgrad_plugins.exporters import ply_file as ply
from crossgrad_plugins.exporters.ply_cloud import SplatCloud
from crossgrad_plugins.exporters.ply_file import (
    PROPERTIES,
    read_ply,
    sh_degree_of,
    write_ply,
)

_FILE = "model.ply"
_ROTATIONS = (b"0 0 0 0", b"1e30 0 0 0", b"1e-30 0 0 0", b"1 0 0 0")
_FAR = Similarity(np.array([355_142.5, 5_812_377.25, 81.0]), 1 / 60)


def _cloud(count: int) -> SplatCloud:
    rng = np.random.default_rng(0)

    def numbers(*shape: int) -> np.ndarray:
        return rng.normal(size=(count, *shape)).astype(np.float32)

    means = numbers(3).astype(np.float64)
    return SplatCloud(means, numbers(3), numbers(4), numbers(), numbers(3), numbers(15, 3))


def _written(similarity: Similarity) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / _FILE
        write_ply(path, _cloud(2), similarity, ["a comment"])
        return path.read_bytes()


def _plain(form: str, extra: str = "") -> bytes:
    """Two Gaussians of degree 0 in another order, behind a camera and before no faces."""
    names = [name for name in PROPERTIES if not name.startswith(("n", "f_rest"))][::-1]
    head = ["ply", f"format {form} 1.0", "obj_info from elsewhere", "comment SplatRenderMode: mip"]
    head += ["element camera 1", "property int id", "element vertex 2"]
    head += [f"property {'double' if name in 'xyz' else 'float'} {name}" for name in names]
    head += [*extra.split("\n"), "element face 0", "property list uchar int v", "end_header"]
    text = "\n".join(line for line in head if line) + "\n"
    if form == "ascii":
        row = " ".join(["0.5"] * len(names))
        return f"{text}7\n{row}\n{row}\n".encode()
    order = "<" if "little" in form else ">"
    kinds = [(name, f"{order}{'f8' if name in 'xyz' else 'f4'}") for name in names]
    table = np.zeros(2, dtype=kinds)
    for name in names:
        table[name] = 0.5
    return text.encode() + np.array([7], f"{order}i4").tobytes() + table.tobytes()


def _bare() -> bytes:
    """One Gaussian in letters, and nothing that could be left out."""
    names = [name for name in PROPERTIES if not name.startswith(("n", "f_rest"))]
    head = ["ply", "format ascii 1.0", "element vertex 1"]
    head += [f"property float {name}" for name in names]
    return ("\n".join([*head, "end_header", " ".join(["0.5"] * len(names))]) + "\n").encode()


def _seeds() -> Sequence[Case]:
    files = [
        *(_written(Similarity(np.zeros(3), 1.0)), _written(_FAR), _plain("ascii")),
        *(_plain("binary_big_endian"), _plain("binary_little_endian")),
        *(_plain("ascii", "comment x"), _bare()),
    ]
    return [{_FILE: content} for content in files]


def _parse(folder: Path) -> None:
    degree = sh_degree_of(folder / _FILE)
    cloud = read_ply(folder / _FILE)
    assert 0 <= cloud.sh_degree <= degree <= 3
    assert len(cloud) > 0
    shapes = ((3,), (3,), (4,), (), (3,), (15, 3))
    arrays = (
        *(cloud.means, cloud.log_scales, cloud.quats, cloud.logit_opacities),
        *(cloud.sh_dc, cloud.sh_rest),
    )
    for array, shape in zip(arrays, shapes, strict=True):
        assert array.shape == (len(cloud), *shape)
        assert np.isfinite(array).all()
    gaussians = cloud.to_gaussians()
    assert gaussians.scales.isfinite().all()
    assert gaussians.means.isfinite().all()


TARGET = Target(
    name="ply",
    seeds=_seeds,
    parse=_parse,
    parser={
        ply: ("write_ply", "_header", "_rows"),
        units: ("position_offset", "representable", "plain_number"),
        ply_table: (),
    },
    words=(
        *(b"element vertex 2\n", b"element face 3\n", b"property float x\n", b"end_header\n"),
        *(
            b"property list uchar int v\n",
            b"comment crossgrad_offset: 1 2 3\n",
            b"format ascii 1.0",
        ),
        *(b"binary_little_endian", b"binary_big_endian", b"ascii", b"comment", b"obj_info"),
        *(b"float", b"double", b"uchar", b"int8", b"uint16", b"short", b"int", b"uint"),
        *(b" x\n", b" y\n", b" opacity\n", b" rot_0\n", b" f_rest_0\n", b" packed_position\n"),
        *(b"SplatRenderMode: mip", b"SplatRenderMode: 2dgs", b"vertex", b"element", b"property"),
    ),
    mutators=(
        matcher(rb"element \w+ (\S+)", COUNTS),
        matcher(rb"element (?:vertex|camera) (\S+)", COUNTS),
        matcher(rb"property (\w+) ", (b"float", b"double", b"uchar", b"list", b"int", b"bool")),
        matcher(rb"crossgrad_offset: (\S+)", NUMBERS),
        matcher(rb"SplatRenderMode: (\w+)", (b"default", b"2dgs", b"mip")),
        matcher(rb"\n((?:0\.5 ){3}0\.5) ", _ROTATIONS),
        matcher(rb" ((?:0\.5 ){3}0\.5)\n", _ROTATIONS),
    ),
)
TARGETS = (TARGET,)
