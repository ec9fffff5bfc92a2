"""A run knows its scene: another one is refused with the difference, and taken where it may be."""

import json
import shutil
from pathlib import Path

import pytest
from PIL import Image
from support.scenes import write_tiny_scene

from crossgrad_core.errors import UserError
from crossgrad_core.run import app
from crossgrad_core.run.postprocess import evaluate, export, render
from crossgrad_core.run.postprocess.open_options import How
from crossgrad_core.run.results.scene_file import FILE
from crossgrad_plugins.diagnostics import app as diagnostics
from crossgrad_plugins.diagnostics.app import Options

NAMES = [f"{index:04}.png" for index in range(6)]


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A stopped run and, beside it, its scene; the first two photos are held out."""
    root = tmp_path_factory.mktemp("original")
    scene = write_tiny_scene(root / "scene", views=6)
    (scene / "test_list.txt").write_text("\n".join(NAMES[:2]))
    settings = {"scene": str(scene), "out": str(root / "run"), "steps": 4, "stop_after": 2}
    assert app.run(settings, verbosity=-1) == 0
    return root


@pytest.fixture
def root(original, tmp_path):
    """A copy, at the place of its own that its config.yaml names."""
    shutil.copytree(original, tmp_path, dirs_exist_ok=True)
    config = tmp_path / "run" / "config.yaml"
    config.write_text(config.read_text().replace(str(original), str(tmp_path)))
    return tmp_path


def resume(root, **options):
    return app.run({}, resume=root / "run", verbosity=-1, **options)


def looks(root):
    """Every command that looks at a run, as a function of how it opens the run."""
    run = root / "run"
    return {
        "eval": lambda how: evaluate.evaluate(run, how),
        "render": lambda how: render.render(run, split="all", out=root / "out", how=how),
        "export": lambda how: export.export(run, file_format="ply", out=root / "a.ply", how=how),
        "diagnose": lambda how: diagnostics.diagnose(
            None, run, {}, Options(per_group=2), root / "probes", how.accept_scene
        ),
    }


def mirrored(path: Path) -> None:
    with Image.open(path) as image:
        image.transpose(Image.Transpose.FLIP_LEFT_RIGHT).save(path)


def spoilt(scene: Path, how: str) -> str:
    """Changes the scene; answers words that the refusal must have."""
    if how == "a photo":
        mirrored(scene / "images" / NAMES[3])
        return rf"photos changed: 1 \({NAMES[3]}\)"
    if how == "held out":
        (scene / "images" / NAMES[1]).unlink()
        return rf"held-out photos missing: 1 \({NAMES[1]}\)"
    if how == "trained":
        (scene / "images" / NAMES[2]).unlink()
        (scene / "images" / NAMES[3]).unlink()
        return rf"training photos missing: 2 \({NAMES[2]}, {NAMES[3]}\)"
    if how == "split":
        (scene / "test_list.txt").write_text(NAMES[2])
        return (
            r"photos that were training photos and are now held out: 1(.|\n)*test_list.txt changed"
        )
    shutil.rmtree(scene)
    write_tiny_scene(scene, views=6, scale=3.0, seed=5)
    (scene / "test_list.txt").write_text("\n".join(NAMES[:2]))
    return "another local frame: its unit is"


@pytest.mark.sampled(3)
@pytest.mark.parametrize("change", ["a photo", "held out", "trained", "split", "another scene"])
def test_a_run_opened_with_another_scene_is_refused_with_the_difference(root, change):
    words = spoilt(root / "scene", change)
    before = {path: path.read_bytes() for path in (root / "run").rglob("*.*") if path.is_file()}
    for look in (lambda _: resume(root), *looks(root).values()):
        with pytest.raises(UserError, match=words) as told:
            look(How())
        assert "restore the scene" in str(told.value)
    now = {path: path.read_bytes() for path in (root / "run").rglob("*.*") if path.is_file()}
    assert now == before


@pytest.mark.sampled(1)
@pytest.mark.parametrize("change", ["trained", "split", "another scene"])
def test_a_scene_change_that_misplaces_parameters_is_always_refused(root, change):
    words = spoilt(root / "scene", change)
    for look in (lambda how: resume(root, accept_scene=True), *looks(root).values()):
        with pytest.raises(UserError, match=rf"{words}(.|\n)*start a new run"):
            look(How(accept_scene=True))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("change", ["a photo", "held out"])
def test_read_only_commands_accept_a_changed_scene_with_accept_scene(root, change, capsys):
    spoilt(root / "scene", change)
    run = root / "run"
    before = {path: path.read_bytes() for path in run.rglob("*.*") if path.is_file()}
    for name, look in looks(root).items():
        if name != "diagnose":  # It needs more views than these.
            look(How(accept_scene=True))
    render.render(run, split="test", out=None, how=How(accept_scene=True))
    assert capsys.readouterr().out.count("overall") >= 1
    views = 1 if change == "held out" else 2
    assert len((run / "per_view_accepted.csv").read_text().splitlines()) == 1 + views
    assert len(list(run.glob("renders/*/accepted/*.png"))) == views
    # What summary.json describes is of the run's own photos.
    assert {path: path.read_bytes() for path in before} == before


def test_a_run_resumes_with_changed_photos_only_with_accept_scene(root):
    words = spoilt(root / "scene", "a photo")
    with pytest.raises(UserError, match=rf"{words}(.|\n)*--accept-scene"):
        resume(root)
    assert resume(root, accept_scene=True) == 0
    notes = json.loads((root / "run" / "summary.json").read_text())["notes"]
    assert any("accepted: photos changed: 1" in note for note in notes)
    assert "accepted: photos changed: 1" in (root / "run" / "log.txt").read_text()
    # From then on that is its scene.
    evaluate.evaluate(root / "run")


def test_a_run_with_changed_held_out_views_cannot_be_resumed(root):
    words = spoilt(root / "scene", "held out")
    with pytest.raises(
        UserError, match=rf"{words}(.|\n)*eval, render and export accept the change"
    ):
        resume(root, accept_scene=True)


def test_resuming_a_run_of_an_older_version_records_its_scene(root, caplog):
    (root / "run" / FILE).unlink()
    evaluate.evaluate(root / "run")
    assert caplog.text.count("an older version wrote the run") == 1
    assert not (root / "run" / FILE).exists()
    assert resume(root) == 0
    spoilt(root / "scene", "trained")
    with pytest.raises(UserError, match="training photos missing"):
        evaluate.evaluate(root / "run")
