"""Groupings that look at more than positions: footprints, gradients, the user's lists."""

import numpy as np
import pytest

from crossgrad_core.contract.scene import footprint_of
from crossgrad_core.errors import UserError
from crossgrad_core.testing.fixtures import posed_scene, posed_view
from crossgrad_plugins.groupings.conflict_signature import (
    ConflictSignature,
    mean_cosines,
    spectral_cut,
)
from crossgrad_plugins.groupings.distance import Radial
from crossgrad_plugins.groupings.footprint import Footprint
from crossgrad_plugins.groupings.lists import Lists

RNG = np.random.default_rng(0)


def names(*paths):
    return posed_scene([posed_view((i, 0, 0), path) for i, path in enumerate(paths)])


def test_a_footprint_is_the_median_of_focal_length_over_depth():
    points = [(0, 2, 0), (0, 4, 0), (0, 10, 0), (0, -3, 0)]
    view = posed_view((0, 0, 0), focal=12.0, seen=(0, 1, 2, 3))
    assert footprint_of(posed_scene([view], points), view) == pytest.approx(12.0 / 4.0)


def test_a_view_without_observations_uses_the_points_in_its_image():
    points = [(0, 2, 0), (0, 8, 0), (50, 3, 0), (0, -3, 0)]
    view = posed_view((0, 0, 0), focal=10.0)
    assert footprint_of(posed_scene([view], points), view) == pytest.approx(10.0 / 5.0)


def test_a_scene_without_visible_points_is_a_user_error():
    view = posed_view((0, 0, 0))
    scene = posed_scene([view], [(0, -5, 0)])
    assert np.isnan(footprint_of(scene, view))
    with pytest.raises(UserError, match="no SfM point is visible in a training photo"):
        Footprint().fit(scene, RNG)


@pytest.mark.parametrize(("place", "label"), [((0.1, -1, 0), "near"), ((3.9, -8, 0), "far")])
def test_a_view_without_points_gets_the_label_of_the_nearest_camera(place, label):
    views = [posed_view((i, -1.0 - 7 * (i > 2), 0), f"{i}.png", seen=[0]) for i in range(5)]
    blind = posed_view(place, "blind.png", forward=(0, -1, 0))
    scene = posed_scene([*views, blind], [(0, 0, 0)])
    rule = Footprint().fit(scene, RNG)
    assert rule.labels(scene.views) == ("near", "near", "near", "far", "far", label)
    assert "views without SfM points join the group of the nearest other view: 1" in rule.notes[0]


@pytest.mark.parametrize("depths", [(1, 1.1, 1.2, 1.3, 1.4, 1.5, 9, 10), (1, 2, 7, 8, 9, 10, 11)])
def test_the_otsu_cut_is_at_the_gap_and_the_median_cut_in_the_middle(depths):
    views = [posed_view((i, -d, 0), f"{i}.png", seen=[i]) for i, d in enumerate(depths)]
    scene = posed_scene(views, [(i, 0, 0) for i in range(len(depths))])
    near = [d < 5 for d in depths]
    cut = Footprint(cut="otsu").fit(scene, RNG).labels(scene.views)
    assert [label == "near" for label in cut] == near
    halved = Footprint().fit(scene, RNG).labels(scene.views)
    assert abs(2 * halved.count("near") - len(depths)) <= 1
    # From their mean all stand at a distance; one that stands there does not move the cut.
    around = [posed_view((s * d, 0, 0), f"{s}{d}.png") for d in depths for s in (-1, 1)]
    middle = posed_view((0, 0, 0), "middle.png")
    labels = Radial(cut="otsu").fit(posed_scene([*around, middle]), RNG).labels(around)
    assert [label == "near" for label in labels] == [each for each in near for _ in (0, 1)]


def test_the_focal_length_decides_if_all_cameras_are_at_one_position():
    views = [posed_view((0, 0, 0), f"{f}.png", focal=f, seen=(0,)) for f in (4.0, 8.0, 16.0, 2.0)]
    scene = posed_scene(views, [(0, 5, 0)])
    labels = Footprint().fit(scene, RNG).labels(scene.views)
    assert labels == ("far", "near", "near", "far")


def test_without_a_gradient_probe_the_conflict_signature_is_the_radial_split():
    scene = names("a.png", "b.png", "c.png", "d.png")
    rule = ConflictSignature(at=7).fit(scene, RNG)
    assert rule.labels(scene.views) == Radial().fit(scene, RNG).labels(scene.views)
    assert "after step 7" in rule.notes[0]


class VectorProbe:
    """Gradients given as vectors; remembers which views it was asked for."""

    def __init__(self, *vectors):
        self.blocks = tuple(str(i) for i in range(len(vectors)))
        self.vectors = [np.array(block, dtype=float) for block in vectors]
        self.asked = []

    def gramians(self, views):
        self.asked += list(views)
        rows = [block[list(views)] for block in self.vectors]
        return np.stack([row @ row.T for row in rows])


def test_the_conflict_signature_separates_opposing_gradients():
    probe = VectorProbe([[1, 0], [-1, 0.1], [1, 0.1], [-1, 0]])
    scene = names("a.png", "b.png", "c.png", "d.png")
    labels = ConflictSignature().fit(scene, RNG, probe).labels(scene.views)
    assert labels[0] == labels[2] != labels[1] == labels[3]


def test_the_conflict_signature_ignores_lengths_and_zero_gradients():
    probe = VectorProbe([[1e-9, 0], [-3e7, 0], [2, 0], [0, 0]], [[1, 0], [-1, 0], [1, 0], [-2, 0]])
    scene = names("a.png", "b.png", "c.png", "d.png")
    labels = ConflictSignature().fit(scene, RNG, probe).labels(scene.views)
    assert labels[0] == labels[2] != labels[1] == labels[3]


def test_views_without_probed_gradients_get_the_label_of_the_nearest_probed_view():
    probe = VectorProbe([[1.0]] * 5 + [[-1.0]] * 5)
    scene = names(*(f"{i}.png" for i in range(10)))
    labels = ConflictSignature(cameras=4).fit(scene, RNG, probe).labels(scene.views)
    assert probe.asked == [0, 3, 6, 9]
    assert labels[:5] == (labels[0],) * 5
    assert labels[5:] == (labels[9],) * 5
    assert labels[0] != labels[9]


def test_cosines_are_averaged_over_blocks_with_nonzero_gradients():
    gramians = np.array([[[1.0, -1.0], [-1.0, 1.0]], [[0.0, 0.0], [0.0, 4.0]]])
    assert np.allclose(mean_cosines(gramians), [[1.0, -1.0], [-1.0, 1.0]])


def test_the_spectral_cut_is_finite_for_exactly_opposite_gradients():
    cosines = np.array([[1.0, 1.0, -1.0], [1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    sides = spectral_cut(cosines)
    assert sides[0] == sides[1] != sides[2]


def test_names_of_photo_folders_become_labels():
    scene = names("street/1.png", "aerial/1.png", "street/deep/2.png")
    rule = Lists().fit(scene, RNG)
    assert rule.labels(scene.views) == ("street", "aerial", "street")


def test_a_grouping_by_folders_refuses_a_single_folder():
    scene = names("a/1.png", "a/2.png")
    with pytest.raises(UserError, match="CSV"):
        Lists().fit(scene, RNG)


@pytest.fixture
def listed(tmp_path):
    def write(text, *paths):
        file = tmp_path / "labels.csv"
        file.write_text(text)
        scene = names(*paths)
        return Lists(file=file).fit(scene, RNG).labels(scene.views)

    return write


def test_a_label_file_may_name_views_and_folders(listed):
    text = "# name,label\nnear/,near\nnear/3.png,far\nb.png, far\n\nnear/deep/,low\n"
    labels = listed(text, "near/1.png", "near/3.png", "b.png", "near/deep/1.png")
    assert labels == ("near", "far", "far", "low")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        pytest.param("a.png,near\n", "b.png", id="a view is missing"),
        pytest.param("a.png,near\nb.png\n", "b.png", id="no label"),
        pytest.param("a.png,near\nb.png,\n", "b.png", id="an empty label"),
        pytest.param("a.png,near\na.png,far\nb.png,far\n", "a.png: near, far", id="two labels"),
        pytest.param("a.png,near\nb.png,near\n", "near", id="one group"),
    ],
)
def test_a_bad_label_file_is_a_user_error_that_names_the_row(listed, text, found):
    with pytest.raises(UserError) as error:
        listed(text, "a.png", "b.png")
    assert found in error.value.found
    assert "labels.csv" in error.value.where


def test_a_missing_label_file_is_a_user_error(tmp_path):
    scene = names("a.png", "b.png")
    with pytest.raises(UserError, match="cannot be read"):
        Lists(file=tmp_path / "no.csv").fit(scene, RNG)


@pytest.mark.parametrize("size", [1, 2, 5, 8])
@pytest.mark.parametrize("seed", range(5))
def test_the_spectral_cut_separates_orthogonal_groups(size, seed):
    # The largest eigenvalue stands there twice: any vector of its plane comes out of a solver.
    sides = np.repeat([1.0, -1.0], size)
    order = np.random.default_rng(seed).permutation(2 * size)
    cosines = np.outer(sides, sides)[np.ix_(order, order)]
    found = spectral_cut(cosines)
    assert len(set(found[sides[order] > 0])) == 1
    assert len(set(found[sides[order] < 0])) == 1
    assert len(set(found)) == 2


def test_the_spectral_cut_does_not_separate_views_with_equal_gradients():
    assert spectral_cut(np.ones((2, 2))).tolist() == [0, 0]
    assert spectral_cut(np.ones((5, 5))).tolist() == [0] * 5
