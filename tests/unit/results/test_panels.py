"""Panels: file names, which views get one, and what the pixels show."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.figures import of

from crossgrad_core.contract.slots.metric import Compared
from crossgrad_core.errors import UserError
from crossgrad_core.evaluation.evaluation import Evaluated
from crossgrad_core.run.results.panels import (
    PanelWriter,
    chosen_views,
    draw_panel,
    enlargement,
    error_map,
    flat_names,
    folder_of,
    panels_of,
    read_panel,
)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["aerial/0001.jpg", "street/0001.jpg"], ["aerial__0001", "street__0001"]),
        (["a/b.jpg", "a/b.png", "a__b.jpg", "A/B.jpg"], ["a__b", "a__b-2", "a__b-3", "A__B-4"]),
        (["../../etc/x y.jpg", "/abs.jpg"], ["etc__x_y", "abs"]),
        (["...", "Łódź/żółw.jpg"], ["view", "Łódź__żółw"]),
        (["x" * 300 + ".jpg"], ["x" * 120]),
    ],
)
def test_panel_file_names_are_unique_and_safe(names: list[str], expected: list[str]):
    assert list(flat_names(names).values()) == expected


def test_chosen_views_are_spread_over_regimes_and_within_them(make_view):
    views = [make_view(f"far/{i:02}", "far") for i in range(10)]
    views += [make_view(f"near/{i:02}", "near") for i in range(2)]
    assert [view.name for view in chosen_views(views, 4)] == [
        "far/02",
        "far/07",
        "near/00",
        "near/01",
    ]
    assert [view.name for view in chosen_views(views, 1)] == ["far/05"]
    assert len(chosen_views(views, 100)) == 12
    # What a small regime has no views for goes to the others.
    assert len(chosen_views(views[:-4], 7)) == 7 and len(chosen_views(views[5:], 7)) == 7
    assert chosen_views(views, 0) == ()
    assert chosen_views([], 4) == ()


def make_evaluated(view, render: torch.Tensor, mask: torch.Tensor | None = None) -> Evaluated:
    metrics = of(view.name, view.regime, 24.3, 0.812, None, None)
    return Evaluated(Compared(view, render, view.photo.image(), mask), metrics)


def find_image(canvas: np.ndarray, image: np.ndarray) -> bool:
    """Whether the canvas contains the image somewhere, pixel for pixel."""
    height, width = image.shape[:2]
    corner = (canvas[: 1 - height or None, : 1 - width or None] == image[0, 0]).all(axis=2)
    return any(
        np.array_equal(canvas[y : y + height, x : x + width], image)
        for y, x in zip(*np.nonzero(corner), strict=True)
    )


@pytest.mark.parametrize(("width", "height", "factor"), [(400, 60, 1), (24, 16, 15), (1, 1, 360)])
def test_a_panel_shows_photo_render_and_error_pixel_for_pixel(
    make_view, width: int, height: int, factor: int
):
    view = make_view("a.jpg", "all", width, height)
    render = torch.randint(0, 256, (height, width, 3), dtype=torch.uint8)
    canvas = np.asarray(draw_panel(make_evaluated(view, render), step=700))
    photo = view.photo.image().numpy()
    for image in (photo, render.numpy(), error_map(photo, render.numpy())):
        assert find_image(canvas, image.repeat(factor, axis=0).repeat(factor, axis=1))


def test_error_colours_are_fixed_and_get_brighter_with_the_error():
    photo = np.zeros((1, 4, 3), dtype=np.uint8)
    render = np.array([0, 20, 64, 255], dtype=np.uint8)[None, :, None].repeat(3, axis=2)
    colors = error_map(photo, render).astype(int)
    brightness = colors.sum(axis=2)[0]
    assert (np.diff(brightness[:3]) > 0).all()
    assert (colors[0, 2] == colors[0, 3]).all()
    assert (error_map(render, photo) == colors).all()


def test_masked_pixels_are_hatched_in_the_error_only(make_view):
    view = make_view("a.jpg", "all", 400, 60)
    render = torch.zeros(60, 400, 3, dtype=torch.uint8)
    mask = torch.ones(60, 400, dtype=torch.bool)
    mask[:, 100:] = False
    canvas = np.asarray(draw_panel(make_evaluated(view, render, mask), step=1))
    photo = view.photo.image().numpy()
    assert find_image(canvas, photo)
    error = error_map(photo, render.numpy())
    assert find_image(canvas, error[:, :100])
    assert not find_image(canvas, error[:, :101])


def test_only_the_chosen_views_get_a_panel(tmp_path: Path, make_view):
    views = [make_view(name, name[0]) for name in ("a/1.jpg", "a/2.jpg", "b/1.jpg")]
    writer = PanelWriter.of(tmp_path, 700, views, count=2)
    for view in views:
        writer.write(make_evaluated(view, torch.zeros(16, 24, 3, dtype=torch.uint8)))
    written = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.png"))
    assert written == ["renders/000700/a__2.png", "renders/000700/b__1.png"]
    with Image.open(tmp_path / written[0]) as image:
        assert image.mode == "RGB"


@pytest.mark.parametrize("link", [False, True])
def test_a_file_with_the_name_of_the_panel_folder_is_refused(tmp_path: Path, make_view, link):
    place = tmp_path / "renders"
    place.symlink_to(tmp_path / "nowhere") if link else place.touch()
    view = make_view("a/1.jpg", "a")
    with pytest.raises(UserError, match="already has this name"):
        PanelWriter.of(tmp_path, 7, [view], count=1).write(
            make_evaluated(view, torch.zeros(16, 24, 3, dtype=torch.uint8))
        )


@pytest.mark.parametrize(("width", "height"), [(400, 60), (24, 16), (989, 3), (1300, 700), (1, 1)])
def test_photo_render_and_error_can_be_read_from_a_panel(
    make_view, tmp_path: Path, width: int, height: int
):
    view = make_view("a/b.jpg", "all", width, height)
    render = torch.randint(0, 256, (height, width, 3), dtype=torch.uint8)
    names = ["a/b.jpg", "a__b.jpg"]
    PanelWriter(folder_of(tmp_path, 7), flat_names(names), 7).write(make_evaluated(view, render))
    paths = panels_of(tmp_path, 7, names)
    assert list(paths) == ["a/b.jpg"]
    factor = enlargement(width)
    photo = view.photo.image().numpy()
    wanted = {"photo": photo, "render": render.numpy(), "error": error_map(photo, render.numpy())}
    for name, image in read_panel(paths["a/b.jpg"]).items():
        enlarged = wanted[name].repeat(factor, axis=0).repeat(factor, axis=1)
        assert np.array_equal(np.asarray(image), enlarged), name


@pytest.mark.parametrize("content", [b"no picture", None], ids=["no picture", "another size"])
def test_another_image_file_is_not_a_panel(tmp_path: Path, content: bytes | None):
    path = tmp_path / "a.png"
    Image.new("RGB", (200, 10)).save(path)
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match="a panel image cannot be read"):
        read_panel(path)
