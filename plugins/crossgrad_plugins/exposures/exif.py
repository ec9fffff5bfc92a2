"""Exposure values of a scene's photos, from their EXIF headers."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from weakref import WeakKeyDictionary

from crossgrad_core.plugin import Scene
from crossgrad_plugins.exposures.photo_headers import exposure_value

#: Headers that are read at once.
_AT_ONCE = 4

# A run asks at every evaluation, and a scene does not change.
_KNOWN: "WeakKeyDictionary[Scene, Mapping[str, float]]" = WeakKeyDictionary()


def exposure_values(scene: Scene) -> Mapping[str, float]:
    """Name -> log2(t ISO / N^2) of all photos that tell; read once for a scene."""
    found = _KNOWN.get(scene)
    if found is None:
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            values = list(pool.map(exposure_value, scene.views))
        told = zip(scene.views, values, strict=True)
        found = _KNOWN[scene] = {view.name: value for view, value in told if value is not None}
    return found
