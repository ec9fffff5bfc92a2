"""The analytic backbone: vanilla's Gaussians, drawn by another response."""

import numpy as np
import pytest
import torch

from crossgrad_backbones.analytic import AnalyticSplatting
from crossgrad_core.testing.backbones import created
from crossgrad_core.testing.fixtures import sample_camera, sample_phase


def test_parameters_decode_to_exponentials_and_sigmoids_without_dilation():
    backbone = AnalyticSplatting()
    parameters = created(backbone)
    gaussians = backbone.decode(parameters, sample_camera(), sample_phase())
    raw = {name: tensor.detach().double().numpy() for name, tensor in parameters.items()}
    assert gaussians.scales.detach().numpy() == pytest.approx(np.exp(raw["scales"]))
    assert gaussians.opacities.detach().numpy() == pytest.approx(
        1 / (1 + np.exp(-raw["opacities"]))
    )
    assert torch.equal(gaussians.means, parameters["means"])
    assert (gaussians.response, gaussians.dilation) == ("analytic", 0.0)
