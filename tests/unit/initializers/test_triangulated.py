"""`triangulated`: points where photos meet, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import entries
from crossgrad_core.run.app import bundled_scene
from crossgrad_core.run.assemble import assemble
from crossgrad_core.training.start import first_state
from crossgrad_plugins.initializers import triangulated
from crossgrad_plugins.initializers.triangulated import Triangulated
from crossgrad_plugins.readers.colmap import ColmapReader

FEW = Triangulated(views=4)


@pytest.fixture(scope="module")
def scene():
    """Real photos, and the points that COLMAP made of them."""
    return ColmapReader().read(bundled_scene(), SceneOptions(max_size=240))


@pytest.fixture(scope="module")
def bare(scene):
    views = tuple(replace(view, seen=np.zeros(0, np.int64)) for view in scene.views)
    return replace(scene, views=views, points=scene.points[:0], point_colors=scene.point_colors[:0])


def test_triangulated_points_are_near_points_of_colmap_and_have_their_colour(scene, bare):
    from scipy.spatial import cKDTree

    more = FEW.more_points(bare)
    assert len(more.positions) > 100
    distances, rows = cKDTree(scene.points).query(more.positions)
    # In units of the extent of the cameras; COLMAP's own points are 0.0036 apart.
    assert np.median(distances) < 0.006
    assert np.quantile(distances, 0.9) < 0.03
    difference = np.abs(more.colors.astype(int) - scene.point_colors[rows].astype(int))
    assert np.median(difference) < 20
    assert np.isnan(more.sizes).all()
    begun = FEW.begun(bare)
    assert begun.points.tobytes() == more.positions.tobytes()
    assert f"{len(more.positions)} points triangulated" in FEW.messages(bare)[0]


@pytest.mark.slow
def test_triangulation_is_repeatable(bare):
    ours, again = FEW.more_points(bare), FEW.more_points(replace(bare))
    assert ours.positions.tobytes() == again.positions.tobytes()


def test_a_scene_with_points_keeps_its_points(scene):
    assert Triangulated().more_points(scene) is None
    assert "has points" in Triangulated().messages(scene)[0]


def test_a_scene_without_points_is_refused_with_the_options_that_add_points(bare):
    config = RunConfig(scene="somewhere", steps=2, threads=1, plan="off")
    with pytest.raises(UserError, match="no SfM points") as caught:
        assemble(config, bare, "colmap")
    assert "--initializer triangulated" in caught.value.todo
    assert "--init random" in caught.value.todo
    config = RunConfig(
        scene="somewhere", threads=1, initializer={"name": "triangulated", "views": 4}
    )
    setup = assemble(config, bare, "colmap")
    assert setup.selection.initializer == FEW


@pytest.mark.sampled(1)
@pytest.mark.parametrize("backbone", sorted(entries("backbones")))
def test_every_backbone_can_start_from_triangulated_points(bare, backbone):
    """Triangulated points have no sizes and opacities, so the backbone must choose them."""
    chosen = {"backbone": {"name": backbone}, "initializer": {"name": "triangulated", "views": 4}}
    setup = assemble(RunConfig(scene="somewhere", steps=2, threads=1, **chosen), bare, "colmap")
    state = first_state(setup)
    assert state.primitives(setup) > 100
    assert all(tensor.isfinite().all() for tensor in state.parameters.values())


def test_photos_without_common_content_are_refused(bare):
    alone = replace(bare, train=bare.train[:1])
    with pytest.raises(UserError, match="no points could be triangulated"):
        Triangulated().more_points(alone)


def test_masked_pixels_are_not_triangulated(bare):
    from torch import zeros

    class Hidden:
        def __init__(self, photo):
            self.image = photo.image

        def mask(self):
            return zeros(self.image().shape[:2], dtype=bool)

    views = tuple(replace(view, photo=Hidden(view.photo)) for view in bare.views)
    with pytest.raises(UserError, match="no points could be triangulated"):
        FEW.more_points(replace(bare, views=views))


def test_rays_of_one_point_meet_at_the_point(scene):
    first, *others = scene.views
    second = max(others, key=lambda view: len(np.intersect1d(view.seen, first.seen)))
    points = scene.points[np.intersect1d(first.seen, second.seen)[:50]]
    count = len(points)
    colors, unlike = np.zeros((count, 3), np.uint8), np.eye(count, dtype=np.float32)
    ends = [
        triangulated.Features(view.camera, view.camera.project(points)[0], unlike, colors)
        for view in (first, second)
    ]
    met = triangulated.meet(*ends, pixels=0.01)
    assert len(met.points) > 10
    assert met.first.tolist() == met.second.tolist()
    np.testing.assert_allclose(met.points, points[met.first], atol=1e-9)
