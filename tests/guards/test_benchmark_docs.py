"""Figures in the documents: each has its command, the scripts are there, and cases can be made."""

import re
import runpy
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest

from crossgrad_core.commands import build, chosen, configured, layered, names
from crossgrad_core.config import RunConfig
from crossgrad_core.run.results.config_file import read_config
from crossgrad_plugins.sweep.grid import choices, read_grid, scene_name

ROOT = Path(__file__).parents[2]
BENCHMARKS = ROOT / "benchmarks"
DOCS = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in (*ROOT.glob("docs/**/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md")
}
PAGE = DOCS["docs/benchmarks.md"]
SECTIONS = dict(re.findall(r"^## (.+)\n((?:(?!^## ).*\n?)*)", PAGE, re.MULTILINE))


@pytest.fixture
def ran(monkeypatch, tmp_path):
    """Runs a script of benchmarks/ in this process."""
    monkeypatch.syspath_prepend(BENCHMARKS)

    def run(script, *arguments):
        monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
        runpy.run_path(str(BENCHMARKS / script), run_name="__main__")

    return run


@pytest.mark.sampled(23)
@pytest.mark.parametrize(
    "archive", sorted((BENCHMARKS / "results").rglob("*.tar.xz")), ids=lambda path: path.name
)
def test_the_first_run_of_every_archive_can_still_be_read(archive, tmp_path):
    with tarfile.open(archive) as file:
        configs = [item for item in file if item.name.endswith("config.yaml")]
        for config in configs[:1]:
            (tmp_path / "config.yaml").write_bytes(file.extractfile(config).read())
            RunConfig.model_validate(read_config(tmp_path))


@pytest.mark.parametrize("name", DOCS)
def test_every_script_that_a_document_names_exists(name):
    for script in re.findall(r"benchmarks/(\w+\.py)", DOCS[name]):
        assert (BENCHMARKS / script).is_file()


@pytest.mark.parametrize("title", SECTIONS)
def test_every_section_has_its_command_and_its_commit(title):
    text = SECTIONS[title]
    assert re.search(r"^    (python benchmarks/\w+\.py|crossgrad sweep )", text, re.MULTILINE)
    assert re.search(r"commit\s+\w{7}\b", text)


def test_the_table_of_backbones_is_complete_and_measured_at_one_commit():
    text = SECTIONS["Quality of backbones at equal time"]
    rows = re.findall(r"^\| \w+ \| `(\w+)` \|.* (\w{7}) \|$", text, re.MULTILINE)
    assert {name for name, _ in rows} == set(names("backbones"))
    assert len({commit for _, commit in rows}) == 1


@pytest.mark.parametrize(
    "path", sorted(BENCHMARKS.glob("grids/**/*.yaml")), ids=lambda path: path.stem
)
def test_each_grid_file_can_be_read_and_has_existing_settings(path):
    grid = read_grid(path)
    for scene in grid.scenes:
        for choice in choices(grid):
            arm = choice.arm
            own = arm.by_scene.get(scene_name(scene), {})
            layers = (grid.base, arm.settings, choice.parameters, own)
            config = configured({**layered(layers), "scene": scene})
            for slot, part in chosen(config):
                build(slot, part.name, part.options)


def test_a_generated_case_is_inside_the_view_of_its_camera(tmp_path, ran):
    case = tmp_path / "case.npz"
    ran("make_case.py", case, "--gaussians", 300)
    with np.load(case) as made:
        pose, size = made["viewmat"], np.array([made["width"], made["height"]])
        local = made["means"] @ pose[:3, :3].T + pose[:3, 3]
        pixels = local @ made["K"].T
        pixels = pixels[:, :2] / pixels[:, 2:]
        seen = (local[:, 2] > 0) & ((pixels > 0) & (pixels < size)).all(axis=1)
        assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
        assert len(made["means"]) == 300 and seen.mean() > 0.5
        assert made["v_image"].shape == (*size[::-1], 3)


def test_the_garden_case_is_cut_from_the_public_file(tmp_path, ran):
    rng = np.random.default_rng(0)
    garden, case = tmp_path / "test_garden.npz", tmp_path / "case.npz"
    means = rng.uniform(-3, 3, (50, 3)).astype(np.float32)
    np.savez(
        garden, means3d=means, colors=rng.integers(0, 256, (50, 3), dtype=np.uint8),
        viewmats=np.stack([np.eye(4)] * 3), Ks=np.stack([np.eye(3)] * 3), width=6, height=4,
    )  # fmt: skip
    ran("make_case.py", case, "--garden", garden)
    with np.load(case) as made:
        assert np.array_equal(made["means"], means[(np.abs(means) <= 2).all(axis=1)])
        assert {made[name].dtype for name in ("means", "colors", "scales")} == {np.dtype("f4")}
        assert made["scales"].min() >= 1e-4 and made["scales"].max() <= 0.02
        assert made["v_image"].shape == (4, 6, 3)
