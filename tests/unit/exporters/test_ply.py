"""Standard 3DGS PLY files: what is written, and what is read back from anybody's file."""

import os
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.errors import UserError
from crossgrad_plugins.exporters.file_units import position_offset
from crossgrad_plugins.exporters.ply_cloud import SplatCloud
from crossgrad_plugins.exporters.ply_file import PROPERTIES, read_ply, write_ply

UTM = Similarity(np.array([355_142.5, 5_812_377.25, 81.0]), 1 / 60)


def make_cloud(count: int = 50, seed: int = 0, rest: int = 15) -> SplatCloud:
    rng = np.random.default_rng(seed)

    def numbers(*shape: int) -> np.ndarray:
        return rng.normal(size=(count, *shape)).astype(np.float32)

    sh_rest = numbers(15, 3)
    sh_rest[:, rest:] = 0.0
    return SplatCloud(
        means=numbers(3).astype(np.float64),
        log_scales=numbers(3),
        quats=numbers(4),
        logit_opacities=numbers(),
        sh_dc=numbers(3),
        sh_rest=sh_rest,
    )


def minimal_read(path: Path) -> tuple[list[str], dict[str, np.ndarray]]:
    """An independent reader of our own kind of file: header lines and columns."""
    raw = path.read_bytes()
    end = raw.index(b"end_header\n") + len(b"end_header\n")
    header = raw[:end].decode("ascii").splitlines()
    names = [line.split()[2] for line in header if line.startswith("property")]
    table = np.frombuffer(raw[end:], dtype="<f4").reshape(-1, len(names))
    return header, {name: table[:, i] for i, name in enumerate(names)}


def write_text_ply(path: Path, columns: dict[str, np.ndarray], form: str = "ascii") -> Path:
    """Any columns in any order: ascii, or binary with the byte order of `form`."""
    count = len(next(iter(columns.values())))
    kinds = {"f4": "float", "f8": "double", "i2": "short", "u1": "uchar"}
    lines = ["ply", f"format {form} 1.0", "element camera 1", "property int id"]
    lines.append(f"element vertex {count}")
    lines += [f"property {kinds[column.dtype.str[1:]]} {name}" for name, column in columns.items()]
    head = "\n".join([*lines, "element face 0", "property list uchar int v", "end_header"]) + "\n"
    if form == "ascii":
        rows = [" ".join(repr(float(c[i])) for c in columns.values()) for i in range(count)]
        path.write_text(head + "7\n" + "\n".join(rows) + "\n")
        return path
    order = "<" if form == "binary_little_endian" else ">"
    dtype = [(name, order + column.dtype.str[1:]) for name, column in columns.items()]
    table = np.empty(count, dtype=dtype)
    for name, column in columns.items():
        table[name] = column
    path.write_bytes(head.encode() + np.array([7], dtype=order + "i4").tobytes() + table.tobytes())
    return path


def columns_of(cloud: SplatCloud, bands: int = 15) -> dict[str, np.ndarray]:
    rest = cloud.sh_rest[:, :bands].transpose(0, 2, 1).reshape(len(cloud), -1)
    columns = {f"rot_{i}": cloud.quats[:, i] for i in range(4)}
    columns |= {f"f_rest_{i}": rest[:, i] for i in reversed(range(rest.shape[1]))}
    columns |= {axis: cloud.means[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"scale_{i}": cloud.log_scales[:, i] for i in range(3)}
    columns |= {f"f_dc_{i}": cloud.sh_dc[:, i] for i in range(3)}
    return columns | {"opacity": cloud.logit_opacities}


def assert_same(a: SplatCloud, b: SplatCloud) -> None:
    for field in fields(SplatCloud):
        left, right = getattr(a, field.name), getattr(b, field.name)
        if isinstance(left, np.ndarray):
            assert left.dtype == right.dtype, field.name
            np.testing.assert_array_equal(left, right, err_msg=field.name)
        else:
            assert left == right, field.name


def test_writing_and_reading_a_ply_keeps_every_value(tmp_path: Path):
    cloud = replace(make_cloud(), render_mode="mip")
    assert write_ply(tmp_path / "a.ply", cloud) == ()
    assert_same(read_ply(tmp_path / "a.ply"), cloud)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_the_header_has_the_property_order_of_inria(tmp_path: Path):
    write_ply(tmp_path / "a.ply", make_cloud(3), comments=["step 700\nelement vertex 9", "größe"])
    header, columns = minimal_read(tmp_path / "a.ply")
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert header[2:5] == [
        "comment SplatRenderMode: default",
        "comment step 700 element vertex 9",
        "comment gr??e",
    ]
    assert header[5] == "element vertex 3"
    assert len(header) == 6 + 62 + 1
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    expected += [f"f_rest_{i}" for i in range(45)]
    expected += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert list(columns) == expected == list(PROPERTIES)
    assert not any(columns[name].any() for name in ("nx", "ny", "nz"))


def test_f_rest_is_stored_channel_by_channel(tmp_path: Path):
    cloud = make_cloud(1)
    rest = np.zeros((1, 15, 3), dtype=np.float32)
    rest[0, :, 0], rest[0, :, 1], rest[0, :, 2] = range(100, 115), range(200, 215), range(300, 315)
    write_ply(tmp_path / "a.ply", replace(cloud, sh_rest=rest))
    _, columns = minimal_read(tmp_path / "a.ply")
    written = [columns[f"f_rest_{i}"][0] for i in range(45)]
    assert written == [*range(100, 115), *range(200, 215), *range(300, 315)]


def test_positions_and_scales_return_to_input_units(tmp_path: Path):
    cloud, similarity = make_cloud(), Similarity(np.array([10.0, -4.0, 2.5]), 0.25)
    write_ply(tmp_path / "a.ply", cloud, similarity)
    _, columns = minimal_read(tmp_path / "a.ply")
    for i, axis in enumerate("xyz"):
        expected = cloud.means[:, i] * 4.0 + similarity.offset[i]
        np.testing.assert_allclose(columns[axis], expected, rtol=2e-7, atol=1e-6)
        sizes = np.exp(columns[f"scale_{i}"].astype(np.float64))
        np.testing.assert_allclose(sizes, 4.0 * np.exp(cloud.log_scales[:, i]), rtol=1e-5)
    for i in range(4):
        np.testing.assert_array_equal(columns[f"rot_{i}"], cloud.quats[:, i])
    np.testing.assert_array_equal(columns["opacity"], cloud.logit_opacities)


def test_utm_positions_keep_their_precision(tmp_path: Path):
    cloud = make_cloud(200)
    notes = write_ply(tmp_path / "a.ply", cloud, UTM)
    header, columns = minimal_read(tmp_path / "a.ply")
    # One local unit is 60 m, so the offset is rounded to tens of metres.
    assert "comment crossgrad_offset: 355140 5812380 80" in header
    assert len(notes) == 1
    assert "355140 5812380 80" in notes[0]
    assert np.abs(columns["x"]).max() < 1000
    restored = read_ply(tmp_path / "a.ply").to_local(UTM)
    assert np.abs(restored.means - cloud.means).max() < 1e-6
    np.testing.assert_allclose(restored.log_scales, cloud.log_scales, atol=2e-6)


@pytest.mark.parametrize(
    ("offset", "scale", "expected"),
    [
        ((0.0, 0.0, 0.0), 1.0, (0.0, 0.0, 0.0)),
        ((900.0, -300.0, 20.0), 1 / 60, (0.0, 0.0, 0.0)),
        ((355_142.5, 5_812_377.25, 81.0), 1 / 250, (355_100.0, 5_812_400.0, 100.0)),
        ((-400_003.0, 4.0, 0.0), 1 / 3, (-400_003.0, 4.0, 0.0)),
        ((12.3456789, 0.0, -0.00004), 5000.0, (12.3457, 0.0, 0.0)),
    ],
)
def test_an_offset_is_written_only_if_float32_is_too_coarse(
    offset: tuple[float, ...], scale: float, expected: tuple[float, ...]
):
    found = position_offset(Similarity(np.array(offset), scale))
    np.testing.assert_allclose(found, expected, rtol=1e-15)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_properties_may_have_any_order_type_and_sh_degree(tmp_path: Path, form: str, bands: int):
    cloud = make_cloud(20, rest=bands)
    columns = columns_of(cloud, bands)
    columns["junk"] = np.arange(20).astype(np.uint8)
    columns["opacity"] = np.arange(-10, 10).astype(np.int16)
    path = write_text_ply(tmp_path / "a.ply", columns, form)
    expected = replace(cloud, logit_opacities=np.arange(-10, 10, dtype=np.float32))
    assert_same(read_ply(path), expected)


def test_a_header_with_line_ends_of_other_systems_is_read(tmp_path: Path):
    cloud = make_cloud(2)
    write_ply(tmp_path / "a.ply", cloud)
    raw = (tmp_path / "a.ply").read_bytes()
    end = raw.index(b"end_header\n") + len(b"end_header\n")
    (tmp_path / "b.ply").write_bytes(raw[:end].replace(b"\n", b"\r\n") + raw[end:])
    assert_same(read_ply(tmp_path / "b.ply"), cloud)


def test_a_file_without_gaussians_is_refused(tmp_path: Path):
    write_ply(tmp_path / "a.ply", make_cloud(0))
    with pytest.raises(UserError, match=r"no Gaussians(?s:.*)0 vertices(?s:.*)to do"):
        read_ply(tmp_path / "a.ply")


def test_non_finite_gaussians_are_left_out(tmp_path: Path):
    cloud = make_cloud(5)
    cloud.means[0, 1] = np.nan
    cloud.sh_rest[3, 2, 2] = np.inf
    notes = write_ply(tmp_path / "a.ply", cloud)
    assert len(notes) == 1
    assert "2 Gaussians" in notes[0]
    assert_same(read_ply(tmp_path / "a.ply"), cloud.selected(np.array([0, 1, 1, 0, 1], dtype=bool)))


def test_a_file_larger_than_one_chunk_is_written_completely(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("crossgrad_plugins.exporters.ply_file._CHUNK", 7)
    cloud = make_cloud(50)
    write_ply(tmp_path / "a.ply", cloud)
    assert_same(read_ply(tmp_path / "a.ply"), cloud)


def break_header(raw: bytes) -> bytes:
    return raw.replace(b"property float y\n", b"property complex y\n")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda raw: raw[:0], "not a PLY file"),
        (lambda raw: b"\x89PNG\r\n" + raw, "not a PLY file"),
        (lambda raw: raw[:40], "without an end"),
        (lambda raw: raw[:-1], "is incomplete"),
        (lambda raw: raw.replace(b"vertex 4", b"vertex 4000000000"), "is incomplete"),
        (lambda raw: raw.replace(b"element vertex", b"element points"), "has no vertices"),
        (lambda raw: raw.replace(b"binary_little_endian", b"binary_middle"), "format"),
        (break_header, "property"),
        (lambda raw: raw.replace(b"float z", b"float y"), "two properties"),
        (lambda raw: raw.replace(b"float opacity", b"float density"), "no Gaussians"),
        (lambda raw: raw.replace(b"float x", b"float packed_position"), "compressed"),
        (lambda raw: raw.replace(b"f_rest_44", b"unknown"), "spherical harmonics"),
        (lambda raw: raw.replace(b"Mode: default", b"Mode: 2dgs"), "another renderer"),
        (lambda raw: raw.replace(b"SplatRenderMode:", b"crossgrad_offset:"), "coordinate offset"),
        (lambda raw: raw[:-8] + np.array([np.nan, 1], "<f4").tobytes(), "1 of 4 values of rot_2"),
        (lambda raw: raw[:-16] + bytes(16), "rotation quaternion whose length is too small"),
    ],
)
def test_damaged_files_are_refused_with_the_reason(tmp_path: Path, damage, message: str):
    write_ply(tmp_path / "a.ply", make_cloud(4))
    (tmp_path / "b.ply").write_bytes(damage((tmp_path / "a.ply").read_bytes()))
    with pytest.raises(UserError, match=message) as told:
        read_ply(tmp_path / "b.ply")
    assert "b.ply" in str(told.value)


def test_a_missing_file_is_refused_with_the_reason(tmp_path: Path):
    with pytest.raises(UserError, match="the PLY file does not exist"):
        read_ply(tmp_path / "none.ply")


def test_a_pipe_is_refused_without_waiting(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe.ply")
    with pytest.raises(UserError) as told:
        read_ply(tmp_path / "pipe.ply")
    assert told.value.found == "a pipe or device instead of a file"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: "\n".join(text.splitlines()[:-1]), "is incomplete"),
        (lambda text: text.rstrip() + " 1.0\n", "not"),
        (lambda text: text.rstrip()[:-1] + "z\n", "not"),
    ],
)
def test_damaged_ascii_files_are_refused_with_the_reason(tmp_path: Path, change, message: str):
    path = write_text_ply(tmp_path / "a.ply", columns_of(make_cloud(3)))
    path.write_text(change(path.read_text()))
    with pytest.raises(UserError, match=message):
        read_ply(path)


def test_an_interrupted_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "a.ply"
    write_ply(path, make_cloud(3))
    before = path.read_bytes()

    def fail(*_args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("crossgrad_plugins.exporters.ply_file._rows", fail)
    with pytest.raises(UserError, match="not enough disk space"):
        write_ply(path, make_cloud(9))
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["a.ply"]


def gaussians(**changes) -> Gaussians:
    rng = torch.Generator().manual_seed(1)
    base = {
        "means": torch.randn(30, 3, generator=rng),
        "quats": torch.randn(30, 4, generator=rng),
        "scales": torch.exp(torch.randn(30, 3, generator=rng) * 3),
        "opacities": torch.rand(30, generator=rng),
        "sh_dc": torch.randn(30, 1, 3, generator=rng),
        "sh_rest": torch.randn(30, 15, 3, generator=rng),
        "sh_degree": 3,
    }
    return Gaussians(**{**base, **changes})


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gaussians_converted_to_a_cloud_and_back_are_unchanged(degree: int):
    before = gaussians(sh_degree=degree, response="antialiased")
    after = SplatCloud.from_gaussians(before).to_gaussians()
    assert after.sh_degree == degree
    assert after.response == "antialiased"
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=0)
    torch.testing.assert_close(after.scales, before.scales, rtol=1e-6, atol=0)
    torch.testing.assert_close(after.opacities, before.opacities, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(after.sh_dc, before.sh_dc, rtol=0, atol=0)
    bands = (degree + 1) ** 2 - 1
    if degree:
        torch.testing.assert_close(after.sh_rest, before.sh_rest[:, :bands], rtol=0, atol=0)
    else:
        assert after.sh_rest is None


def test_extreme_opacities_and_scales_stay_finite():
    cloud = SplatCloud.from_gaussians(
        gaussians(
            opacities=torch.tensor([0.0, 1.0, 0.5] * 10),
            scales=torch.zeros(30, 3),
        )
    )
    assert np.isfinite(cloud.logit_opacities).all()
    assert np.isfinite(cloud.log_scales).all()
    opacities = cloud.to_gaussians().opacities
    torch.testing.assert_close(opacities[:3], torch.tensor([0.0, 1.0, 0.5]), atol=1e-7, rtol=0)


def test_rgb_colours_are_exported_as_sh_band_zero():
    colors = torch.rand(30, 3)
    after = SplatCloud.from_gaussians(
        gaussians(colors=colors, sh_dc=None, sh_rest=None, sh_degree=0)
    ).to_gaussians()
    drawn = 0.5 + 0.28209479177387814 * after.sh_dc[:, 0]
    torch.testing.assert_close(drawn, colors)
    assert after.sh_degree == 0
