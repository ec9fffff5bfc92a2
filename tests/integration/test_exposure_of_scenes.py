"""The rule for exposure on real photos: the bundled scene, and others where they are there."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from crossgrad_core.commands import configured, read_scene
from crossgrad_core.run.app import bundled_scene
from crossgrad_plugins.exposures.tracks.gains import deciding_gains, track_gains

#: Scene -> standard deviation of the gains in stops, share of the deviation that they take away,
#: and whether photos differ (docs/exposure.md).
KNOWN = {
    "boruszyn_kap": (0.39, 0.56, True),
    "brighton_beach": (0.46, 0.72, True),
    "city_hybrid": (0.06, 0.09, False),
    "city_unimodal": (0.04, 0.08, False),
    "ochota_kap_hybrid": (1.46, 0.80, True),
    "ochota_kap_hybrid_gain": (0.10, 0.10, False),
}
#: A folder with scenes of these names.
SCENES = Path(os.environ.get("CROSSGRAD_SCENES", "no-such-folder"))


def gains_of(path, **reading):
    scene, _ = read_scene(configured({"scene": path, "threads": 1, "data": reading}))
    return track_gains(scene, scene.views)


def test_the_bundled_scene_differs_in_exposure_at_any_size():
    for size in (100, 200):
        gains = gains_of(bundled_scene(), max_size=size)
        assert gains.differ
        assert gains.spread == pytest.approx(0.39, abs=0.04)
        assert gains.fit.reduction == pytest.approx(0.58, abs=0.06)


@pytest.mark.parametrize("name", KNOWN)
def test_the_exposure_rule_decides_known_scenes_as_in_the_table(name):
    if not (SCENES / name).is_dir():
        pytest.skip("CROSSGRAD_SCENES names no folder with this scene")
    spread, reduction, differ = KNOWN[name]
    gains = gains_of(SCENES / name)
    assert gains.differ == differ
    assert gains.spread == pytest.approx(spread, abs=0.02)
    assert gains.fit.reduction == pytest.approx(reduction, abs=0.03)


@pytest.mark.parametrize(
    ("name", "differ"), [("ochota_kap_hybrid", True), ("ochota_kap_hybrid_gain", False)]
)
def test_the_exposure_rule_needs_only_thirty_shared_points_of_near_and_far_photos(name, differ):
    if not (SCENES / name).is_dir():
        pytest.skip("CROSSGRAD_SCENES names no folder with this scene")
    scene, _ = read_scene(configured({"scene": SCENES / name, "threads": 1}))
    near = [view for view in scene.views if view.regime == "near"]
    shown = np.zeros((2, len(scene.points)), dtype=bool)
    for view in scene.views:
        shown[int(view.regime == "near"), view.seen] = True
    shared = np.flatnonzero(shown.all(axis=0))
    lost = np.random.default_rng(0).permutation(shared)[30:]
    thinned = {view.name: view.seen[~np.isin(view.seen, lost)] for view in near}
    views = [replace(v, seen=thinned.get(v.name, v.seen)) for v in scene.views]
    assert deciding_gains(replace(scene, views=tuple(views))).differ == differ
