"""Exports in other coordinates lie where maps say, and say what they are."""

import json

import numpy as np
import pytest
from gsply import plyread
from pyproj import Transformer
from support.commands import ended
from support.places import ORIGIN, TO_ENU, located
from support.scenes import write_tiny_scene

from crossgrad_core.config import RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.run import app
from crossgrad_core.run.assemble import assemble, read_scene
from crossgrad_core.run.export import ExportOptions, export_scene
from crossgrad_core.run.postprocess import evaluate, export
from crossgrad_core.run.postprocess.drawn_file import DrawnFile
from crossgrad_core.run.postprocess.open_options import AS_IT_IS
from crossgrad_core.training.start import first_state
from crossgrad_plugins.exporters.ply_file import read_ply

SYSTEMS = {"utm": "EPSG:32633", "epsg:25833": "EPSG:25833", "epsg:4978": "EPSG:4978"}
COORDINATES = ("input", "local", "enu", *SYSTEMS)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "tiny"
    return located(write_tiny_scene(path, views=10, width=24, height=16, suffix=".jpg"))


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """A run of a few steps."""
    out = tmp_path_factory.mktemp("trained") / "run"
    given = {"scene": str(scene), "out": str(out), "steps": 4, "threads": 1}
    assert app.run({**given, "initializer": {"name": "points"}}, verbosity=-1) == 0
    return out


def started(scene):
    """The setup of a scene and the state before the first step, with a Gaussian at each point."""
    config = RunConfig(scene=scene, steps=10, initializer={"name": "points"})
    read, reader = read_scene(config, scene)
    setup = assemble(config, read, reader)
    return setup, first_state(setup)


def sfm_points(setup):
    """[P, 3] the SfM points in the coordinates of the input."""
    return setup.scene.similarity.to_input(setup.scene.points)


def file_of(path):
    """[N, 3] positions of a PLY with its offset, and what stands beside it."""
    beside = json.loads(path.with_name(f"{path.name}.georef.json").read_text())
    assert beside["file"] == path.name
    return plyread(path).means.astype(np.float64) + beside["offset"], beside


def moved(matrix, points):
    matrix = np.array(matrix)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.mark.parametrize("coordinates", COORDINATES)
def test_the_georef_file_maps_an_exported_file_back_to_the_input(scene, tmp_path, coordinates):
    setup, state = started(scene)
    path = tmp_path / "a.ply"
    exported = export_scene(setup, state, path, options=ExportOptions(coordinates=coordinates))
    positions, beside = file_of(path)
    points = sfm_points(setup)
    enu = TO_ENU.points(points)
    origin = beside["origin"]
    assert beside["coordinates"] == coordinates
    # East, north, up of one place are, up to a shift, those of another one 20 m away.
    earth = ORIGIN.to_enu.inverse.points(enu)
    own = Transformer.from_pipeline(
        f"+proj=topocentric +ellps=WGS84 +lat_0={origin['latitude']!r} "
        f"+lon_0={origin['longitude']!r} +h_0={origin['altitude']!r}"
    )
    here = np.column_stack(own.transform(*earth.T))
    expected = {
        "input": points,
        "local": setup.scene.points,
        "enu": here,
        **{
            name: np.column_stack(
                Transformer.from_crs("EPSG:4978", code, always_xy=True).transform(*earth.T)
            )
            for name, code in SYSTEMS.items()
        },
    }[coordinates]
    # GPS in EXIF is exact to micrometres, float32 to 1e-6 of 30 m; the ellipsoids of ETRS89 and WGS
    # 84 are 1e-4 m apart.
    np.testing.assert_allclose(positions, expected, atol=1e-4 / beside["metres_per_unit"])
    even = 0.0 if coordinates != "utm" and "25833" not in coordinates else 5e-4 * np.abs(here).max()
    np.testing.assert_allclose(moved(beside["transform"], positions), here, atol=1e-4 + even)
    np.testing.assert_allclose(moved(beside["to_input"], positions), points, atol=1e-4 + even)
    assert beside.get("transform_error_m", 0.0) <= even + 1e-6
    largest = beside["rounding"]
    assert largest <= 1e-6 * TO_ENU.scale / setup.scene.similarity.scale
    assert largest == np.abs(positions - _float64(setup, state, coordinates)).max()
    assert any(note.startswith("a.ply: ") and "georef.json" in note for note in exported.notes)


def _float64(setup, state, coordinates):
    """[N, 3] the positions before they are rounded to float32."""
    baked = setup.backbone.bake(state.parameters, setup.phase(0, training=False), [])
    placed = setup.scene.georeference.placed(baked.detached(), setup.scene.similarity, coordinates)
    offset = setup.selection.exporter.rounding(placed.gaussians, placed.similarity).offset
    near = placed.similarity.to_input(placed.gaussians.means.double().numpy()) - offset
    return near + offset


@pytest.mark.parametrize("scale", [1.0, 40.0, 3000.0])
def test_a_file_in_utm_matches_the_shifted_points_to_a_millionth_of_the_extent(tmp_path, scale):
    """Compare in input coordinates, for scenes from the size of a house to a city of 10 km."""
    offset = (5e5, 5e6, 120.0)
    size = {"views": 6, "width": 24, "height": 16, "points": 300}
    here, there = (
        started(write_tiny_scene(tmp_path / name, scale=scale, offset=by, **size))
        for name, by in (("here", (0.0, 0.0, 0.0)), ("there", offset))
    )
    export_scene(*there, tmp_path / "a.ply")
    positions, beside = file_of(tmp_path / "a.ply")
    assert beside["coordinates"] == "input"
    extent = 1.0 / there[0].scene.similarity.scale
    expected = sfm_points(here[0]) + offset
    assert np.abs(positions - expected).max() <= 1e-6 * extent
    assert np.abs(sfm_points(there[0]) - expected).max() <= 2e-9 * max(1.0, extent)
    # The reader of the file applies the same offset.
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").means, positions)


def test_a_run_writes_a_georeference_file_next_to_its_ply(trained):
    positions, beside = file_of(trained / "point_cloud.ply")
    assert beside["coordinates"] == "input"
    assert beside["residuals_m"]["max"] < 1e-3
    assert len(positions) > 100
    log = (trained / "log.txt").read_text()
    assert "georeferenced by GPS of the photos, 10 of 10" in log


def test_a_scene_without_georeference_or_offset_writes_no_georef_file(tmp_path):
    setup, state = started(write_tiny_scene(tmp_path / "scene", views=4, width=24, height=16))
    export_scene(setup, state, tmp_path / "a.ply")
    assert not (tmp_path / "a.ply.georef.json").exists()
    export_scene(setup, state, tmp_path / "b.ply", options=ExportOptions(coordinates="local"))
    positions, beside = file_of(tmp_path / "b.ply")
    assert beside == {"file": "b.ply", "coordinates": "local", "offset": [0.0] * 3, "rounding": 0.0}
    np.testing.assert_allclose(positions, setup.scene.points, atol=1e-7)
    with pytest.raises(UserError, match="not georeferenced") as caught:
        export_scene(setup, state, tmp_path / "c.ply", options=ExportOptions(coordinates="enu"))
    assert "neither the scene files nor the photos" in caught.value.found
    assert not (tmp_path / "c.ply").exists()


def test_export_writes_next_to_the_files_of_the_run_and_overwrites_none(trained, capsys):
    before = {path.name: path.read_bytes() for path in trained.iterdir() if path.is_file()}
    for name in ("SHA256SUMS", "summary.json"):  # They list each file that is added.
        before.pop(name, None)
    assert ended("export", trained, "--coordinates", "utm") == 0
    told = capsys.readouterr().out
    assert "utm coordinates, see point_cloud_utm.ply.georef.json" in told
    new = {path.name for path in trained.iterdir()} - before.keys()
    assert {"point_cloud_utm.ply", "point_cloud_utm.ply.georef.json"} <= new
    assert {name: (trained / name).read_bytes() for name in before} == before
    with pytest.raises(UserError, match="the output file already exists"):
        export.exported(trained, out=None, options=ExportOptions(coordinates="utm"))
    with pytest.raises(UserError, match=r"coordinate system is unknown(?s:.*)epsg:32633"):
        export.exported(trained, out=None, options=ExportOptions(coordinates="gauss"))


def test_an_existing_georef_file_next_to_a_named_output_is_not_replaced(trained, tmp_path):
    (tmp_path / "a.ply.georef.json").write_text("mine")
    with pytest.raises(UserError, match="the output file already exists"):
        export.exported(trained, out=tmp_path / "a.ply", options=ExportOptions(coordinates="enu"))
    assert (tmp_path / "a.ply.georef.json").read_text() == "mine"


def test_evaluating_a_ply_in_other_coordinates_is_refused(trained, tmp_path):
    path = tmp_path / "a.ply"
    export.exported(trained, out=path, options=ExportOptions(coordinates="enu"))
    with pytest.raises(UserError, match=r"uses other coordinates(?s:.*)--coordinates input"):
        evaluate.evaluated_file(trained, DrawnFile(path))


def test_options_of_the_reader_are_used_again_when_a_run_is_opened(scene, tmp_path):
    """The reader options determine the scene, so a run must be opened with the same options."""
    out = tmp_path / "run"
    options = {"name": "colmap", "gps": str(scene / "images"), "model": "sparse/0"}
    given = {"scene": str(scene), "out": str(out), "steps": 1, "threads": 1, "reader": options}
    assert app.run(given, verbosity=-1) == 0
    setup, _ = AS_IT_IS.open(out)
    assert setup.config.reader.options == {"gps": str(scene / "images"), "model": "sparse/0"}
    assert str(scene / "images") in setup.scene.georeference.source
