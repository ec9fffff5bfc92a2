"""The recipe of docs/photos.md makes a scene of photos; errors name the command that does it."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pycolmap
import pytest

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.run import app
from crossgrad_plugins.readers.colmap import ColmapReader

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "photos.md").read_text(encoding="utf-8")
PHOTOS = sorted((ROOT / "examples" / "scenes" / "boruszyn" / "images").iterdir())[:6]
(RECIPE,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def photos_alone(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for photo in PHOTOS:
        shutil.copy(photo, folder)
    return folder


@pytest.mark.slow
def test_the_photos_recipe_makes_a_scene_that_can_be_trained(tmp_path):
    photos_alone(tmp_path / "scene" / "images")
    (tmp_path / "poses.py").write_text(RECIPE, encoding="utf-8")
    command = [sys.executable, "poses.py", "scene"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert re.search(r"sparse/0: \d+ photos with a pose, \d+ points", done.stdout)
    scene = ColmapReader().read(tmp_path / "scene", SceneOptions())
    assert len(scene.views) >= len(PHOTOS) - 1
    assert len(scene.points) > 100
    assert app.run({"scene": str(tmp_path / "scene"), "steps": 2}, dry_run=True) == 0


@pytest.mark.parametrize("photos", ["images", "."], ids=["in images", "in the folder itself"])
def test_the_error_for_photos_without_a_model_names_the_command(tmp_path, photos):
    photos_alone(tmp_path / "scene" / photos)
    with pytest.raises(UserError, match="no COLMAP model") as refused:
        ColmapReader().read(tmp_path / "scene", SceneOptions())
    assert "docs/prepare.md" in refused.value.todo
    assert "crossgrad prepare PHOTOS SCENE" in refused.value.todo


def test_every_pycolmap_name_on_the_page_exists():
    for name in re.findall(r"pycolmap\.(\w+)", PAGE):
        assert hasattr(pycolmap, name)
    assert pycolmap.FeatureExtractionOptions(num_threads=2).num_threads == 2


def test_the_readme_links_to_the_recipe():
    assert "docs/photos.md" in (ROOT / "README.md").read_text(encoding="utf-8")
