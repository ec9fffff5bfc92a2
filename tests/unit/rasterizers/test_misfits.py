"""Gaussians whose tensors do not go together are refused: kernels would read foreign memory."""

from dataclasses import replace

import pytest
import torch

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.errors import UserError
from crossgrad_core.testing.fixtures import sample_camera
from crossgrad_core.testing.rasterizers import sample_gaussians
from crossgrad_plugins.rasterizers.numba_cpu import NumbaRasterizer

FIELDS = ("means", "quats", "scales", "opacities", "colors", "sh_dc", "sh_rest", "origin", "slot")


def complete(harmonics):
    some = sample_gaussians(harmonics=harmonics)
    rows = torch.arange(len(some))
    return replace(some.detached(), origin=rows, slot=torch.zeros_like(rows))


def drawn(gaussians):
    return NumbaRasterizer().render(gaussians, sample_camera(), torch.zeros(3))


@pytest.mark.sampled(37)
@pytest.mark.parametrize("harmonics", [False, True])
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize(
    "change",
    [
        lambda t: t[1:],
        lambda t: torch.cat([t, t]),
        lambda t: t[:0],
        lambda t: t[..., None],
        lambda t: t.flatten(),
        lambda t: t[..., :1],
    ],
    ids=["a row short", "twice the rows", "no row", "a dimension more", "flat", "one column"],
)
def test_a_tensor_of_another_shape_is_refused(field, change, harmonics):
    some = complete(harmonics)
    tensor = getattr(some, field)
    if tensor is None or change(tensor).shape == tensor.shape:
        pytest.skip("it is as it was, or not there")
    wrong = replace(some, **{field: change(tensor)})
    if field == "means":  # They count the Gaussians, so that the first other one is named.
        with pytest.raises(UserError, match="cannot be rendered"):
            drawn(wrong)
        return
    with pytest.raises(UserError) as refused:
        drawn(wrong)
    assert refused.value.found.startswith(f"{field} is {list(change(tensor).shape)}, not ")


def test_gaussians_with_both_or_neither_of_colors_and_sh_are_refused():
    some = complete(harmonics=True)
    for wrong in (replace(some, colors=some.means), replace(some, sh_dc=None)):
        with pytest.raises(UserError, match="colors or sh_dc"):
            drawn(wrong)


def test_an_sh_degree_without_its_coefficients_is_refused():
    some = complete(harmonics=True)
    assert some.sh_rest is not None
    wrong = replace(some, sh_degree=3, sh_rest=some.sh_rest[:, :8])
    with pytest.raises(UserError, match=r"not \[\d+, 15, 3\]"):
        drawn(wrong)


@pytest.mark.parametrize(("degree", "rest"), [(3, False), (1, False), (-1, True), (4, True)])
def test_an_sh_degree_that_does_not_exist_is_refused(degree, rest):
    some = complete(harmonics=True)
    bands = torch.zeros((len(some), 24, 3)) if rest else None
    with pytest.raises(UserError, match=f"sh_degree is {degree}"):
        drawn(replace(some, sh_degree=degree, sh_rest=bands))


@pytest.mark.parametrize("harmonics", [False, True])
def test_complete_gaussians_are_rendered(harmonics):
    some: Gaussians = complete(harmonics)
    assert some.misfit() is None
    assert drawn(some).image.isfinite().all()
