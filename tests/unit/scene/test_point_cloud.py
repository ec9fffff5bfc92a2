"""Point clouds in place of a scene's points: `--points FILE`, and a PLY beside a COLMAP model."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from support.scenes import write_tiny_scene

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.scene.point_cloud import read_cloud, read_las, thinned
from crossgrad_core.scene.raw import CheckedPoints
from crossgrad_plugins.exporters.ply import Ply
from crossgrad_plugins.readers.colmap import ColmapReader

XYZ = np.array([[0.5, -0.25, 0.125], [-0.5, 0.25, 0.0], [0.25, 0.5, 0.25], [1.0, 1.0, 0.0]])
RGB = np.array([[0, 128, 255], [10, 20, 30], [255, 255, 255], [1, 2, 3]], dtype=np.uint8)
TYPES = {"float": "f4", "double": "f8", "int": "i4", "uchar": "u1", "ushort": "u2"}


@pytest.fixture(scope="module")
def master(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("points") / "scene")


@pytest.fixture
def scene(master, tmp_path):
    return Path(shutil.copytree(master, tmp_path / "scene"))


def read(path, **options):
    return ColmapReader().read(path, SceneOptions(**options))


def write_ply(path, xyz=XYZ, rgb=RGB, *, kind="double", color="uchar", form="ascii", faces=False):
    """A PLY of points as scanners and other programs write them."""
    scale = {"uchar": 1, "ushort": 257, "float": 1 / 255}
    names = [(kind, axis) for axis in "xyz"]
    columns = [xyz[:, i] for i in range(3)]
    if color is not None:
        names += [(color, name) for name in ("red", "green", "blue")]
        columns += [rgb[:, i].astype(float) * scale[color] for i in range(3)]
    header = ["ply", f"format {form} 1.0", "comment a scan", f"element vertex {len(xyz)}"]
    header += [f"property {kind} {name}" for kind, name in names]
    header += ["element face 1", "property list uchar int vertex_indices"] if faces else []
    body = "\n".join([*header, "end_header"]).encode() + b"\n"
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(form)
    if order is None:
        rows = [" ".join(f"{value:.17g}" for value in row) for row in zip(*columns, strict=True)]
        body += ("\n".join(rows) + "\n").encode() + (b"3 0 1 2\n" if faces else b"")
    else:
        table = np.empty(len(xyz), dtype=[(name, order + TYPES[kind]) for kind, name in names])
        for (_, name), column in zip(names, columns, strict=True):
            table[name] = column
        body += table.tobytes() + (b"\3" + bytes(12) if faces else b"")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(body)
    return path


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("color", ["uchar", "ushort", "float"])
def test_plys_of_all_formats_give_the_same_points(form, kind, color, tmp_path):
    cloud = read_cloud(
        write_ply(tmp_path / "a.ply", kind=kind, color=color, form=form, faces=True), "a.ply"
    )
    np.testing.assert_array_equal(cloud.positions, XYZ)
    np.testing.assert_array_equal(cloud.colors, RGB)


def test_integer_positions_and_points_without_colors_are_read(tmp_path):
    path = write_ply(tmp_path / "a.ply", 8 * XYZ, kind="int", color=None)
    cloud = read_cloud(path, "a.ply")
    np.testing.assert_array_equal(cloud.positions, 8 * XYZ)
    assert (cloud.colors == 127).all()


@pytest.mark.parametrize("place", ["absolute", "within the scene"])
def test_the_points_option_replaces_the_points_of_the_reader(place, scene):
    write_ply(scene / "scan" / "cloud.ply")
    option = scene / "scan" / "cloud.ply" if place == "absolute" else Path("scan/cloud.ply")
    found = read(scene, points=option)
    np.testing.assert_allclose(found.similarity.to_input(found.points), XYZ, atol=1e-8)
    np.testing.assert_array_equal(found.point_colors, RGB)
    assert not any(len(view.seen) for view in found.views)
    assert any("4 from cloud.ply" in note for note in found.notes)


def test_coordinates_far_from_zero_keep_their_digits(scene):
    """A scene in UTM coordinates: float32 would move its points by centimetres."""
    far = np.array([370_000.0, 5_800_000.0, 100.0])
    images = scene / "sparse" / "0" / "images.txt"
    import pycolmap

    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), far))
    model.write(str(scene / "sparse" / "0"))
    assert not images.exists()
    write_ply(scene / "utm.ply", XYZ + far)
    found = read(scene, points=Path("utm.ply"))
    np.testing.assert_allclose(found.similarity.to_input(found.points) - far, XYZ, atol=1e-6)


@pytest.mark.parametrize("place", ["sparse/0/points3D.ply", "sparse/sparse_pc.ply", "points.ply"])
@pytest.mark.parametrize("lacks", ["the file", "any point"])
def test_a_ply_next_to_a_colmap_model_without_points_is_read(place, lacks, scene):
    file = scene / "sparse" / "0" / "points3D.bin"
    if lacks == "the file":
        file.unlink()
    else:
        file.write_bytes(bytes(8))
    write_ply(scene / place)
    found = read(scene)
    np.testing.assert_allclose(found.similarity.to_input(found.points), XYZ, atol=1e-8)
    assert any(f"4 points from {place}" in note for note in found.notes)


def test_points_of_the_model_have_priority_over_a_ply_in_its_folder(scene):
    before = read(scene)
    write_ply(scene / "sparse" / "0" / "points3D.ply")
    np.testing.assert_array_equal(read(scene).points, before.points)


def test_a_cloud_in_another_frame_is_refused_whether_named_or_found(scene):
    write_ply(scene / "cloud.ply", XYZ + 1000.0)
    with pytest.raises(UserError, match=r"another coordinate system(?s:.*)cloud\.ply"):
        read(scene, points=Path("cloud.ply"))
    (scene / "sparse" / "0" / "points3D.bin").unlink()
    (scene / "cloud.ply").rename(scene / "points.ply")
    with pytest.raises(UserError, match=r"another coordinate system(?s:.*)points\.ply"):
        read(scene)


def test_a_missing_file_is_named(scene):
    with pytest.raises(UserError, match=r"the point file does not exist(?s:.*)gone\.ply"):
        read(scene, points=Path("gone.ply"))


def test_swapped_options_for_points_and_gaussians_are_refused_with_the_right_option(scene):
    cloud = write_ply(scene / "cloud.ply")
    with pytest.raises(UserError, match=r"--points \S+cloud\.ply"):
        Ply().sh_degree_of(cloud)
    with pytest.raises(UserError, match=r"--points \S+cloud\.ply"):
        Ply().read(cloud, read(scene).similarity)
    names = ("x", "y", "z", "f_dc_0", "opacity", "scale_0", "rot_0")
    header = ["ply", "format ascii 1.0", "element vertex 1"]
    header += [*(f"property float {name}" for name in names), "end_header", "0 0 0 1 1 1 1", ""]
    (scene / "gaussians.ply").write_text("\n".join(header))
    with pytest.raises(UserError, match=r"--init gaussians\.ply"):
        read(scene, points=Path("gaussians.ply"))


def test_a_dense_cloud_is_thinned_evenly_with_a_note(scene):
    rng = np.random.default_rng(0)
    # The left half has ten times as many points, as it has close to a laser scanner.
    left, right = rng.uniform(-1.0, 0.0, (20_000, 1)), rng.uniform(0.0, 1.0, (2_000, 1))
    x = np.concatenate([left, right])
    xyz = np.concatenate([x, rng.uniform(-1.0, 1.0, x.shape), np.zeros(x.shape)], axis=1)
    write_ply(scene / "scan.ply", xyz, np.full(xyz.shape, 9, np.uint8), form="binary_big_endian")
    found = read(scene, points=Path("scan.ply"), max_points=1000)
    kept = found.similarity.to_input(found.points)
    assert 800 <= len(kept) <= 1000
    assert abs((kept[:, 0] < 0.0).mean() - 0.5) < 0.1
    note = next(note for note in found.notes if "kept" in note)
    assert f"{len(kept):,} of 22,000" in note
    assert "data.max_points" in note
    again = read(scene, points=Path("scan.ply"), max_points=1000)
    np.testing.assert_array_equal(found.points, again.points)
    assert len(read(scene, points=Path("scan.ply")).points) == 22_000


@pytest.mark.parametrize("odd", ["one place", "a stray point", "a line"])
def test_thinning_handles_degenerate_clouds(odd):
    xyz = np.random.default_rng(1).normal(size=(5000, 3))
    if odd == "one place":
        xyz[:] = 7.0
    elif odd == "a stray point":
        xyz[17] = 1e25
    else:
        xyz[:, 1:] = 0.0
    points = CheckedPoints(xyz, np.zeros((5000, 3), dtype=np.uint8), np.arange(5000))
    assert len(thinned(points, 1)[0].xyz) == 1
    kept, notes = thinned(points, 100)
    assert 1 <= len(kept.xyz) <= 100
    assert odd == "one place" or len(kept.xyz) >= 50
    assert len(notes) == 1


def test_points_with_tracks_are_never_thinned(scene):
    assert len(read(scene, max_points=1).points) == len(read(scene).points) > 1


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_and_laz_are_read_with_scale_offset_and_16_bit_colors(suffix, tmp_path):
    laspy = pytest.importorskip("laspy")
    far = np.array([370_000.0, 5_800_000.0, 100.0])
    path = write_las(laspy, tmp_path / f"scan{suffix}", XYZ + far, RGB)
    cloud = read_cloud(path, path.name)
    np.testing.assert_allclose(cloud.positions - far, XYZ, atol=5e-4)
    np.testing.assert_array_equal(cloud.colors, RGB)


def test_a_las_file_without_colors_is_grey_and_a_damaged_file_is_an_error(tmp_path):
    laspy = pytest.importorskip("laspy")
    path = write_las(laspy, tmp_path / "scan.las", XYZ, None)
    assert (read_cloud(path, "scan.las").colors == 127).all()
    content = path.read_bytes()
    for damaged in (content[:-10], content[:100], b"", b"LASF" + bytes(400)):
        path.write_bytes(damaged)
        with pytest.raises(UserError, match=r"scan\.las"):
            read_las(path)


def test_every_nth_point_of_a_huge_las_file_is_read(tmp_path, monkeypatch):
    laspy = pytest.importorskip("laspy")
    xyz = np.arange(300.0).reshape(100, 3)
    path = write_las(laspy, tmp_path / "scan.las", xyz, None)
    monkeypatch.setattr("crossgrad_core.scene.point_cloud._MOST_IN_LAS", 40)
    monkeypatch.setattr("crossgrad_core.scene.point_cloud._AT_ONCE", 7)
    np.testing.assert_allclose(read_cloud(path, "").positions, xyz[::3], atol=1e-3)


@pytest.mark.parametrize("package", ["laspy", "lazrs"])
def test_the_error_without_laspy_names_the_extra(package, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    if package == "lazrs":
        pytest.importorskip("laspy")
    path = tmp_path / "scan.laz"
    path.write_bytes(b"LASF")
    with pytest.raises(UserError, match=rf"scan\.laz(?s:.*){package}(?s:.*)crossgrad\[las\]"):
        read_las(path)


def write_las(laspy, path, xyz, rgb):
    """A LAS or LAZ file in millimetres."""
    header = laspy.LasHeader(point_format=6 if rgb is None else 7, version="1.4")
    header.offsets, header.scales = np.floor(xyz.min(0)), np.full(3, 0.001)
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    if rgb is not None:
        las.red, las.green, las.blue = (rgb.astype(np.uint16) * 257).T
    las.write(path)
    return path
