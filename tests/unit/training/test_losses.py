"""The slot `losses`: what training brings down is what was chosen."""

import numpy as np
import pytest
import torch
from support.scenes import write_tiny_scene

from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build
from crossgrad_core.run.settings import parsed
from crossgrad_plugins.losses.photometric.reference import l1_ssim_loss, ssim_map

RNG = np.random.default_rng(0)
IMAGE = torch.from_numpy(RNG.random((20, 16, 3), dtype=np.float32))
PHOTO = torch.from_numpy(RNG.integers(0, 256, (20, 16, 3), dtype=np.uint8))
MASK = torch.from_numpy(RNG.random((20, 16)) < 0.7)
WEIGHTS = torch.from_numpy(RNG.random((20, 16), dtype=np.float32))


@pytest.mark.parametrize("mask", [None, MASK], ids=["all", "masked"])
@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_weights_give_a_weighted_mean_over_the_unmasked_pixels(mask, share):
    found = build("losses", "l1-ssim", {"ssim_weight": share}).loss(IMAGE, PHOTO, mask, WEIGHTS)
    kept = torch.ones(20, 16) if mask is None else mask.float()
    x, y = IMAGE * kept[..., None], PHOTO / 255 * kept[..., None]
    each = (1 - share) * (x - y).abs() + share * (1 - ssim_map(x, y))
    expected = np.average(each.mean(-1).numpy(), weights=(WEIGHTS * kept).numpy())
    assert float(found) == pytest.approx(expected, rel=1e-5)


def test_the_reference_loss_without_weights_equals_the_loss_with_equal_weights():
    plain = l1_ssim_loss(IMAGE, PHOTO, MASK)
    weighted = l1_ssim_loss(IMAGE, PHOTO, MASK, 0.2, torch.full((20, 16), 3.0))
    assert float(plain) == pytest.approx(float(weighted), rel=1e-6)


@pytest.mark.parametrize("weights", [torch.ones(16, 20), torch.ones(20, 16).bool()])
def test_weights_of_another_shape_or_type_are_refused(weights):
    with pytest.raises(ValueError, match="weights"):
        build("losses", "l1-ssim", {}).loss(IMAGE, PHOTO, None, weights)


def test_an_unknown_loss_is_refused_by_name(tmp_path):
    from crossgrad_core.run.assemble import check_names

    with pytest.raises(UserError, match="no loss named 'l1-sim'") as caught:
        check_names(parsed({"loss": {"name": "l1-sim"}}))
    assert "l1-ssim" in caught.value.todo


def test_a_default_run_minimizes_the_fused_loss(tmp_path):
    from crossgrad_core.run.load_run import set_up

    write_tiny_scene(tmp_path / "scene", views=4)
    setup, _ = set_up(
        parsed({"scene": str(tmp_path / "scene"), "loss": {"name": "l1-ssim", "ssim_weight": 0.4}}),
    )
    assert setup.loss == build("losses", "l1-ssim", {"ssim_weight": 0.4})
    assert setup.selection.names["loss"] == "l1-ssim"
    assert setup.selection.names["exporter"] == "ply"
