"""The options of `crossgrad export`: which Gaussians a file contains, and in which frame."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from gsply import plyread
from support.commands import ended
from support.places import located
from support.scenes import write_tiny_scene

from crossgrad_core.config import RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.run import app
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.export import ExportOptions, export_scene
from crossgrad_core.run.export_edits import (
    Crop,
    camera_in,
    most_important,
    rotation_between,
    with_degree,
)
from crossgrad_core.run.postprocess import export
from crossgrad_core.run.postprocess.open_options import AS_IT_IS
from crossgrad_core.testing.fixtures import sample_gaussians, sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state
from crossgrad_plugins.exporters.glb import Glb
from crossgrad_plugins.exporters.ply import Ply
from crossgrad_plugins.exporters.ply_file import read_ply
from crossgrad_plugins.exporters.tiles import Tiles


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of a few steps on a scene with a place on Earth."""
    folder = tmp_path_factory.mktemp("trained")
    scene = located(write_tiny_scene(folder / "tiny", views=10, width=24, height=16, suffix=".jpg"))
    given = {"scene": str(scene), "out": str(folder / "run"), "steps": 4, "threads": 1}
    assert app.run({**given, "initializer": {"name": "points"}}, verbosity=-1) == 0
    return folder / "run"


@pytest.fixture(scope="module")
def opened(trained):
    return AS_IT_IS.open(trained)


def mip_run(backbone="mip"):
    config = {"steps": 1000, "backbone": {"name": backbone}}
    setup = assemble(RunConfig.model_validate(config), sample_scene(), "none")
    state = first_state(setup)
    timed_step(setup, state)
    return setup, state


def test_a_box_keeps_the_gaussians_inside(opened, tmp_path):
    whole = export_scene(*opened, tmp_path / "a.ply")
    positions = read_ply(tmp_path / "a.ply").means
    low, high = np.quantile(positions, [0.2, 0.8], axis=0)
    crop = Crop.parsed(",".join(str(value) for value in (*low, *high)))
    part = export_scene(*opened, tmp_path / "b.ply", options=ExportOptions(crop=crop))
    inside = ((positions >= low) & (positions <= high)).all(axis=1)
    np.testing.assert_array_equal(read_ply(tmp_path / "b.ply").means, positions[inside])
    assert part.gaussians == inside.sum() < whole.gaussians
    assert whole.loss is None and part.loss is not None


@pytest.mark.parametrize("up", ["input", "y"])
def test_a_polygon_keeps_the_gaussians_above_it(opened, tmp_path, up):
    export_scene(*opened, tmp_path / "a.ply", options=ExportOptions(up=up))
    positions = read_plain(tmp_path / "a.ply")
    flat = positions[:, [0, 2]] if up == "y" else positions[:, :2]
    middle, size = np.median(flat, axis=0), np.ptp(flat, axis=0).max() / 3
    corners = middle + size * np.array([[0, -1], [1, 0], [0, 1], [-1, 0]])
    (tmp_path / "corners.txt").write_text("\n".join(f"{x},{y}" for x, y in corners))
    crop = Crop.parsed(str(tmp_path / "corners.txt"))
    export_scene(*opened, tmp_path / "b.ply", options=ExportOptions(up=up, crop=crop))
    inside = np.abs(flat - middle).sum(axis=1) < size
    np.testing.assert_allclose(read_plain(tmp_path / "b.ply"), positions[inside], atol=1e-5)
    assert 0 < inside.sum() < len(inside)


def read_plain(path):
    """[N, 3] positions of a PLY in any coordinates, with the offset of its .georef.json."""
    beside = json.loads(path.with_name(f"{path.name}.georef.json").read_text())
    return plyread(path).means.astype(np.float64) + beside["offset"]


def test_the_inside_of_a_polygon_with_a_dent():
    crop = Crop(polygon=np.array([[0.0, 0], [4, 0], [4, 4], [2, 1], [0, 4]]))
    points = np.array([[1.0, 1, 9], [2, 3, 9], [3, 2, -9], [-1, 1, 0], [5, 1, 0]])
    assert crop.inside(points, "z").tolist() == [True, False, True, False, False]
    assert crop.inside(points[:, [0, 2, 1]], "y").tolist() == [True, False, True, False, False]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("1,2,3,4,5", "neither six numbers nor a file"),
        ("1,2,3,4,5,x", "'x' is not a number"),
        ("1,2,3,4,5,nan", "'nan' is not a number"),
        ("1,2,3,1,5,6", "the largest coordinate of an axis is not above the least"),
        ("nowhere.txt", "neither six numbers nor a file"),
        ("FILE", "2 lines that are not all two numbers"),
    ],
)
def test_a_crop_that_cannot_be_read_is_refused(tmp_path, text, found):
    (tmp_path / "corners.txt").write_text("1,2\n3,4\n")
    with pytest.raises(UserError, match="the part of space to export cannot be read") as caught:
        Crop.parsed(text.replace("FILE", str(tmp_path / "corners.txt")))
    assert found in caught.value.found


def test_a_crop_without_gaussians_is_refused_and_writes_nothing(opened, tmp_path):
    crop = Crop.parsed("1e6,1e6,1e6,2e6,2e6,2e6")
    with pytest.raises(UserError, match="no Gaussian is left to export") as caught:
        export_scene(*opened, tmp_path / "a.ply", options=ExportOptions(crop=crop))
    assert "--crop" in caught.value.found
    assert not [*tmp_path.iterdir()]


def test_max_gaussians_keeps_those_that_contribute_most_and_reports_the_loss(opened, tmp_path):
    setup, state = opened
    phase = setup.phase(state.step, training=False)
    cameras = [view.camera for view in setup.train_views]
    baked = setup.backbone.bake(state.parameters, phase, cameras).detached()
    # The contribution by its definition: the change of the images if a Gaussian turns white.
    black = replace(baked, colors=torch.zeros(len(baked), 3), sh_dc=None, sh_rest=None)
    black = replace(black, sh_degree=0)
    rows = [0, 7, 20, 33]
    sums = []
    for row in rows:
        colors = torch.zeros(len(baked), 3)
        colors[row] = 1.0
        lit = replace(black, colors=colors)
        images = [setup.rasterizer.render(lit, c, torch.zeros(3)).image for c in cameras]
        sums.append(sum(float(image[..., 0].double().sum()) for image in images))
    few = replace(baked.selected(torch.ones(len(baked), dtype=torch.bool)))
    order = np.argsort(sums)[::-1]
    kept = [most_important(setup, few, setup.train_views, n) for n in range(1, len(baked) + 1, 8)]
    # A Gaussian that contributes more is never dropped before one that contributes less.
    first = [next((i for i, mask in enumerate(kept) if mask[row]), len(kept)) for row in rows]
    assert [first[i] for i in order] == sorted(first)
    assert [int(mask.sum()) for mask in kept] == [*range(1, len(baked) + 1, 8)]
    number = len(baked) // 2
    options = ExportOptions(max_gaussians=number)
    half = export_scene(setup, state, tmp_path / "a.ply", options=options)
    more = export_scene(
        setup, state, tmp_path / "b.ply", options=ExportOptions(max_gaussians=10**9)
    )
    assert half.gaussians == number and more.gaussians == len(baked)
    assert half.loss is not None and more.loss == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_sh_degree_drops_higher_bands(degree):
    given = sample_gaussians(harmonics=True).detached()
    fewer = with_degree(given, degree)
    assert fewer.misfit() is None and fewer.sh_degree == degree
    if degree:
        torch.testing.assert_close(fewer.sh_rest, given.sh_rest[:, : (degree + 1) ** 2 - 1])
    assert with_degree(given, 3) is with_degree(given, None) is given


@pytest.mark.parametrize("coordinates", ["input", "local", "enu"])
@pytest.mark.parametrize("axis", ["y", "z"])
def test_cameras_that_are_turned_alike_see_the_same_image(opened, axis, coordinates, tmp_path):
    """The content of the exporter is turned as a whole, and up is up."""
    setup, state = opened
    seen = []

    class Kept(Ply):
        def write(self, content, path):
            seen.append(content)
            return ()

    export_scene(setup, state, tmp_path / "a", Kept(), ExportOptions())
    options = ExportOptions(up=axis, coordinates=coordinates)
    export_scene(setup, state, tmp_path / "b", Kept(), options)
    before, after = seen
    np.testing.assert_allclose(after.up, np.eye(3)["xyz".index(axis)], atol=1e-12)
    assert not np.allclose(before.up, after.up, atol=0.1)
    for view, turned in zip(before.views[:3], after.views[:3], strict=True):
        images = [
            setup.rasterizer.render(each.gaussians, camera, torch.zeros(3)).image
            for each, camera in ((before, view.camera), (after, turned.camera))
        ]
        torch.testing.assert_close(*images, atol=2e-4, rtol=0)


@pytest.mark.parametrize(
    "options", [{}, {"up": "y"}, {"up": "z"}, {"coordinates": "enu", "up": "y"}]
)
def test_the_georef_file_of_a_turned_export_leads_to_the_same_places(opened, tmp_path, options):
    setup, state = opened
    export_scene(setup, state, tmp_path / "a.ply")
    export_scene(setup, state, tmp_path / "b.ply", options=ExportOptions(**options))
    facts, places, inputs = [], [], []
    for name in ("a.ply", "b.ply"):
        beside = json.loads((tmp_path / f"{name}.georef.json").read_text())
        points = np.column_stack(
            [read_plain(tmp_path / name), np.ones(len(read_plain(tmp_path / name)))]
        )
        facts.append(beside)
        places.append(points @ np.array(beside["transform"]).T)
        inputs.append(points @ np.array(beside["to_input"]).T)
    np.testing.assert_allclose(places[1], places[0], atol=1e-3)
    np.testing.assert_allclose(inputs[1], inputs[0], atol=1e-4)
    assert facts[1].get("up") == options.get("up")
    assert facts[1]["metres_per_unit"] == pytest.approx(
        1.0 if options.get("coordinates") == "enu" else facts[0]["metres_per_unit"]
    )


def test_tiles_stand_at_the_place_of_the_georeference(opened, tmp_path):
    setup, state = opened
    export_scene(setup, state, tmp_path / "t", Tiles())
    export_scene(setup, state, tmp_path / "a.ply")
    root = json.loads((tmp_path / "t" / "tileset.json").read_text())["root"]
    beside = json.loads((tmp_path / "t.georef.json").read_text())
    assert beside["coordinates"] == "enu" and beside["up"] == "z"
    place = np.array(root["transform"]).reshape(4, 4).T
    # East, north and up of the place, in geocentric axes.
    latitude, longitude = (np.radians(beside["origin"][name]) for name in ("latitude", "longitude"))
    up = [
        np.cos(latitude) * np.cos(longitude),
        np.cos(latitude) * np.sin(longitude),
        np.sin(latitude),
    ]
    np.testing.assert_allclose(place[:3, 2], up, atol=1e-9)
    np.testing.assert_allclose(place[:3, 0], [-np.sin(longitude), np.cos(longitude), 0], atol=1e-9)
    assert 6.3e6 < np.linalg.norm(place[:3, 3]) < 6.4e6
    georef = json.loads((tmp_path / "a.ply.georef.json").read_text())
    points = read_plain(tmp_path / "a.ply") @ np.array(georef["transform"])[:3, :3].T
    points += np.array(georef["transform"])[:3, 3]
    box = np.array(root["boundingVolume"]["box"])
    assert (np.abs(points - box[:3]) <= box[3:].reshape(3, 3).diagonal() + 1e-6).all()


def test_formats_have_their_own_up_axis_and_utm_keeps_its_axes(opened, tmp_path):
    glb = tmp_path / "a.glb"
    export_scene(*opened, glb, Glb())
    assert json.loads(glb.with_name("a.glb.georef.json").read_text())["up"] == "y"
    export_scene(*opened, tmp_path / "b.glb", Glb(), ExportOptions(coordinates="utm"))
    assert "up" not in json.loads((tmp_path / "b.glb.georef.json").read_text())
    with pytest.raises(UserError, match="map coordinates cannot be rotated") as caught:
        export_scene(*opened, tmp_path / "c.ply", options=ExportOptions(coordinates="utm", up="y"))
    assert caught.value.where == "--up y"
    assert not (tmp_path / "c.ply").exists()


@pytest.mark.parametrize("end", [[0, 1, 0], [0, -1, 0], [1, 0, 0], [-0.6, 0.8, 0]])
@pytest.mark.parametrize("start", [[0, 1, 0], [0, 0, 1], [1, 0, 0], [0.6, -0.8, 0]])
def test_the_rotation_between_two_directions(start, end):
    turn = rotation_between(np.array(start, float), np.array(end, float))
    np.testing.assert_allclose(turn @ start, end, atol=1e-12)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)


def test_a_camera_keeps_its_place_among_turned_points():
    camera = sample_scene().views[0].camera
    turn = rotation_between(np.array([0.0, 0, 1]), np.array([0.6, 0, 0.8]))
    turned = camera_in(camera, turn).world_to_camera.numpy()
    point = np.array([0.1, 0.2, 0.3])
    before = camera.world_to_camera.numpy()
    np.testing.assert_allclose(
        turned[:3, :3] @ (turn @ point) + turned[:3, 3], before[:3, :3] @ point + before[:3, 3]
    )


def test_unbaked_gaussians_of_mip_have_the_flag_and_lose_little(tmp_path):
    setup, state = mip_run()
    baked = export_scene(setup, state, tmp_path / "a.ply")
    unbaked = export_scene(setup, state, tmp_path / "b.ply", options=ExportOptions(baked=False))
    assert b"SplatRenderMode: mip" in (tmp_path / "b.ply").read_bytes()[:500]
    assert b"SplatRenderMode: default" in (tmp_path / "a.ply").read_bytes()[:500]
    assert baked.baked_for is not None and unbaked.baked_for is None
    # Viewers dilate by 0.3 px^2, as 3DGS does, and the model by 0.1.
    assert unbaked.loss == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(
    ("backbone", "exporter", "message"),
    [
        ("mip", Glb(), "cannot store Gaussians with the response antialiased"),
        ("vanilla", Ply(), "--unbaked has no effect: backbone vanilla"),
    ],
)
def test_unbaked_is_refused_where_it_has_no_meaning(tmp_path, backbone, exporter, message):
    setup, state = mip_run(backbone)
    with pytest.raises(UserError, match=message):
        export_scene(setup, state, tmp_path / "a", exporter, ExportOptions(baked=False))
    assert not [*tmp_path.iterdir()]


def test_the_command_writes_each_format_beside_the_others(trained, capsys, tmp_path):
    for name, written in (
        ("spz", "point_cloud.spz"),
        ("glb", "point_cloud.glb"),
        ("tiles", "point_cloud_tiles/tileset.json"),
        ("usd", "point_cloud.usdz"),
    ):
        assert ended("export", trained, "--format", name) == 0
        assert (trained / written).stat().st_size > 0
        told = capsys.readouterr().out
        assert "Gaussians written to" in told
        assert ("loss" in told) == (name in {"spz", "tiles"})
    assert ended("export", trained, "--up", "z", "--sh-degree", "1", "--max-gaussians", "9") == 0
    assert (trained / "point_cloud_z-up_sh1_9.ply").is_file()


def test_the_command_refuses_targets_that_exist_and_unknown_formats(trained, tmp_path):
    (tmp_path / "tiles").mkdir()
    (tmp_path / "a.glb").write_text("mine")
    for arguments, message in (
        ({"file_format": "tiles", "out": tmp_path / "tiles"}, "the output file already exists"),
        ({"file_format": "glb", "out": tmp_path / "a.glb"}, "the output file already exists"),
        ({"file_format": "glb", "out": tmp_path / "b.spz"}, "ends like a file of another format"),
        ({"file_format": "xyz", "out": tmp_path / "b.xyz"}, "there is no exporter named 'xyz'"),
    ):
        with pytest.raises(UserError, match=message):
            export.exported(trained, **arguments)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.glb", "tiles"]
    assert (tmp_path / "a.glb").read_text() == "mine"
