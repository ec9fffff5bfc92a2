"""SPZ, GLB, 3D Tiles and USD: other programs read what is written, and damage is refused."""

import errno
import gzip
import json
import struct
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch
from support.splat_files import SAME, UTM, content, gaussians, glb_of, rotation_error

from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.contract.slots.exporter import Exporter
from crossgrad_core.errors import UserError
from crossgrad_plugins.exporters.glb import Glb
from crossgrad_plugins.exporters.spz import Spz
from crossgrad_plugins.exporters.tiles import Tiles
from crossgrad_plugins.exporters.usd import Usd

SPLATS = "KHR_gaussian_splatting"


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gsply_reads_the_fields_of_an_spz_file_within_its_steps(tmp_path: Path, degree, version):
    given, path = gaussians(degree), tmp_path / "a.spz"
    exporter = Spz(version=version)
    assert exporter.write(content(given), path) == ()
    found = gsply.read_spz(path)
    header = gzip.decompress(path.read_bytes())[:16]
    assert struct.unpack("<4sIIB", header[:13]) == (b"NGSP", version, 500, degree)
    np.testing.assert_allclose(found.means, given.means, atol=2.0**-18)
    np.testing.assert_allclose(found.scales, given.scales.log(), atol=1 / 32 + 1e-6)
    opacities = 1 / (1 + np.exp(-found.opacities.astype(float)))
    np.testing.assert_allclose(opacities, given.opacities, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found.sh0, given.sh_dc[:, 0], atol=0.5 / 255 / 0.15 + 1e-6)
    # Version 2 leaves the largest error where the number that it does not store is small.
    assert rotation_error(found.quats, given.quats) < (0.2 if version == 2 else 4e-3)
    if degree:
        assert given.sh_rest is not None
        off = np.abs(found.shN[:, : given.sh_rest.shape[1]] - given.sh_rest.numpy())
        assert off[:, :3].max() <= 4 / 128 and off[:, 3:].max(initial=0) <= 8 / 128
        assert off.max() > 1 / 128  # The steps are as coarse as the format's usual ones.


@pytest.mark.parametrize("make", [Spz, lambda: Spz(version=3), Glb], ids=["spz2", "spz3", "glb"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_reading_gives_what_the_exporter_says_it_stores(tmp_path: Path, make, degree):
    exporter, given = make(), gaussians(degree)
    path = tmp_path / f"a.{exporter.suffix}"
    exporter.write(content(given), path)
    stored, found = exporter.stored(given, SAME), exporter.read(path, SAME)
    assert exporter.sh_degree_of(path) == found.sh_degree == degree
    for name in ("means", "scales", "opacities", "sh_dc", "sh_rest"):
        torch.testing.assert_close(getattr(found, name), getattr(stored, name))
    assert rotation_error(found.quats, stored.quats) < 1e-3


def test_an_spz_file_has_the_flag_of_antialiased_gaussians(tmp_path: Path):
    for response in ("plain", "antialiased"):
        Spz().write(content(replace(gaussians(), response=response)), tmp_path / "a.spz")
        assert gzip.decompress((tmp_path / "a.spz").read_bytes())[14] == (response != "plain")
        assert Spz().read(tmp_path / "a.spz", SAME).response == response


def attributes_of(path: Path) -> dict[str, np.ndarray]:
    """Name -> numbers of the only primitive, read by the rules of glTF."""
    document, binary = glb_of(path)
    found = {}
    for name, number in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][number]
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        values = np.frombuffer(binary, kind, accessor["count"] * width, start)
        found[name] = values.reshape(-1, width)
    return found


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_glb_file_has_the_attributes_of_the_extension(tmp_path: Path, degree):
    given, path = gaussians(degree), tmp_path / "a.glb"
    Glb().write(content(given), path)
    document, _ = glb_of(path)
    assert document["extensionsUsed"] == [SPLATS]
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"][SPLATS]["kernel"] == "ellipse"
    assert primitive["extensions"][SPLATS]["colorSpace"] == "srgb_rec709_display"
    found = attributes_of(path)
    np.testing.assert_array_equal(found["POSITION"], given.means)
    np.testing.assert_allclose(found[f"{SPLATS}:SCALE"], given.scales, rtol=1e-6)
    np.testing.assert_allclose(found[f"{SPLATS}:OPACITY"][:, 0], given.opacities, atol=1e-6)
    turned = found[f"{SPLATS}:ROTATION"][:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1, atol=1e-6)
    assert rotation_error(turned, given.quats) < 1e-3
    bands = {0: given.sh_dc, 1: given.sh_rest}
    names = [
        f"{SPLATS}:SH_DEGREE_{band}_COEF_{number}"
        for band in range(degree + 1)
        for number in range(2 * band + 1)
    ]
    expected = torch.cat([band for band in bands.values() if band is not None], dim=1)
    for number, name in enumerate(names):
        np.testing.assert_array_equal(found[name], expected[:, number])
    assert len(found) == 5 + len(names)
    drawn = (given.sh_dc[:, 0] * 0.28209479 + 0.5).clamp(0, 1) * 255
    np.testing.assert_allclose(found["COLOR_0"][:, :3], drawn, atol=0.51)


def test_a_glb_file_of_another_writer_is_read_with_its_nodes(tmp_path: Path):
    """Normalised bytes, nested nodes that turn, scale and move, and two primitives."""
    given, path = gaussians(0, 4), tmp_path / "a.glb"
    Glb().write(content(given), path)
    document, binary = glb_of(path)
    document["nodes"] = [
        {"children": [1], "rotation": [0, 0, 2**-0.5, 2**-0.5], "scale": [2, 2, 2]},
        {"mesh": 0, "translation": [10, 0, 0]},
    ]
    document["meshes"][0]["primitives"] *= 2
    opacity = document["meshes"][0]["primitives"][0]["attributes"][f"{SPLATS}:OPACITY"]
    start = len(binary)
    document["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": 4})
    document["accessors"][opacity] |= {
        "bufferView": len(document["bufferViews"]) - 1, "componentType": 5121, "normalized": True,
    }  # fmt: skip
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes([0, 51, 102, 255])
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    found = Glb().read(path, Similarity(np.array([1.0, 2.0, 3.0]), 0.5))
    x, y, z = (given.means + torch.tensor([10.0, 0, 0])).T * 2
    expected = (torch.stack([-y, x, z], 1) - torch.tensor([1.0, 2.0, 3.0])) * 0.5
    torch.testing.assert_close(found.means, expected.repeat(2, 1), atol=1e-5, rtol=0)
    torch.testing.assert_close(found.scales, given.scales.repeat(2, 1))
    opacities = torch.tensor([0, 0.2, 0.4, 1.0])
    torch.testing.assert_close(found.opacities, opacities.repeat(2), atol=1e-6, rtol=0)


@pytest.mark.parametrize("make", [Spz, Glb, Tiles, Usd], ids=["spz", "glb", "tiles", "usd"])
def test_map_coordinates_are_stored_to_a_millionth_of_the_scene(tmp_path: Path, make):
    exporter, given = make(), gaussians(0)
    rounding = exporter.rounding(given, UTM)
    assert 0 < rounding.largest <= 60 * 5e-6
    # Only SPZ has no field for the offset; `.georef.json` names it.
    assert bool(rounding.offset.any()) == (make is Spz)
    if make is Glb:
        exporter.write(content(given, UTM), tmp_path / "a.glb")
        found = exporter.read(tmp_path / "a.glb", UTM)
        torch.testing.assert_close(found.means, given.means, atol=2e-6, rtol=0)


@pytest.mark.parametrize("degree", [0, 3])
def test_usd_reads_the_fields_of_a_usdz_file(tmp_path: Path, degree):
    from pxr import Usd as Library
    from pxr import UsdGeom, UsdVol

    given, path = gaussians(degree), tmp_path / "a.usdz"
    to_ecef = np.diag([3.0, 3.0, 3.0, 1.0])
    Usd().write(content(given, UTM, up=np.array([0.0, 0, 1]), to_ecef=to_ecef), path)
    stage = Library.Stage.Open(str(path))
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == pytest.approx(3.0)
    moved = np.array(UsdGeom.Xformable(splats).ComputeLocalToWorldTransform(0))[3, :3]
    positions = UTM.to_local(np.array(splats.GetPositionsAttr().Get(), float) + moved)
    np.testing.assert_allclose(positions, given.means, atol=2e-6)
    np.testing.assert_allclose(splats.GetScalesAttr().Get(), given.scales * 60, rtol=1e-5)
    np.testing.assert_allclose(splats.GetOpacitiesAttr().Get(), given.opacities, atol=1e-6)
    turned = [[q.GetReal(), *q.GetImaginary()] for q in splats.GetOrientationsAttr().Get()]
    assert rotation_error(turned, given.quats) < 1e-3
    assert splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == degree
    bands = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    bands = bands.reshape(500, -1, 3)
    np.testing.assert_array_equal(bands[:, 0], given.sh_dc[:, 0])
    if degree:
        np.testing.assert_array_equal(bands[:, 1:], given.sh_rest)
    assert [item.name for item in tmp_path.iterdir()] == ["a.usdz"]


def test_without_usd_core_the_error_names_the_extra(tmp_path: Path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    with pytest.raises(UserError, match=r"pip install .crossgrad\[usd\]"):
        Usd().write(content(gaussians(0)), tmp_path / "a.usdz")
    assert not [*tmp_path.iterdir()]


def cut(raw: bytes) -> bytes:
    return raw[: len(raw) // 2]


def other_version(raw: bytes) -> bytes:
    plain = gzip.decompress(raw)
    return gzip.compress(plain[:4] + struct.pack("<I", 4) + plain[8:])


def no_splats(raw: bytes) -> bytes:
    return raw.replace(b'"KHR_gaussian_splatting":', b'"XHR_gaussian_splatting":')


@pytest.mark.parametrize(
    ("make", "damage", "message"),
    [
        (Spz, cut, "not a complete SPZ file"),
        (Spz, lambda raw: b"ply" + raw, "not a complete SPZ file"),
        (Spz, lambda raw: gzip.compress(gzip.decompress(raw)[:16]), "not a complete SPZ file"),
        (Spz, lambda _: gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 2, 2**31, 3, 12, 0, 0)),
         "not a complete SPZ file"),
        (Spz, other_version, "version 4"),
        (Glb, cut, "not a complete GLB file"),
        (Glb, lambda raw: b"x" + raw[1:], "not a complete GLB file"),
        (Glb, no_splats, "contains no Gaussians"),
        (Glb, lambda raw: raw.replace(b'"VEC4"', b'"MAT4"'), "not a complete GLB file"),
        (Glb, lambda raw: raw.replace(b":SCALE", b":SCALX"), "not a complete GLB file"),
    ],
)  # fmt: skip
def test_damaged_files_are_refused_with_the_reason(tmp_path: Path, make, damage, message):
    exporter: Exporter = make()
    path = tmp_path / f"a.{exporter.suffix}"
    exporter.write(content(gaussians(1, 20)), path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(UserError, match=message):
        exporter.read(path, SAME)


@pytest.mark.parametrize("make", [Spz, Glb, Tiles, Usd], ids=["spz", "glb", "tiles", "usd"])
def test_a_full_disk_leaves_nothing(tmp_path: Path, monkeypatch, make):
    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("crossgrad_core.system.files.os.fsync", full)
    with pytest.raises(UserError, match="not enough disk space"):
        make().write(content(gaussians(0, 20)), tmp_path / "a")
    assert not [*tmp_path.iterdir()]


def test_an_existing_folder_is_not_replaced_by_tiles(tmp_path: Path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "mine").touch()
    with pytest.raises(UserError, match="already has this name"):
        Tiles().write(content(gaussians(0, 20)), tmp_path / "a")
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["mine"]
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
