"""`filled`: what it takes for empty, how deep, which colour."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.contract.scene import Camera
from crossgrad_core.testing.fixtures import posed_scene, posed_view
from crossgrad_plugins.initializers.cells import Cells
from crossgrad_plugins.initializers.depth import Depth, Sky, from_the_middle
from crossgrad_plugins.initializers.fill_gaps import Filled

WIDTH, HEIGHT, FOCAL = 48, 36, 40.0


@dataclass(frozen=True)
class Picture:
    """Photo of the ground z = 0: red grows with x, green with y."""

    camera: Camera
    hidden: bool = False

    def image(self):
        down, across = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        ground = on_ground(self.camera, np.column_stack([across.ravel(), down.ravel()]))
        rgb = np.column_stack([127 + 20 * ground[:, 0], 127 + 20 * ground[:, 1], 0 * ground[:, 0]])
        return torch.from_numpy(rgb.clip(0, 255).round().astype(np.uint8).reshape(HEIGHT, WIDTH, 3))

    def mask(self):
        return torch.zeros(HEIGHT, WIDTH, dtype=torch.bool) if self.hidden else None


@dataclass(frozen=True)
class Watched(Picture):
    """A photo that tells when it is looked at."""

    told: Callable[[], None] = list

    def image(self):
        self.told()
        return super().image()


def on_ground(camera, pixels):
    """[N, 3] where rays through pixels [N, 2] meet z = 0."""
    pose = camera.world_to_camera.numpy()
    rays = np.column_stack([(pixels - [camera.cx, camera.cy]) / FOCAL, np.ones(len(pixels))])
    rays = rays @ pose[:3, :3]
    center = camera.center.numpy()
    return center - rays * (center[2] / rays[:, 2])[:, None]


def looking_down(x, y, height=4.0, seen=(), tilt=0.3):
    view = posed_view([x, y, height], f"{x}_{y}.png", forward=[0.0, tilt, -1.0], seen=seen)
    camera = replace(
        view.camera, width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL, cx=WIDTH / 2, cy=HEIGHT / 2
    )
    return replace(view, camera=camera, photo=Picture(camera))


def ground_scene(points, centers=((0.0, 0.0), (1.0, 0.5)), **changes):
    views = [replace(looking_down(*each, seen=range(len(points))), **changes) for each in centers]
    return posed_scene(views, points)


def some_ground(count, x, y, seed=0):
    """[count, 3] points of the ground with x and y in these ranges."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(*x, count), rng.uniform(*y, count), np.zeros(count)])


LEFT = some_ground(400, (-2.5, 0.0), (-1.0, 4.0))


def depth_of(camera, points, fewest=8, centers=((0.0, 0.0, 4.0),)):
    sky = Sky(np.array([0.0, 0.0, 1.0]), np.array(centers), points, 0.98)
    return Depth.of(camera, points, fewest, sky)


def test_the_depth_of_a_plane_is_exact_far_from_its_points_and_despite_outliers():
    camera = looking_down(0.0, 0.0).camera
    points = LEFT[camera.project(LEFT)[1] > 0]
    wrong = points.copy()
    wrong[::10] += [0.0, 0.0, 1.5]
    pixels = np.array([[2.0, 3.0], [24.0, 18.0], [47.0, 35.0], [70.0, 40.0]])
    true = camera.local(on_ground(camera, pixels))[:, 2]
    around = from_the_middle(camera, pixels)
    np.testing.assert_allclose(depth_of(camera, points).at(around), true, rtol=1e-9)
    np.testing.assert_allclose(depth_of(camera, wrong).at(around), true, rtol=0.12)


def test_ground_depth_is_at_most_twice_the_point_depth_and_sky_is_behind_all_points():
    camera = looking_down(0.0, 0.0, tilt=3.0).camera
    ahead = some_ground(300, (-3.0, 3.0), (4.0, 20.0))
    depths = camera.project(ahead)[1]
    horizon = HEIGHT / 2 - FOCAL / 3.0  # It is in the picture, for the camera looks down by 1 : 3.
    across = np.linspace(0, WIDTH, 50)
    above, below = (
        from_the_middle(camera, np.column_stack([across, np.full(50, horizon + way)]))
        for way in (-0.5, 0.5)
    )
    found = depth_of(camera, ahead, centers=((0.0, 0.0, 4.0), (0.0, 0.0, 34.0)))
    assert found.at(above) == pytest.approx(2.0 * 30.0)
    assert found.at(below).min() >= np.quantile(depths, 0.02) * 0.99
    assert found.at(below).max() <= 2.0 * np.quantile(depths, 0.98) * 1.01
    # Points are farther away than any camera, but for the last 2 %.
    ways = np.linalg.norm(ahead - camera.center.numpy(), axis=1)
    near = depth_of(camera, ahead)
    assert near.at(above) == pytest.approx(2.0 * np.quantile(ways, 0.98), rel=1e-9)
    assert depth_of(camera, ahead[:7]) is None


@pytest.mark.parametrize("shifted", [0.0, 9.0])
def test_pixels_beyond_a_wall_are_sky_only_for_rays_that_go_up(shifted):
    # Along a wall on its left, whose plane vanishes in the middle of the picture.
    rng = np.random.default_rng(2)
    wall = np.column_stack([np.full(300, -1.0), rng.uniform(2, 9, 300), rng.uniform(-1, 3, 300)])
    camera = posed_view([0.0, 0.0, 1.0], "w.png", forward=[0.0, 1.0, 0.0]).camera
    size = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2}
    camera = replace(camera, **size, cy=HEIGHT / 2 + shifted)
    found = depth_of(camera, wall, centers=((0.0, 0.0, 1.0), (0.0, 50.0, 1.0)))
    right = np.full(9, 0.9 * WIDTH)
    up = from_the_middle(camera, np.column_stack([right, camera.cy - np.linspace(1, 9, 9)]))
    down = from_the_middle(camera, np.column_stack([right, camera.cy + np.linspace(1, 9, 9)]))
    assert found.at(up) == pytest.approx(100.0) and found.at(down).max() < 20.0


def covered_by_hand(cells, points, sizes):
    """Cell by cell and disc by disc."""
    camera = cells.camera
    pixels, depth = camera.project(points)
    found = []
    for across, down in cells.places:
        low = np.array([across, down]) * cells.size
        area, under = 0.0, False
        for point, size, far in zip(pixels, sizes, depth, strict=True):
            if far <= 0.0:
                continue
            radius = min(2.0 * size * camera.fx / far, max(camera.width, camera.height) / 8)
            if radius > cells.size / 2:
                half = radius * np.sqrt(np.pi) / 2
                under |= bool((np.abs(low + cells.size / 2 - point) <= half).all())
            elif ((np.floor(point / cells.size)) == [across, down]).all():
                area += np.pi * radius**2
        found.append(under or area >= 0.5 * cells.size**2)
    return np.array(found)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(1, 40),
    size=st.floats(2.0, 30.0),
    margin=st.integers(0, 3),
    scale=st.floats(-3.0, 0.5),
)
def test_covered_cells_agree_with_a_loop(seed, count, size, margin, scale):
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 3.0, (count, 3))
    sizes = 10.0**scale * rng.uniform(0.1, 1.0, count)
    cells = Cells(looking_down(0.0, 0.0).camera, size, margin)
    np.testing.assert_array_equal(
        cells.covered(points, sizes), covered_by_hand(cells, points, sizes)
    )


@pytest.mark.parametrize("size", [4.0, 5.0, 7.3, 48.0])
def test_cell_colors_are_means_of_unmasked_pixels(size):
    view = looking_down(0.0, 0.0)
    image = view.photo.image().numpy()
    mask = np.random.default_rng(0).random((HEIGHT, WIDTH)) < 0.3
    photo = view.photo
    masked = type("Masked", (), {"image": photo.image, "mask": lambda _: torch.from_numpy(mask)})()
    cells = Cells(view.camera, size, 1)
    colors, has_pixels = cells.colors(replace(view, photo=masked))
    assert has_pixels.any()
    for place, color, known in zip(cells.places, colors, has_pixels, strict=True):
        rows, columns = cells.inner
        x, y = np.clip(place, 0, [columns - 1, rows - 1])
        part = np.s_[int(y * size) : int((y + 1) * size), int(x * size) : int((x + 1) * size)]
        kept = image[part][mask[part]]
        assert known == bool(len(kept))
        if known:
            np.testing.assert_array_equal(color, kept.mean(axis=0).round())


def test_ground_without_points_is_filled_with_the_colours_of_the_ground():
    more = Filled(margin=0.0).more_points(ground_scene(LEFT))
    assert len(more.positions) > 10
    np.testing.assert_allclose(more.positions[:, 2], 0.0, atol=1e-6)
    assert (more.positions[:, 0] > -0.3).all(), "the left is covered"
    seen = 127 + 20 * more.positions[:, :2]
    np.testing.assert_allclose(more.colors[:, :2], seen, atol=6)
    # Each covers about its cell: an eighth of the photo's longer side, at its depth.
    assert ((more.sizes > 0.2) & (more.sizes < 0.8)).all()


def test_added_sky_gaussians_are_not_in_front_of_a_camera():
    # One camera on the ground looks along it; the others look down from above and beyond.
    ahead = some_ground(400, (-1.0, 1.0), (2.0, 6.0))
    down = ground_scene(ahead, [(0.0, 3.0), (40.0, 3.0)])
    level = posed_view([0.0, 0.0, 0.5], "l.png", forward=[0.0, 1.0, 0.0], seen=range(400))
    camera = replace(down.train_views[0].camera, world_to_camera=level.camera.world_to_camera)
    level = replace(level, camera=camera, photo=Picture(camera))
    scene = posed_scene([*down.train_views, level], ahead)
    more = Filled(margin=0.0).more_points(scene)
    sky = more.positions[more.positions[:, 2] > 1.0]
    assert len(sky) > 10
    ways = np.linalg.norm(sky[:, None] - scene.centers[None], axis=2)
    # The farthest camera is 40 away, and the sky twice as far.
    assert ways.min() > 40.0 and camera.project(sky)[1] == pytest.approx(2.0 * 40.25, rel=0.01)
    assert Filled().more_points(replace(scene, train=())) is None


@pytest.mark.parametrize("margin", [0.0, 0.5])
def test_no_gaussian_is_added_nearer_to_a_camera_than_its_visible_points(margin):
    # Beside the top of a tower, at its depth, nothing is but air: another camera looks down there.
    ground = some_ground(400, (-6.0, 6.0), (3.0, 20.0))
    tower = np.column_stack([np.zeros(60), np.full(60, 10.0), np.linspace(0.0, 7.0, 60)])
    points = np.concatenate([ground, tower])
    level = posed_view([0.0, 0.0, 1.0], "l.png", forward=[0.0, 1.0, 0.3], seen=range(460))
    above = replace(looking_down(3.0, 8.0, 9.0, seen=range(400)), name="above.png")
    camera = replace(above.camera, world_to_camera=level.camera.world_to_camera)
    scene = posed_scene([above, replace(level, camera=camera, photo=Picture(camera))], points)
    more = Filled(margin=margin).more_points(scene)
    reach = np.quantile(above.camera.local(ground)[:, 2], 0.02)
    ways = np.linalg.norm(more.positions - above.camera.center.numpy(), axis=1)
    assert ways.min() > 0.99 * reach > 6.0
    pixels, depth = camera.project(more.positions)
    shown = ((pixels >= 0) & (pixels <= [WIDTH, HEIGHT])).all(axis=1)
    assert (depth[shown] > 30.0).sum() > 20  # The sky.


def test_rays_that_go_down_end_on_the_ground_even_near_a_camera():
    # Along a street, 1.6 high, 3 apart; each sees the ground from 5 on.
    ground = some_ground(3000, (-8.0, 8.0), (5.0, 60.0))
    views = []
    for number in range(10):
        center = np.array([0.0, 3.0 * number, 1.6])
        ahead = np.flatnonzero(ground[:, 1] > center[1] + 5.0)
        view = posed_view(center, f"{number}.png", forward=[0.0, 1.0, 0.0], seen=ahead)
        camera = replace(looking_down(0.0, 0.0).camera, world_to_camera=view.camera.world_to_camera)
        views.append(replace(view, camera=camera, photo=Picture(camera)))
    # Most of the road has no points of its own.
    kept = np.flatnonzero(np.abs(ground[:, 0]) > 4.0)
    order = np.full(len(ground), -1)
    order[kept] = np.arange(len(kept))
    views = [replace(v, seen=order[v.seen][order[v.seen] >= 0]) for v in views]
    more = Filled(margin=0.0).more_points(posed_scene(views, ground[kept]))
    low = more.positions[more.positions[:, 2] < 5.0]
    assert len(low) > 10 and low[:, 2].min() > -1.0
    assert (more.positions[:, 2] >= 5.0).any()


def test_cameras_around_an_object_have_margins_although_they_see_each_other():
    rng, views = np.random.default_rng(3), []
    walls = rng.uniform(0.0, 2.0 * np.pi, 2000)
    room = np.column_stack([4.5 * np.cos(walls), 4.5 * np.sin(walls), rng.uniform(0, 2.5, 2000)])
    for number in range(8):
        angle = number * np.pi / 4.0
        center = np.array([3.0 * np.cos(angle), 3.0 * np.sin(angle), 1.5])
        view = posed_view(center, f"{number}.png", forward=-center * [1, 1, 0], seen=range(2000))
        camera = replace(looking_down(0.0, 0.0).camera, world_to_camera=view.camera.world_to_camera)
        views.append(replace(view, camera=camera, photo=Picture(camera)))
    scene = posed_scene(views, room)
    inner = Filled(margin=0.0).more_points(scene)
    more = Filled(margin=0.5).more_points(scene)
    assert len(more.positions) > (0 if inner is None else len(inner.positions)) + 20


def test_a_camera_on_the_ground_of_another_photo_has_no_margin():
    high = ground_scene(LEFT)
    pixels = high.train_views[0].camera.project(LEFT)[0]
    middle = LEFT[np.argmin(np.abs(pixels - [WIDTH / 2, HEIGHT / 2]).sum(axis=1))]
    margins = []
    for above in (0.2, 9.0):
        center = middle + np.array([0.0, 0.0, above])
        low = posed_view(center, "low.png", forward=[0.0, 1.0, -0.5], seen=range(len(LEFT)))
        camera = replace(high.train_views[0].camera, world_to_camera=low.camera.world_to_camera)
        low = replace(low, camera=camera, photo=Picture(camera))
        scene = posed_scene([*high.train_views, low], LEFT)
        inner = Filled(margin=0.0).more_points(scene)
        more = Filled(margin=0.5).more_points(scene)
        alone = Filled(margin=0.5).more_points(high)
        beyond = more.positions[len(inner.positions) :]
        apart = np.abs(beyond[:, None] - alone.positions[None]).max(axis=2).min(axis=1)
        margins.append(int((apart > 1e-9).sum()))
    # High above it adds its own; from the ground only what the high ones would.
    assert margins[0] == 0 < margins[1]


def test_a_scene_without_gaps_is_not_filled():
    full = some_ground(4000, (-6.0, 6.0), (-5.0, 9.0))
    scene = ground_scene(full)
    assert Filled(margin=0.0).more_points(scene) is None
    assert Filled(margin=0.0).begun(scene) is scene


def test_the_margin_contains_only_regions_outside_all_training_photos():
    scene = ground_scene(LEFT)
    inner = Filled(margin=0.0).more_points(scene)
    more = Filled(margin=0.5).more_points(scene)
    beyond = more.positions[len(inner.positions) :]
    assert len(beyond) > 10
    # What would be nearer, or much farther, than any point is brought to where these are.
    assert (np.abs(beyond[:, 2]) < 1e-6).mean() > 0.5
    assert np.abs(beyond[:, 2]).max() < 1.0
    for view in scene.train_views:
        pixels, depth = view.camera.project(beyond)
        shown = ((pixels >= 0) & (pixels <= [WIDTH, HEIGHT])).all(axis=1) & (depth > 0)
        assert not shown.any()
    told = Filled(margin=0.5).messages(scene)
    assert told == (
        f"start: {len(inner.positions)} Gaussians added inside photos where there are no points, "
        f"{len(beyond)} beyond the edges of photos",
    )


@pytest.mark.parametrize(("away", "hides"), [(0.5, True), (20.0, False)])
def test_the_margin_continues_behind_nearer_points_of_another_photo(away, hides):
    # A camera in the street looks over all the ground beyond the left edges, at a wall or far away.
    rng, street = np.random.default_rng(1), np.array([-6.0, 1.5, 0.3])
    wall = street + np.column_stack(
        [np.full(200, away), *(away * rng.uniform(-0.5, 0.5, (2, 200)))]
    )
    alone = ground_scene(LEFT)
    low = posed_view(street, "low.png", forward=[1.0, 0.0, 0.0], seen=len(LEFT) + np.arange(200))
    camera = replace(alone.train_views[0].camera, world_to_camera=low.camera.world_to_camera)
    low = replace(low, camera=camera, photo=Picture(camera))
    both = posed_scene([*alone.train_views, low], np.concatenate([LEFT, wall]))
    inner = len(Filled(margin=0.0).more_points(alone).positions)
    beyond = Filled(margin=0.5).more_points(alone).positions[inner:]
    pixels, depth = camera.project(beyond)
    over = ((pixels >= 0) & (pixels <= [WIDTH, HEIGHT])).all(axis=1) & (depth > 0)
    assert over.sum() > 5
    filled = Filled(margin=0.5).more_points(both).positions
    apart = np.abs(beyond[over][:, None] - filled[None]).max(axis=2).min(axis=1)
    assert (apart < 1e-9).all() if hides else (apart > 1e-9).all()


def test_photos_without_enough_points_or_pixels_are_left_out():
    scene = ground_scene(LEFT, seen=np.arange(7))
    assert Filled().more_points(scene) is None
    assert "2 photos with fewer than 8 points were skipped" in Filled().messages(scene)[0]
    hidden = ground_scene(LEFT)
    views = tuple(
        replace(view, photo=Picture(view.camera, hidden=True)) for view in hidden.train_views
    )
    assert Filled().more_points(replace(hidden, views=views)) is None


def test_no_more_photos_are_read_than_requested():
    centers = [(0.3 * number, 0.0) for number in range(20)]
    scene, looked_at = ground_scene(LEFT, centers), []
    views = [
        replace(view, photo=Watched(view.camera, told=partial(looked_at.append, view.name)))
        for view in scene.train_views
    ]
    assert Filled(views=3).more_points(replace(scene, views=tuple(views))) is not None
    assert len(set(looked_at)) == 3


def test_added_gaussians_get_size_and_opacity_and_existing_ones_do_not_change():
    scene = ground_scene(LEFT)
    begun = Filled(opacity=0.7).begun(scene)
    rng = np.random.default_rng(0)
    plain, filled = (Vanilla().create(each, rng) for each in (scene, begun))
    own = len(LEFT)
    for name, tensor in plain.items():
        torch.testing.assert_close(filled[name][:own], tensor, rtol=0, atol=0)
    more = Filled(opacity=0.7).more_points(scene)
    added = {name: tensor.detach()[own:] for name, tensor in filled.items()}
    np.testing.assert_allclose(added["scales"].exp()[:, 0], more.sizes, rtol=1e-6)
    np.testing.assert_allclose(added["opacities"].sigmoid(), 0.7, rtol=1e-6)
    np.testing.assert_allclose(added["means"], more.positions, rtol=1e-6, atol=1e-7)
