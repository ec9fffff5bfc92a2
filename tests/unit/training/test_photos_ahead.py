"""Photos are decoded while kernels compile: held-out ones first, and no longer than that."""

from dataclasses import replace
from threading import Event, current_thread, main_thread

import pytest

from crossgrad_core.config import RunConfig
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import NoisePhoto, sample_scene
from crossgrad_core.training.scaled_photos import decoded_meanwhile
from crossgrad_core.training.start import warm_up


class Watched:
    """A photo that notes who asks for it; may wait or fail."""

    def __init__(self, asked, name, wait=None, error=None):
        self._asked, self._name, self._wait, self._error = asked, name, wait, error

    def image(self):
        if current_thread() is not main_thread():
            self._asked.append(self._name)
            if self._wait is not None:
                self._wait.wait(10.0)
        if self._error is not None:
            raise self._error
        return NoisePhoto(0).image()

    def mask(self):
        return None


def watched(asked, **changes):
    scene = sample_scene()
    views = tuple(
        replace(view, photo=Watched(asked, view.name, **changes.get(view.name, {})))
        for view in scene.views
    )
    return replace(scene, views=views)


def test_held_out_photos_are_decoded_first_and_each_photo_once():
    asked, done = [], Event()
    scene = watched(asked)
    last = scene.train_views[-1]
    last.photo._wait = done
    with decoded_meanwhile(scene):
        while last.name not in asked:
            done.wait(0.01)
        done.set()
    names = [view.name for view in (*scene.test_views, *scene.train_views)]
    assert asked == names


def test_no_photo_is_decoded_after_the_block_even_after_an_exception():
    asked, go_on = [], Event()
    scene = watched(asked, **{sample_scene().test_views[0].name: {"wait": go_on}})

    def interrupted():
        with decoded_meanwhile(scene):
            while not asked:
                go_on.wait(0.01)
            go_on.set()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    count = len(asked)
    go_on.wait(0.01)
    assert len(asked) == count


def test_an_error_in_decoding_ahead_is_raised_at_the_request():
    asked, name = [], sample_scene().test_views[0].name
    scene = watched(asked, **{name: {"error": OSError("broken")}})
    with decoded_meanwhile(scene):
        while len(asked) < len(scene.views):
            Event().wait(0.01)
    assert asked[0] == name
    with pytest.raises(OSError, match="broken"):
        scene.test_views[0].photo.image()


def test_photos_are_decoded_while_kernels_are_loaded():
    asked = []
    config = RunConfig(steps=4, exposure={"name": "none"}, plan="off")
    setup = assemble(config, watched(asked), "none")
    warm_up(setup)
    assert asked[0] == setup.scene.test_views[0].name
