"""Groups of training views, as samplers need them."""

from collections.abc import Mapping, Sequence
from functools import lru_cache

from crossgrad_core.plugin import SampleContext, UserError, ViewSample


def members_of(context: SampleContext) -> Mapping[str, tuple[int, ...]]:
    """Label -> positions of its training views; `near` comes first and `far` last."""
    return _members(context.groups or ())


def groups_of(context: SampleContext, sampler: str, expected: int) -> Mapping[str, tuple[int, ...]]:
    """The same, where a sampler needs a certain number of groups.

    Args:
        context: The step.
        sampler: Name of the asking sampler, for the message.
        expected: How many groups it needs.

    Raises:
        UserError: There is no grouping, or it makes another number of groups.
    """
    groups = members_of(context)
    if len(groups) != expected:
        raise UserError(
            f"sampler {sampler} needs {expected} groups of training views",
            where="sampler, grouping",
            expected=f"{expected} labels",
            found=", ".join(groups) if groups else "no grouping",
            todo="choose a grouping with --grouping; `crossgrad plugins list` names them",
        )
    return groups


def drawn(views: Sequence[int], context: SampleContext) -> ViewSample:
    """The draw of these views with their labels, where there is a grouping."""
    groups = context.groups
    labels = None if groups is None else tuple(groups[view] for view in views)
    return ViewSample(tuple(views), labels)


@lru_cache(maxsize=8)
def _members(labels: tuple[str, ...]) -> Mapping[str, tuple[int, ...]]:
    names = sorted(set(labels), key=lambda label: (_rank(label), label))
    return {name: tuple(i for i, label in enumerate(labels) if label == name) for name in names}


def _rank(label: str) -> int:
    """0 for near, 2 for far, 1 for anything else."""
    return {"near": 0, "far": 2}.get(label, 1)
