"""The operator of a run, and its views per step if the user sets no number."""

from typing import Final

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.operator import Operator
from crossgrad_core.contract.sampler import Sampler
from crossgrad_core.contract.schedule import ViewsPerStepSpec
from crossgrad_core.defaults import CHAIN
from crossgrad_core.registry.entries import build

#: Up to which K one that suits both is looked for.
_MOST_VIEWS: Final = 13


def operator_of(config: RunConfig) -> tuple[Operator, str]:
    """The operator of a run, a chain where several are named, and its name."""
    links = config.operators
    built = tuple(build(Operator, link.name, link.options) for link in links)
    operator = built[0] if len(built) == 1 else build(Operator, CHAIN, {"links": built})
    return operator, "+".join(link.name for link in links)


def views_per_step_of(config: RunConfig) -> tuple[ViewsPerStepSpec, str]:
    """Return K over a run, and why it is not the usual one of the sampler; empty if it is.

    If no K is set, it is the sampler's, or the least one that leaves no operator idle.
    """
    if config.view_plan is not None:
        return config.view_plan, ""
    sampler = build(Sampler, config.sampler.name, config.sampler.options)
    operator, _ = operator_of(config)
    usual = sampler.usual_views
    of_sampler = (k for k in range(1, _MOST_VIEWS) if sampler.view_counts.admits(k))
    both = [k for k in of_sampler if operator.views.admits(k)]
    # Who names no operator expects no more than a sum of one gradient.
    named = config.operator != RunConfig.model_fields["operator"].default
    found, why = usual, ""
    if usual not in both:
        # If no K suits both, the objections say so.
        found, why = next(iter(both), usual), f"the operator needs {operator.views}"
    elif named and operator.needs_more_views(usual):
        found = next((k for k in both if not operator.needs_more_views(k)), usual)
        why = "with fewer views the operator does nothing"
    return ViewsPerStepSpec((found,)), why if found != usual else ""
