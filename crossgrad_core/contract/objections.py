"""Objections to the selected components: impossible combinations, and options without effect."""

from collections.abc import Iterator, Mapping

from crossgrad_core.contract.component import Component
from crossgrad_core.contract.gramian_operator import GramianOperator
from crossgrad_core.contract.selection import HasUnusedOptions, Selection
from crossgrad_core.contract.slots.operator import Operator
from crossgrad_core.contract.slots.rasterizer import Rasterizer


def objections_to(selection: Selection) -> list[str]:
    """Return the core's reasons why the selected components cannot work together."""
    return [
        *_of_the_sampler(selection),
        *objections_to_views(selection.operator, selection),
        *_of_the_densifier(selection),
        *_of_the_rasterizer(selection),
        *_of_the_resolution(selection),
    ]


def objections_to_views(operator: Operator, selection: Selection) -> list[str]:
    """Return one objection for each number of views that the operator does not support."""
    name, needed, objections = selection.names["operator"], operator.views, []
    for views in selection.views.counts:
        counts = sorted(selection.sampler.counts(views))
        if not needed.admits(views):
            objections.append(f"operator {name} needs {needed} (--views); K is {views}")
        elif not all(map(needed.admits, counts)):
            listed = ", ".join(map(str, counts))
            objections.append(
                f"operator {name} needs {needed}; with sampler {selection.names['sampler']} steps "
                f"have {listed} views"
            )
    return objections


def _of_the_sampler(selection: Selection) -> Iterator[str]:
    sampler, labels = selection.sampler, selection.labels
    name = selection.names["sampler"]
    for views in selection.views.counts:
        if not sampler.view_counts.admits(views):
            yield f"sampler {name} needs {sampler.view_counts} (--views); K is {views}"
    if sampler.groups is not None and labels is not None and len(labels) != sampler.groups:
        yield (
            f"sampler {name} needs {sampler.groups} groups of views; grouping "
            f"{selection.names['grouping']} makes {len(labels)}: "
            f"{', '.join(map(str, labels))}"
        )


def _of_the_densifier(selection: Selection) -> Iterator[str]:
    densifier, names = selection.densifier, selection.names
    have = {tensor for block in selection.backbone.blocks() for tensor in block.tensors}
    if missing := sorted(densifier.tensors - have):
        yield (
            f"densifier {names['densifier']} edits the tensors {', '.join(missing)}, "
            f"which backbone {names['backbone']} does not have"
        )
    if missing := sorted(densifier.needs - selection.rasterizer.provides):
        yield (
            f"densifier {names['densifier']} needs the screen statistics {', '.join(missing)}, "
            f"which rasterizer {names['rasterizer']} does not provide"
        )


def _of_the_rasterizer(selection: Selection) -> Iterator[str]:
    rasterizer, backbone, names = selection.rasterizer, selection.backbone, selection.names
    if selection.device not in rasterizer.devices:
        yield f"rasterizer {names['rasterizer']} does not run on device {selection.device}"
    if backbone.response not in rasterizer.responses:
        yield (
            f"rasterizer {names['rasterizer']} does not support the pixel response "
            f"{backbone.response} of backbone {names['backbone']}"
        )


def _of_the_resolution(selection: Selection) -> Iterator[str]:
    backbone, names = selection.backbone, selection.names
    if selection.resolution.strided and backbone.response == "analytic":
        yield (
            f"resolution {names['resolution']} renders only a part of the pixels, but "
            f"backbone {names['backbone']} has the pixel response analytic, which is a "
            "mean over all pixels"
        )


def unused_options(component: Component, selection: Selection) -> Mapping[str, str]:
    """Return the options of a component that would have no effect: name -> reason and remedy."""
    idle: dict[str, str] = {}
    if isinstance(component, GramianOperator) and not component.reads_gramians():
        idle["granularity"] = "this operator uses no Gramians; leave the option out"
    if isinstance(component, Rasterizer) and selection.backbone.sets_dilation:
        name = selection.names["backbone"]
        idle["dilation"] = f"backbone {name} sets its own dilation; leave the option out"
    if isinstance(component, HasUnusedOptions):
        idle |= component.unused_options(selection)
    return idle


def set_for_nothing(component: Component, selection: Selection) -> dict[str, str]:
    """Return the unused options whose values are not their defaults."""
    fields = type(component).model_fields
    return {
        name: why
        for name, why in unused_options(component, selection).items()
        if name in component.model_fields_set
        and name in fields
        and getattr(component, name) != fields[name].default
    }
