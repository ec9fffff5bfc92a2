"""Places on Earth against PROJ."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Transformer

from crossgrad_plugins.georeference.ellipsoid import Place, geocentric, place_at

PLACES = st.builds(
    Place,
    latitude=st.floats(-90.0, 90.0),
    longitude=st.floats(-180.0, 180.0),
    altitude=st.floats(-500.0, 20_000.0),
)
TO_EARTH = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def numbers(place):
    return np.array([[place.latitude, place.longitude, place.altitude]])


@settings(max_examples=50)
@given(PLACES)
def test_geocentric_coordinates_agree_with_proj_and_can_be_inverted(place):
    here = geocentric(numbers(place))[0]
    expected = TO_EARTH.transform(place.longitude, place.latitude, place.altitude)
    np.testing.assert_allclose(here, expected, atol=1e-7)
    back = place_at(here)
    np.testing.assert_allclose(geocentric(numbers(back))[0], here, atol=1e-8)
    assert back.altitude == pytest.approx(place.altitude, abs=1e-8)


@settings(max_examples=50)
@given(PLACES, st.tuples(*[st.floats(-5000.0, 5000.0)] * 3))
def test_east_north_up_coordinates_agree_with_proj(origin, steps):
    pipeline = Transformer.from_pipeline(
        f"+proj=topocentric +ellps=WGS84 +lat_0={origin.latitude!r} +lon_0={origin.longitude!r} "
        f"+h_0={origin.altitude!r}"
    )
    point = origin.to_enu.inverse.points(np.array([steps]))
    np.testing.assert_allclose(pipeline.transform(*point[0]), steps, atol=1e-7)
    assert np.linalg.det(origin.to_enu.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("point", [(0.0, 0.0, 0.0), (5e5, 5e6, 100.0), (np.nan, 0.0, 6.4e6)])
def test_a_point_far_from_the_surface_has_no_geographic_coordinates(point):
    assert place_at(np.array(point)) is None
