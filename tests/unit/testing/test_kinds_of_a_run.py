"""The contract checks give hooks objects of the kinds that a default run gives them."""

from dataclasses import fields, replace

import pytest

from crossgrad_core.config import RunConfig
from crossgrad_core.plugin import Observer, ViewRecord, hookimpl
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing import observers
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state

#: Of these only the methods are promised, not the kind.
PROMISED = {"photo", "render", "rasterizer"}


class Kinds(Observer):
    """Notes the type of each field of each context."""

    def note(self, context):
        for place in (context, *self.records(context)):
            for field in fields(place):
                name = f"{type(place).__name__}.{field.name}"
                if field.name not in PROMISED:
                    SEEN.setdefault(name, set()).add(type(getattr(place, field.name)).__name__)

    def records(self, context):
        return [each for each in getattr(context, "views", ()) if isinstance(each, ViewRecord)]

    @hookimpl(wrapper=True)
    def crossgrad_sample_views(self, context):
        self.note(context)
        return (yield)

    @hookimpl(wrapper=True)
    def crossgrad_choose_scales(self, context):
        self.note(context)
        return (yield)

    @hookimpl(wrapper=True)
    def crossgrad_densify(self, context):
        self.note(context)
        return (yield)

    @hookimpl
    def crossgrad_pixel_weights(self, context):
        self.note(context)

    @hookimpl
    def crossgrad_regularize(self, context):
        self.note(context)

    @hookimpl
    def crossgrad_after_step(self, context):
        self.note(context)

    @hookimpl
    def crossgrad_step_end(self, record):
        self.note(record)


class KindsOfGradients(Kinds):
    """A run in which it is there puts no step of Adam off."""

    @hookimpl(wrapper=True)
    def crossgrad_aggregate_gradients(self, context):
        self.note(context)
        return (yield)


class KindsOfTheModel(Kinds):
    """Likewise."""

    @hookimpl
    def crossgrad_model_ready(self, model):
        self.note(model)


SEEN: dict[str, set[str]] = {}
#: A hook gets these where nothing is put off.
PLAIN = {"RegularizeContext.gaussians", "ViewRecord.gaussians"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Kinds, KindsOfGradients, KindsOfTheModel])
def test_checks_pass_the_same_types_to_hooks_as_a_run(kind):
    SEEN.clear()
    for check in set(observers.OBSERVER_CHECKS) - set(observers.COMPONENT_CHECKS):
        check(kind)
    checked = dict(SEEN)
    SEEN.clear()
    setup = assemble(RunConfig(steps=1000, threads=1), sample_scene(), "none")
    plugins = {**setup.plugins, "observer:kinds": kind()}
    setup = replace(setup, plugins=plugins, manager=make_manager(plugins))
    state = first_state(setup)
    for _ in range(2):
        state.last = timed_step(setup, state)
    assert SEEN.keys() <= checked.keys()
    other = PLAIN if kind is not Kinds else set()
    assert [name for name in SEEN.keys() - other if not SEEN[name] <= checked[name]] == []
