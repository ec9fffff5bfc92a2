"""New groups of the training views in the middle of a run."""

from crossgrad_core.contract import sampler
from crossgrad_core.contract.grouping import Regrouping, Rule
from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.state import EMPTY_STATE, PluginState
from crossgrad_core.errors import UserError
from crossgrad_core.training.model import model_of
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

#: Name of the state that holds the labels, and of their stream of random numbers.
STATE = "grouping"
_LABELS = "labels"


def regroup_if_due(setup: Setup, state: TrainState) -> None:
    """Groups the training views anew where the step that was done last is the one for it.

    The sampler starts afresh: what it remembers (decks of views, turns) is about the old groups.
    """
    grouping = setup.selection.grouping
    if not isinstance(grouping, Regrouping) or state.step != grouping.refit_after:
        return
    rule = grouping.refit(model_of(setup, state), state.rngs[STATE])
    labels = labels_of(rule, setup.scene, setup.selection.names["grouping"])
    state.commit({STATE: PluginState({_LABELS: list(labels)}), sampler.STATE: EMPTY_STATE})
    for note in rule.notes:
        setup.hook.crossgrad_log(text=f"step {state.step}: {note}")


def labels_of(rule: Rule, scene: Scene, name: str) -> tuple[str, ...]:
    """The labels of the training views by the rule of the grouping of that name, one for each."""
    labels, views = tuple(rule.labels(scene.train_views)), scene.train_views
    if len(labels) == len(views):
        return labels
    raise UserError(
        f"grouping {name} does not label each view",
        found=f"{len(labels)} labels of {len(views)} training views",
        todo="choose another --grouping, or repair the plugin",
    )


def groups_of(setup: Setup, state: TrainState) -> tuple[str, ...] | None:
    """The label of each training view now; None where there is no grouping."""
    known = state.states.get(STATE, EMPTY_STATE).values.get(_LABELS)
    return tuple(map(str, known)) if isinstance(known, list) else setup.groups
