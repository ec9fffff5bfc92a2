"""Gaussians that are turned look the same to a camera that is turned alike."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from pyproj import Proj, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info
from scipy.spatial.transform import Rotation
from support.gaussians import posed_camera, random_gaussians

from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build
from crossgrad_plugins.exporters.ply_cloud import SplatCloud
from crossgrad_plugins.georeference.ellipsoid import Place, geocentric
from crossgrad_plugins.georeference.frames import Frame3D
from crossgrad_plugins.georeference.on_earth import OnEarth
from crossgrad_plugins.georeference.projection import Projection, utm_code

SIMILARITY = Similarity(np.array([4.0, -3.0, 70.0]), 0.125)
PLACE = Place(-33.4, 151.2, 12.0)


def on_earth(seed, scale=1.0):
    rotation = Rotation.random(random_state=seed).as_matrix()
    shift = np.random.default_rng(seed).normal(size=3) * 100.0
    return OnEarth(PLACE, Frame3D(rotation, shift, scale), "a test")


def picture(gaussians, camera):
    background = torch.tensor([0.2, 0.5, 0.1], dtype=torch.float64)
    return build("rasterizers", "torch", {}).render(gaussians, camera, background).image


def turned_camera(camera, rotation):
    pose = camera.world_to_camera.clone()
    pose[:3, :3] = pose[:3, :3] @ torch.from_numpy(rotation).T
    return replace(camera, world_to_camera=pose)


def turn_of(placed, gaussians):
    """The rotation [3, 3] that the means of placed Gaussians have gone through."""
    before, after = (each.means.numpy() for each in (gaussians, placed.gaussians))
    return Rotation.align_vectors(after, before)[0].as_matrix()


@pytest.mark.sampled(11)
@pytest.mark.parametrize("degree", [None, 0, 1, 2, 3])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("coordinates", ["enu", "epsg:4978"])
def test_a_rotated_scene_looks_the_same_to_a_rotated_camera(degree, seed, coordinates):
    camera = posed_camera()
    gaussians = random_gaussians(30, camera, seed=seed, sh_degree=degree)
    if degree:
        assert gaussians.sh_rest.abs().max() > 0.01
    placed = on_earth(seed, scale=3.0).placed(gaussians, SIMILARITY, coordinates)
    rotation = turn_of(placed, gaussians)
    assert np.abs(rotation - np.eye(3)).max() > 0.1
    # Geocentric coordinates of 6e6 m keep 1e-9 m, which is 4e-11 local units.
    np.testing.assert_allclose(
        placed.gaussians.means.numpy(), gaussians.means.numpy() @ rotation.T, atol=1e-9
    )
    expected = picture(gaussians, camera)
    assert expected.std() > 0.01
    found = picture(placed.gaussians, turned_camera(camera, rotation))
    np.testing.assert_allclose(found.numpy(), expected.numpy(), atol=1e-8)
    if degree:  # And would not, were the harmonics left as they are.
        left = replace(placed.gaussians, sh_rest=gaussians.sh_rest)
        unlike = picture(left, turned_camera(camera, rotation))
        assert (unlike - expected).abs().max() > 1e-4


@pytest.mark.parametrize("scale", [0.01, 40.0])
def test_sizes_and_positions_are_in_metres(scale):
    gaussians = random_gaussians(20, posed_camera(), sh_degree=1)
    place = on_earth(5, scale)
    placed = place.placed(gaussians, SIMILARITY, "enu")
    cloud = SplatCloud.from_gaussians(placed.gaussians).to_input(placed.similarity)
    metres = gaussians.scales.numpy() / SIMILARITY.scale * scale
    np.testing.assert_allclose(np.exp(cloud.log_scales), metres, rtol=1e-5)
    inputs = SIMILARITY.to_input(gaussians.means.numpy())
    np.testing.assert_allclose(cloud.means, place.to_enu.points(inputs), rtol=1e-12, atol=1e-9)


def test_the_rotation_in_projected_coordinates_follows_the_grid():
    """Compare meridian convergence and point scale with the derivatives of PROJ."""
    gaussians = random_gaussians(5, posed_camera(), sh_degree=3)
    rotation = Rotation.random(random_state=1).as_matrix()
    place = OnEarth(PLACE, Frame3D(rotation, -rotation @ SIMILARITY.offset), "a test")
    placed = place.placed(gaussians, SIMILARITY, "utm")
    assert placed.facts["crs"] == "EPSG:32756"
    factors = Proj("epsg:32756").get_factors(PLACE.longitude, PLACE.latitude)
    angle = factors.meridian_convergence
    expected = Rotation.from_euler("z", angle, degrees=True).as_matrix() @ rotation
    # The grid stretches by 0.9996 along the ground and not at all upright.
    np.testing.assert_allclose(turn_of(placed, gaussians), expected, atol=5e-4)
    scale = SIMILARITY.scale / placed.similarity.scale
    assert scale == pytest.approx(factors.meridional_scale ** (2 / 3), abs=3e-6)


def in_utm():
    """A scene of kilometres whose coordinates are in UTM."""
    system = Projection.of("epsg:32756", "here")
    here = np.array([[PLACE.latitude, PLACE.longitude, PLACE.altitude]])
    similarity = Similarity(system.points(geocentric(here))[0], 1.0 / 2000.0)
    frame = system.near(PLACE.to_enu, np.zeros(3), "here").inverse
    return OnEarth(PLACE, frame, "a test", system=system), similarity


def test_a_scene_in_utm_is_exported_unchanged_to_utm():
    place, similarity = in_utm()
    gaussians = random_gaussians(20, posed_camera(), sh_degree=2)
    placed = place.placed(gaussians, similarity, "utm")
    cloud = SplatCloud.from_gaussians(placed.gaussians).to_input(placed.similarity)
    inputs = similarity.to_input(gaussians.means.numpy())
    np.testing.assert_allclose(cloud.means, inputs, rtol=0.0, atol=1e-6)
    for name in ("quats", "sh_rest", "scales"):
        found, expected = getattr(placed.gaussians, name), getattr(gaussians, name)
        np.testing.assert_allclose(found.numpy(), expected.numpy(), atol=1e-7)
    assert placed.similarity.scale == pytest.approx(similarity.scale, rel=1e-9)


def test_a_scene_in_utm_agrees_with_proj_in_metres():
    place, similarity = in_utm()
    gaussians = random_gaussians(20, posed_camera())
    placed = place.placed(gaussians, similarity, "enu")
    cloud = SplatCloud.from_gaussians(placed.gaussians).to_input(placed.similarity)
    inputs = similarity.to_input(gaussians.means.numpy())
    topocentric = Transformer.from_pipeline(
        f"+proj=topocentric +ellps=WGS84 +lat_0={PLACE.latitude} +lon_0={PLACE.longitude} "
        f"+h_0={PLACE.altitude}"
    )
    # The code of a map alone passes heights on; with the ellipsoid's they are turned as well.
    earth = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(
        *Transformer.from_crs("EPSG:32756", "EPSG:4326", always_xy=True).transform(*inputs.T)
    )
    expected = np.column_stack(topocentric.transform(*earth))
    np.testing.assert_allclose(cloud.means, expected, rtol=0.0, atol=1e-6)
    off = np.linalg.norm(place.to_enu.points(inputs) - expected, axis=1)
    facts = place.placed(gaussians, similarity, "input").facts
    assert facts["crs"] == "EPSG:32756"
    assert off.max() > 0.1
    assert facts["transform_error_m"] == pytest.approx(np.quantile(off, 0.99), abs=1e-6)


ZONES = [(51.5, -0.1), (0.0, 0.0), (-1e-9, 6.0), (64.1, -21.9), (-33.9, 151.2), (60.4, 5.3)]


@pytest.mark.sampled(3)
@pytest.mark.parametrize(("latitude", "longitude"), [*ZONES, (10.0, -180.0), (-75.0, 179.9)])
def test_the_utm_zone_is_one_in_use_at_its_position(latitude, longitude):
    area = AreaOfInterest(longitude, latitude, longitude, latitude)
    found = query_utm_crs_info(datum_name="WGS 84", area_of_interest=area, contains=True)
    codes = {f"epsg:{each.code}" for each in found}
    assert utm_code(Place(latitude, longitude, 0.0)) in codes


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("epsg:3857", "one metre is 1 to 1.20"),
        ("epsg:4326", "one metre is"),
        ("epsg:2263", "one metre is 1 to 3.3"),
        ("epsg:99999", "crs not found"),
    ],
)
def test_coordinate_systems_that_stretch_unevenly_or_do_not_exist_are_refused(code, found):
    gaussians = random_gaussians(3, posed_camera())
    place = OnEarth(Place(33.4, 151.2, 0.0), on_earth(0).to_enu, "a test")
    with pytest.raises(UserError, match=found) as caught:
        place.placed(gaussians, SIMILARITY, code)
    assert caught.value.where == f"--coordinates {code}"


def test_left_handed_axes_are_refused():
    forward = Transformer.from_crs("epsg:4978", "+proj=utm +zone=56 +south +axis=wnu +type=crs")
    with pytest.raises(UserError, match="left-handed"):
        Projection("epsg:0", forward, 0.0).near(PLACE.to_enu, np.zeros(3), "here")


@pytest.mark.parametrize("code", ["+init=/etc/hostname:1", "file.wkt", "epsg:", "epsg:٣٢٦٣٣", ""])
def test_only_codes_of_coordinate_systems_are_passed_to_proj(code):
    with pytest.raises(UserError, match="PROJ cannot convert"):
        Projection.of(code, "here")


def test_without_pyproj_only_epsg_codes_are_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    gaussians = random_gaussians(3, posed_camera())
    assert on_earth(0).placed(gaussians, SIMILARITY, "enu").facts
    with pytest.raises(UserError, match=r"crossgrad\[geo\]"):
        on_earth(0).placed(gaussians, SIMILARITY, "epsg:32756")


def test_non_finite_gaussians_are_still_non_finite():
    gaussians = random_gaussians(4, posed_camera())
    gaussians.means[1, 2] = float("nan")
    for coordinates in ("enu", "utm"):
        means = on_earth(0).placed(gaussians, SIMILARITY, coordinates).gaussians.means
        assert means.isfinite().all(dim=1).tolist() == [True, False, True, True]
