"""Values per photo: what photos differ by survives that the mean of all is made neutral."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from crossgrad_core.testing.fixtures import posed_scene, posed_view
from crossgrad_plugins.exposures import per_photo
from crossgrad_plugins.exposures.affine import Affine
from crossgrad_plugins.exposures.gain import ChannelGain, Gain
from crossgrad_plugins.exposures.initial_values import Starts

MODELS = [Gain(), ChannelGain(), Affine()]
NAMES = [type(model).__name__ for model in MODELS]
STOPS = st.lists(st.floats(-10, 10), min_size=2, max_size=6)
#: Values are float32 numbers of at most 10, which round by half of 2^-20.
ROUNDING = 0.5 * 2.0**-20


def scene_of(count):
    return posed_scene([posed_view((0.1 * n, 0, 0), f"{n}.png") for n in range(count)])


def start_of(model, stops, monkeypatch):
    """Where a model starts if tracks and EXIF tell so many stops, [P, V]."""
    found = Starts(np.array(stops) - np.mean(stops), ())
    monkeypatch.setattr(per_photo, "starts_of", lambda *_: found)
    return model.per_photo(scene_of(len(stops)))[model.parameter].first()


def neutral(model):
    return model.neutral().double()


def stops_between(model, values):
    """How many stops photos are above the first one, as the values [P, V] say."""
    if isinstance(model, Affine):
        scales = values[:, :, :3].diagonal(dim1=1, dim2=2).double()
        assert bool((scales > 0).all()), "a negative"
        stops = 2.4 * scales.log2()
    else:
        stops = values.double()
    return (stops - stops[:1]).reshape(len(stops), -1)


@pytest.mark.parametrize("model", MODELS, ids=NAMES)
@pytest.mark.parametrize(
    "stops", [(-5, 5), (-3, 3), (-2, 2), (-1.3, 1.72), (0, 0, 10), (-10, 10)], ids=str
)
def test_initial_values_differ_by_the_measured_stops(model, stops, monkeypatch):
    start = start_of(model, stops, monkeypatch)
    assert torch.allclose(start.double().mean(dim=0), neutral(model), atol=ROUNDING)
    wanted = torch.tensor(stops).double() - stops[0]
    found = stops_between(model, start)
    assert torch.allclose(found, wanted[:, None].expand_as(found), atol=1e-4)


@pytest.mark.parametrize("model", MODELS, ids=NAMES)
@settings(max_examples=40, deadline=None)
@given(STOPS, st.floats(-6, 6))
def test_projection_to_a_neutral_mean_keeps_exposure_differences_between_photos(
    model, stops, level
):
    values = model.of_stops(torch.tensor(stops).double() + level)
    found = model.project({"x": values})["x"]
    assert torch.allclose(found.double().mean(dim=0), neutral(model), atol=ROUNDING)
    assert torch.allclose(stops_between(model, found), stops_between(model, values), atol=1e-4)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**16))
def test_projection_of_affine_maps_keeps_their_relative_maps(seed):
    """A_i composed with the inverse of A_j does not change, even for general affine maps."""
    noise = torch.randn(5, 3, 4, generator=torch.Generator().manual_seed(seed)).double()
    values = Affine().neutral() + 0.1 * noise
    found = Affine().project({"matrix": values})["matrix"].double()
    assert torch.allclose(found.mean(dim=0), neutral(Affine()), atol=ROUNDING)
    before, after = (squares(each) for each in (values, found))
    for one, other in zip(before[1:], after[1:], strict=True):
        expected = one @ before[0].inverse()
        assert torch.allclose(other @ after[0].inverse(), expected, atol=1e-4)


def squares(maps):
    """[P, 4, 4] of [P, 3, 4], so that a product is one map after another."""
    last = torch.tensor([0.0, 0, 0, 1]).double().expand(len(maps), 1, 4)
    return torch.cat([maps, last], dim=1)


@pytest.mark.parametrize("left", [0.0, 1e-12])
def test_affine_maps_that_remove_all_colour_have_a_finite_neutral_mean(left):
    values = torch.zeros(3, 3, 4).double()
    values[:, range(3), range(3)] = torch.tensor([[2.0, -2.0, left]]).double().T
    found = Affine().project({"matrix": values})["matrix"]
    assert torch.allclose(found.double().mean(dim=0), neutral(Affine()), atol=ROUNDING)


@pytest.mark.parametrize("model", MODELS, ids=NAMES)
def test_exposure_values_can_be_shifted_from_one_level_to_another(model):
    values, start, end = (model.of_stops(torch.tensor(s).double())
                          for s in ([-4.0, 0.0, 4.0], -4.0, 1.0))  # fmt: skip
    found = model.shift(model.parameter, values, start, end)
    expected = model.of_stops(torch.tensor([1.0, 5.0, 9.0]).double())
    assert torch.allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("model", MODELS, ids=NAMES)
@pytest.mark.parametrize("stops", [0.0, 3.5, 10.0])
def test_photos_that_a_file_places_far_from_the_mean_are_named(model, stops):
    levels = torch.tensor([stops, *[0.0] * 30, -stops]).double()
    known = model.project({model.parameter: model.of_stops(levels)})
    messages = model.messages(scene_of(len(levels)), known)
    if stops < 4:
        assert messages == ()
    else:
        assert len(messages) == 1
        assert "2 photos differ by more than 4 stops from the mean (0.png, 31.png)" in messages[0]


def test_a_photo_with_one_extreme_channel_or_a_black_map_is_named():
    for model, value in ((ChannelGain(), [0.0, -7, 7]), (Affine(), torch.zeros(3, 4).tolist())):
        known = torch.stack([model.neutral()] * 3)
        known[1] = torch.tensor(value)
        (remark,) = model.messages(scene_of(3), {model.parameter: known})
        assert "1 photos" in remark and "1.png" in remark
