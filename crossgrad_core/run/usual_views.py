"""The operator of a run, and its views per step where the user names no number."""

from typing import Final

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.operator import Operator
from crossgrad_core.contract.pace import ViewsPerStepSpec
from crossgrad_core.contract.sampler import Sampler
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


def usual_views(config: RunConfig, sampler: Sampler, operator: Operator, notes: list[str]) -> int:
    """K where the user names none: the sampler's, or the least that leaves no operator idle.

    Args:
        config: The configuration.
        sampler: Its sampler.
        operator: Its operator.
        notes: Gets a line where K is not the sampler's.
    """
    usual = sampler.usual_views
    of_sampler = (k for k in range(1, _MOST_VIEWS) if sampler.view_counts.admits(k))
    both = [k for k in of_sampler if operator.views.admits(k)]
    # Who names no operator expects no more than a sum of one gradient.
    named = config.operator != RunConfig.model_fields["operator"].default
    if usual not in both:
        found, why = next(iter(both), 0), f"the operator needs {operator.views}"
    elif named and operator.wants_more(usual):
        found = next((k for k in both if not operator.wants_more(k)), usual)
        why = "with fewer views an operator that you named does nothing"
    else:
        found, why = usual, ""
    if found and found != usual:
        notes.append(f"K = {found}: {why}")
    # Where no K suits both, the objections say so.
    return found or usual


def views_per_step_spec_of(config: RunConfig) -> ViewsPerStepSpec:
    """K over a run of that configuration, as it will be assembled."""
    if config.view_plan is not None:
        return config.view_plan
    sampler = build(Sampler, config.sampler.name, config.sampler.options)
    return ViewsPerStepSpec((usual_views(config, sampler, operator_of(config)[0], []),))
