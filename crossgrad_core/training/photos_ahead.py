"""Photos that are decoded while something else takes its time."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Event, Thread

from crossgrad_core.contract.scene import Scene


@contextmanager
def decoded_meanwhile(scene: Scene) -> Iterator[None]:
    """Decodes the scene's photos in a thread as long as the block runs, the held-out ones first.

    They stay where decoded photos are kept, as far as there is room. A photo that cannot be decoded
    is left alone; the next access to it raises the error.
    """
    over = Event()
    thread = Thread(target=_decode, args=(scene, over), name="crossgrad-photos", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _decode(scene: Scene, over: Event) -> None:
    for view in (*scene.test_views, *scene.train_views):
        if over.is_set():
            return
        with suppress(Exception):
            view.photo.image()
