"""Contract checks for metrics."""

from math import isfinite

import torch
from torch import Tensor

from crossgrad_core.contract.figure import Figure
from crossgrad_core.contract.slots.metric import Compared, Metric
from crossgrad_core.defaults import METRICS
from crossgrad_core.registry.entries import load
from crossgrad_core.run.results.metrics_csv import columns_for
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import Check, Make, require


def names_its_figure(make: Make[Metric]) -> None:
    """`figure` contains a valid column name, a label, and a number format."""
    figure = getattr(make(), "figure", None)
    require(isinstance(figure, Figure), f"figure is {figure!r}, not a Figure")
    name, label = make().figure.name, make().figure.label
    require(name.isidentifier() and name == name.lower(), f"{name!r} is not a valid column name")
    require(label, "the figure has no label")
    require(format(0.5, make().figure.form), f"the format {make().figure.form!r} prints nothing")
    described_name = make().described().name
    require(
        described_name == name,
        f"described() returns the metric name {described_name!r}, but figure contains {name!r}",
    )


def its_columns_are_its_own(make: Make[Metric]) -> None:
    """The name of the metric differs from all columns that crossgrad itself writes in every run."""
    metric = make()
    first = load(Metric, METRICS.split("+")[0])
    figures = () if type(metric) is first else (first.figure,)
    free = metric.figure.name not in {"name", "regime", *columns_for((), figures)}
    require(free, f"crossgrad already writes a column {metric.figure.name!r}: rename the metric")


def measures_a_finite_number(make: Make[Metric]) -> None:
    """For every view, the result is a finite number or None.

    The result is also valid if the render equals the photo.
    """
    photo = sample_scene().test_views[0].photo.image()
    for render in (_render(), photo, torch.zeros_like(photo)):
        _require_number(make().measure(_compared(render)))


def an_empty_mask_is_no_error(make: Make[Metric]) -> None:
    """If all pixels are masked, the result is None or a finite number. No error is raised."""
    nothing = torch.zeros(_render().shape[:2], dtype=torch.bool)
    _require_number(make().measure(_compared(_render(), nothing)))


def masked_pixels_do_not_count(make: Make[Metric]) -> None:
    """Pixels of the render for which the mask is False do not change the metric."""
    mask = torch.ones(_render().shape[:2], dtype=torch.bool)
    mask[2:6, 3:12] = False
    other = _render()
    other[~mask] = 255 - other[~mask]
    one, two = (make().measure(_compared(render, mask)) for render in (_render(), other))
    require(one == two, f"masked pixels change the metric from {one} to {two}")


def same_input_same_figure(make: Make[Metric]) -> None:
    """The metric depends only on the compared images, and does not change these images."""
    compared = _compared(_render())
    one, two = make().measure(compared), make().measure(compared)
    require(one == two, f"two measurements of one render return {one} and {two}")
    require(torch.equal(compared.render, _render()), "the metric changes the render")


def _require_number(value: object) -> None:
    number = isinstance(value, int | float) and isfinite(value)
    require(
        value is None or number, f"measure() returns {value!r}; expected None or a finite number"
    )


def _compared(render: Tensor, mask: Tensor | None = None) -> Compared:
    view = sample_scene().test_views[0]
    return Compared(view, render, view.photo.image(), mask)


def _render() -> Tensor:
    view = sample_scene().test_views[0]
    generator = torch.Generator().manual_seed(5)
    noise = torch.randint(-40, 40, view.photo.image().shape, generator=generator)
    return (view.photo.image() + noise).clamp(0, 255).to(torch.uint8)


METRIC_CHECKS: tuple[Check[Metric], ...] = (
    *COMPONENT_CHECKS,
    names_its_figure,
    its_columns_are_its_own,
    measures_a_finite_number,
    an_empty_mask_is_no_error,
    masked_pixels_do_not_count,
    same_input_same_figure,
)
