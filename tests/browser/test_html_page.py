"""The HTML page in Chromium: its pictures, its network, its controls. Skipped without Chromium."""

import io
import os
from base64 import b64decode
from dataclasses import replace
from itertools import permutations
from time import monotonic

import numpy as np
import pytest
import torch
from PIL import Image
from support.chromium import Page, found
from support.gaussians import posed_camera, random_gaussians

import crossgrad_core as cg
from crossgrad_core.plugin import ExportContent, Similarity, View, to_uint8
from crossgrad_plugins.exporters.html import Html
from crossgrad_plugins.rasterizers.numba_cpu import NumbaRasterizer

pytestmark = pytest.mark.browser

FRAME = Similarity(np.array([100.0, 200.0, 300.0]), 2.0)
UP = np.array([0.0, -1.0, 0.0])
#: Sizes, focal lengths and principal points differ; the poses are turned.
CAMERAS = (
    posed_camera(240, 180, focal=200.0, principal=(0.45, 0.6)),
    posed_camera(150, 220, focal=260.0, principal=(0.55, 0.4)),
    posed_camera(201, 133, focal=150.0, principal=(0.5, 0.5)),
)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    program = found()
    if program is None:
        if os.environ.get("CROSSGRAD_BROWSER") == "required":
            pytest.fail("Chromium is not installed (Debian package: chromium)")
        pytest.skip("Chromium is not installed")
    with Page(program, tmp_path_factory.mktemp("profile"), size=(400, 300)) as opened:
        yield opened


def turned_camera(camera, angle):
    """The camera, turned to the side around a point in front of it."""
    c, s = np.cos(angle), np.sin(angle)
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    away = torch.eye(4, dtype=torch.float64)
    away[2, 3] = 2.0
    pose = away @ turn @ away.inverse() @ camera.world_to_camera
    return replace(camera, world_to_camera=pose)


def views_of(cameras=CAMERAS):
    cameras = [turned_camera(camera, 0.2 * i) for i, camera in enumerate(cameras)]
    return tuple(
        View(f"photo {i}.jpg", camera, None, "near", np.zeros(0, np.int64))
        for i, camera in enumerate(cameras)
    )


def opened(page, folder, gaussians, views):
    path = folder / "page.html"
    Html().write(ExportContent(gaussians, FRAME, views, UP, name="a scene"), path)
    page.open(path.as_uri())
    page.value("ready")
    return path


def picture(page, number):
    url = page.value(f"picture({number})")
    image = Image.open(io.BytesIO(b64decode(url.partition(",")[2])))
    return np.asarray(image.convert("RGB")).astype(float)


def rendered(gaussians, camera):
    image = NumbaRasterizer().render(gaussians, camera, torch.zeros(3)).image
    return to_uint8(image).numpy().astype(float)


def decibels(image, other):
    return 10 * np.log10(255**2 / max(((image - other) ** 2).mean(), 1e-9))


def wrong(image):
    """Every flipped and every channel-swapped version of an image."""
    swapped = [image[:, :, list(order)] for order in permutations(range(3)) if order != (0, 1, 2)]
    return [image[::-1], image[:, ::-1], image[::-1, ::-1], *swapped]


def assert_drawn_as_ours(page, gaussians, views):
    """The page agrees with the stored Gaussians up to 8 bits, and with those before rounding."""
    stored = Html().stored(gaussians, FRAME)
    for number, view in enumerate(views):
        seen, ours = picture(page, number), rendered(gaussians, view.camera)
        assert ours.std() > 10.0
        assert seen.shape == ours.shape
        assert decibels(seen, rendered(stored, view.camera)) >= 60.0
        agreement = decibels(seen, ours)
        assert agreement >= 50.0
        assert agreement > 10.0 + max(decibels(image, ours) for image in wrong(seen))


@pytest.mark.parametrize(
    ("degree", "response"), [(0, "plain"), (1, "antialiased"), (2, "plain"), (3, "antialiased")]
)
def test_the_page_draws_training_cameras_as_crossgrad_does(page, tmp_path, degree, response):
    gaussians = random_gaussians(600, CAMERAS[0], seed=degree, sh_degree=degree, response=response)
    gaussians, views = gaussians.detached().mapped(torch.Tensor.float), views_of()
    path = opened(page, tmp_path, gaussians, views)
    assert_drawn_as_ours(page, gaussians, views)
    addresses = [url for url in page.requests if not url.startswith("blob:null/")]
    assert addresses == [path.as_uri()]
    assert page.problems == []


def test_needles_disks_and_large_gaussians_are_drawn_as_crossgrad_does(page, tmp_path):
    gaussians = random_gaussians(300, CAMERAS[0], seed=7, sh_degree=1, border=0.6)
    factors = torch.tensor([[60.0, 0.02, 0.02], [15.0, 15.0, 1e-3], [40.0, 40.0, 40.0]])
    gaussians = replace(
        gaussians.detached().mapped(torch.Tensor.float),
        scales=gaussians.scales.detach().float() * factors.repeat(100, 1),
        opacities=gaussians.opacities.detach().float().clamp(max=0.5),
    )
    views = views_of()
    opened(page, tmp_path, gaussians, views)
    assert_drawn_as_ours(page, gaussians, views)


@pytest.fixture
def small(page, tmp_path):
    """The page of a small scene, and its views."""
    gaussians = random_gaussians(50, CAMERAS[0], seed=1).detached().mapped(torch.Tensor.float)
    gaussians = replace(gaussians, colors=None, sh_dc=gaussians.colors[:, None])
    views = views_of()
    opened(page, tmp_path, gaussians, views)
    return views


def eye(page):
    return np.array(page.value("pose.eye"))


def rows(page):
    return np.array(page.value("pose.rows"))


def dragged(page, dx, dy, button="left"):
    """Drag on the canvas; return where the point of interest was and is, seen from the camera."""
    for kind, x, y in (("Pressed", 200, 100), ("Moved", 200 + dx, 100 + dy)):
        buttons = {"left": 1, "right": 2}[button]
        page.call("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, button=button,
                  buttons=buttons, clickCount=1)  # fmt: skip
    page.call("Input.dispatchMouseEvent", type="mouseReleased", x=200 + dx, y=100 + dy,
              button=button, clickCount=1)  # fmt: skip


def test_a_drag_orbits_and_what_is_in_front_follows_the_pointer(page, small):
    pivot = page.value("plus(pose.eye, pose.rows[2], pivot)")
    near = page.value("plus(pose.eye, pose.rows[2], 0.5 * pivot)")
    distance = page.value("pivot")
    dragged(page, 40, 0)
    assert np.allclose(page.value("plus(pose.eye, pose.rows[2], pivot)"), pivot)
    assert np.linalg.norm(eye(page) - pivot) == pytest.approx(distance)
    right, down, _ = rows(page)
    assert (np.array(near) - eye(page)) @ right > 0.01 * distance
    dragged(page, 0, 40)
    right, down, _ = rows(page)
    assert (np.array(near) - eye(page)) @ down > 0.01 * distance
    assert np.allclose(rows(page) @ rows(page).T, np.eye(3))


def test_a_drag_never_turns_the_camera_upside_down(page, small):
    for dy in (150, 150, 150, 150, -150, -150, -150, -150, -150, -150, -150, -150):
        dragged(page, 0, dy)
        assert -rows(page)[1] @ UP > -0.2


def test_the_right_button_moves_the_camera_sideways(page, small):
    before, axes = eye(page), rows(page)
    dragged(page, 40, 0, button="right")
    assert np.allclose(rows(page), axes)
    assert (eye(page) - before) @ axes[0] < -0.01


def test_in_fly_mode_a_drag_turns_the_camera_where_it_is(page, small):
    before, forward = eye(page), rows(page)[2]
    right = rows(page)[0]
    page.value("$('mode').click()")
    assert page.value("$('mode').textContent") == "Fly"
    dragged(page, 40, 0)
    assert np.allclose(eye(page), before)
    assert rows(page)[2] @ right > 0.1 > forward @ right


@pytest.mark.parametrize(
    ("key", "axis", "sign"), [("KeyW", 2, 1), ("ArrowLeft", 0, -1), ("KeyE", 1, -1)]
)
def test_a_key_flies_until_it_is_released(page, small, key, axis, sign):
    before, axes = eye(page), rows(page)
    page.call("Input.dispatchKeyEvent", type="keyDown", code=key)
    deadline = monotonic() + 20
    while np.array_equal(eye(page), before):
        assert monotonic() < deadline, "the key has no effect"
    page.call("Input.dispatchKeyEvent", type="keyUp", code=key)
    released = eye(page)
    moved = axes @ (released - before)
    assert sign * moved[axis] > 0.0
    assert np.allclose(np.delete(moved, axis), 0.0, atol=1e-9)
    page.value(
        "new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve)))"
    )
    assert np.array_equal(eye(page), released)


def test_two_fingers_zoom_and_one_finger_orbits(page, small):
    def touch(kind, *points):
        fingers = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        page.call("Input.dispatchTouchEvent", type=f"touch{kind}", touchPoints=fingers)

    distance, axes = page.value("pivot"), rows(page)
    touch("Start", (150, 100), (250, 100))
    touch("Move", (110, 100), (290, 100))
    touch("End")
    assert page.value("pivot") == pytest.approx(distance * 100 / 180, rel=0.05)
    assert np.allclose(rows(page), axes)
    touch("Start", (200, 100))
    touch("Move", (240, 110))
    touch("End")
    assert not np.allclose(rows(page), axes)


def test_a_camera_of_the_list_sets_pose_and_calibration(page, small):
    dragged(page, 40, 20)
    page.value("$('next').click()")
    camera = small[1].camera
    assert np.allclose(rows(page), camera.world_to_camera[:3, :3])
    assert np.allclose(eye(page), camera.center)
    names = ("width", "height", "fx", "fy", "cx", "cy")
    lens = page.value("lens")
    assert [lens[name] for name in names] == [getattr(camera, name) for name in names]
    assert page.value("$('cameras').selectedOptions[0].text") == "2/3 photo 1.jpg (near)"
    assert page.value("$('cameras').length") == len(small)


def test_the_address_chooses_the_first_camera(page, tmp_path):
    gaussians, views = random_gaussians(5, CAMERAS[0]).detached(), views_of()
    path = tmp_path / "page.html"
    Html().write(ExportContent(gaussians, FRAME, views, UP), path)
    page.open(f"{path.as_uri()}#camera=3")
    page.value("ready")
    assert np.allclose(eye(page), views[2].camera.center)


def test_the_page_shows_the_camera_in_the_coordinates_of_the_file(page, small):
    page.value("new Promise((resolve) => setTimeout(resolve, 100))")
    shown = page.value("$('place').textContent").removeprefix("camera at ").split(", ")
    expected = FRAME.to_input(small[0].camera.center.numpy()[None])[0]
    assert np.allclose([float(number) for number in shown], expected, atol=0.006)


def test_hostile_names_are_shown_as_text(page, tmp_path):
    name = "</script><script>window.broken = 1</script><!--<script>&quot;'\u2028 http://example.org"
    views = tuple(replace(view, name=name, regime=name) for view in views_of())
    gaussians = random_gaussians(5, CAMERAS[0], seed=2).detached().mapped(torch.Tensor.float)
    path = tmp_path / "page.html"
    Html().write(ExportContent(gaussians, FRAME, views, UP, comments=(name,), name=name), path)
    page.open(path.as_uri())
    page.value("ready")
    assert page.value("window.broken ?? null") is None
    assert page.value("document.title") == page.value("$('title').textContent")
    assert name.replace("\u2028", "") in page.value("scene.cameras[0].name.replace('\u2028', '')")
    assert all(url.startswith(("file:", "blob:null/")) for url in page.requests)
    assert page.problems == []


def test_the_page_allows_no_network_even_to_its_own_code(page, small):
    page.value("fetch('http://127.0.0.1:9/').catch(() => 0)")
    assert any("Content Security Policy" in problem for problem in page.problems)


@pytest.mark.slow
@pytest.mark.parametrize("backbone", ["vanilla", "mip"])
def test_the_page_of_a_run_shows_its_training_cameras_as_the_run_renders_them(
    page, tmp_path, backbone
):
    run = cg.run(backbone=backbone, steps=150, max_size=320, out=tmp_path / "run", quiet=True)
    page.open((run.folder / "point_cloud.html").as_uri())
    page.value("ready")
    views = run.scene.train_views
    for number in (0, len(views) // 2, len(views) - 1):
        # Without the exposure of the photo, which no file contains.
        ours = to_uint8(torch.from_numpy(run.render(views[number].camera))).numpy().astype(float)
        seen = picture(page, number)
        assert decibels(seen, ours) > 38.0
        assert decibels(seen, ours) > 10.0 + max(decibels(image, ours) for image in wrong(seen))
    assert page.problems == []
