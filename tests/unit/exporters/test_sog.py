"""SOG files: what is stored, what a second program reads, and damaged files."""

import io
import json
import zipfile
from dataclasses import replace

import gaussforge
import numpy as np
import pytest

from crossgrad_core.contract.georeference import COORDINATES_TAG, Similarity
from crossgrad_core.contract.slots.exporter import ExportContent
from crossgrad_core.errors import UserError
from crossgrad_plugins.exporters.palette import codebook_of, nearest_entry, palette_of
from crossgrad_plugins.exporters.ply_cloud import SplatCloud
from crossgrad_plugins.exporters.ply_file import read_ply
from crossgrad_plugins.exporters.sog import Sog
from crossgrad_plugins.exporters.sog_file import packed, unpacked

NOWHERE = np.zeros(3)
UTM = Similarity(np.array([355_142.5, 5_812_377.25, 81.0]), 1 / 60)


def cloud_of(degree: int, count: int = 500, seed: int = 0) -> SplatCloud:
    rng = np.random.default_rng(seed)
    rest = 0.1 * rng.normal(size=(count, 15, 3))
    rest[:, (degree + 1) ** 2 - 1 :] = 0.0
    return SplatCloud(
        means=rng.normal(scale=3.0, size=(count, 3)),
        log_scales=rng.normal(-3.0, 1.0, size=(count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        logit_opacities=rng.normal(scale=2.0, size=count).astype(np.float32),
        sh_dc=rng.normal(size=(count, 3)).astype(np.float32),
        sh_rest=rest.astype(np.float32),
    )


def opacities(cloud: SplatCloud) -> np.ndarray:
    return 1 / (1 + np.exp(-cloud.logit_opacities.astype(np.float64)))


def units(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions whose largest component is positive."""
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.take_along_axis(quats, np.abs(quats).argmax(1)[:, None], 1)
    return quats * np.sign(largest)


def differences(cloud: SplatCloud, other: SplatCloud) -> dict[str, float]:
    pairs = {
        "means": (cloud.means, other.means),
        "scales": (cloud.log_scales, other.log_scales),
        "quats": (units(cloud.quats), units(other.quats)),
        "opacities": (opacities(cloud), opacities(other)),
        "sh_dc": (cloud.sh_dc, other.sh_dc),
        "sh_rest": (cloud.sh_rest, other.sh_rest),
    }
    return {name: float(np.abs(a - b).max()) for name, (a, b) in pairs.items()}


@pytest.mark.parametrize("degree", range(4))
def test_a_second_program_reads_what_is_stored(degree, tmp_path):
    cloud = cloud_of(degree)
    content = packed(cloud, NOWHERE)
    ours = unpacked(content, tmp_path)
    answer = gaussforge.GaussForge().convert(content, "sog", "ply")
    (tmp_path / "a.ply").write_bytes(answer["data"])
    theirs = read_ply(tmp_path / "a.ply")
    off = differences(ours, theirs)
    # gaussforge computes in float32.
    assert max(off.values()) < 1e-4
    assert ours.sh_degree == degree
    lost = differences(cloud, ours)
    assert lost["means"] < 2e-3  # 16 bits of the logarithms of -12 to 12
    assert lost["opacities"] <= 0.5 / 255 + 1e-9
    assert lost["quats"] < 0.01
    assert lost["scales"] < 0.05 and lost["sh_dc"] < 0.05
    error = np.sqrt(np.mean((cloud.sh_rest - ours.sh_rest) ** 2))
    assert error < 0.09 if degree else error == 0.0


def test_files_of_a_second_program_are_read(tmp_path):
    cloud = cloud_of(3, 300)
    content = packed(cloud, NOWHERE)
    forge = gaussforge.GaussForge()
    written = forge.convert(forge.convert(content, "sog", "ply")["data"], "ply", "sog")["data"]
    (tmp_path / "a.sog").write_bytes(written)
    found = Sog().read(tmp_path / "a.sog", Similarity(np.zeros(3), 1.0))
    # gaussforge sorts the Gaussians.
    ours = unpacked(content, tmp_path)
    for name, wanted in (("means", ours.means), ("scales", np.exp(ours.log_scales))):
        rows = getattr(found, name).numpy()
        np.testing.assert_allclose(np.sort(rows[:, 0]), np.sort(wanted[:, 0]), rtol=0.05, atol=2e-3)
    assert found.sh_degree == 3


def test_a_scene_far_from_the_origin_keeps_its_positions(tmp_path):
    cloud = cloud_of(0, 200).to_gaussians()
    path = tmp_path / "a.sog"
    notes = Sog().write(ExportContent(cloud, UTM), path)
    assert len(notes) == 1 and "coordinates are relative to" in notes[0]
    read = Sog().read(path, UTM)
    assert (read.means - cloud.means).abs().max() < 2e-3
    meta = json.loads(zipfile.ZipFile(path).read("meta.json"))
    assert np.abs(np.array(meta["crossgrad_offset"]) - UTM.offset).max() < 60


def test_a_file_in_other_coordinates_is_refused_as_a_start(tmp_path):
    content = packed(cloud_of(0, 20), NOWHERE, ["crossgrad step 3", f"{COORDINATES_TAG} enu"])
    with pytest.raises(UserError, match="other coordinates"):
        unpacked(content, tmp_path)


def test_the_antialiased_response_is_a_flag_of_the_file(tmp_path):
    content = packed(replace(cloud_of(0), render_mode="mip"), NOWHERE)
    assert json.loads(zipfile.ZipFile(io.BytesIO(content)).read("meta.json"))["antialias"] is True
    assert unpacked(content, tmp_path).to_gaussians().response == "antialiased"


def test_one_gaussian_is_enough(tmp_path):
    cloud = cloud_of(3, 1)
    lost = differences(cloud, unpacked(packed(cloud, NOWHERE), tmp_path))
    assert lost["means"] < 1e-9 and lost["sh_rest"] < 2e-3


def rewritten(content: bytes, change) -> bytes:
    """The archive with changed members."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return out.getvalue()


def edited(**values):
    def change(members):
        members["meta.json"] = json.dumps(json.loads(members["meta.json"]) | values).encode()

    return change


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[: len(content) // 2],
        lambda content: rewritten(content, lambda members: members.pop("meta.json")),
        lambda content: rewritten(content, lambda members: members.pop("quats.webp")),
        lambda content: rewritten(content, lambda m: m.update({"sh0.webp": b"no image"})),
        lambda content: rewritten(content, lambda m: m.update({"meta.json": b"[1]"})),
        lambda content: rewritten(content, edited(version=1)),
        lambda content: rewritten(content, edited(count=0)),
        lambda content: rewritten(content, edited(count=10**6)),
        lambda content: rewritten(content, edited(means={"mins": [0], "maxs": [1], "files": []})),
        lambda content: rewritten(content, edited(scales={"codebook": [], "files": ["x"]})),
        lambda content: rewritten(content, lambda m: m.update({"quats.webp": m["sh0.webp"]})),
    ],
)
def test_damaged_files_are_refused(damage, tmp_path):
    path = tmp_path / "a.sog"
    path.write_bytes(damage(packed(cloud_of(1, 50), NOWHERE)))
    with pytest.raises(UserError, match="SOG file cannot be read"):
        Sog().read(path, UTM)


def test_a_file_that_does_not_exist_is_one_error(tmp_path):
    for ask in (lambda path: Sog().read(path, UTM), Sog().sh_degree_of):
        with pytest.raises(UserError):
            ask(tmp_path / "a.sog")


def test_a_codebook_is_finer_where_the_values_are():
    values = np.random.default_rng(0).normal(size=20_000).astype(np.float32)
    book = codebook_of(values)
    assert len(book) == 256 and (np.diff(book) >= 0).all()
    assert book[0] == values.min() and book[-1] == values.max()
    error = np.abs(book[nearest_entry(values, book)] - values)
    uniform = (values.max() - values.min()) / 255 / 4  # the mean error of an even grid
    assert error.mean() < 0.7 * uniform


def test_a_palette_has_a_row_for_each_of_a_few_distinct_rows():
    distinct = np.random.default_rng(1).normal(size=(12, 9)).astype(np.float32)
    rows = np.repeat(distinct, 100, axis=0)
    palette, labels = palette_of(rows)
    assert len(palette) <= 300
    np.testing.assert_allclose(palette[labels], rows, atol=1e-5)
