"""A run that starts from a point cloud: from settings to a resumed run in another folder."""

import numpy as np
import pytest
from support.scenes import write_tiny_scene

import crossgrad_core as cg
from crossgrad_core.commands import open_run
from crossgrad_core.errors import UserError


def write_cloud(path, count=300):
    rng = np.random.default_rng(3)
    rows = np.column_stack([rng.uniform(-1, 1, (count, 2)), np.zeros(count)])
    header = ["ply", "format ascii 1.0", f"element vertex {count}"]
    header += [*(f"property double {axis}" for axis in "xyz"), "end_header"]
    path.write_text("\n".join([*header, *(" ".join(map(str, row)) for row in rows), ""]))


SHORT = {"steps": 2, "threads": 1, "metrics": ["psnr"], "max_gaussians": 10_000}


def test_a_run_from_a_point_cloud_can_be_resumed_in_another_folder(tmp_path, monkeypatch):
    scene = write_tiny_scene(tmp_path / "scene", views=4, width=24, height=16)
    (scene / "sparse" / "0" / "points3D.bin").unlink()
    write_cloud(tmp_path / "cloud.ply")
    with pytest.raises(UserError, match="--points"):
        cg.run(scene, out=tmp_path / "none", **SHORT)
    monkeypatch.chdir(tmp_path)
    cg.run(scene, points="cloud.ply", out=tmp_path / "run", **SHORT)
    monkeypatch.chdir(tmp_path / "run")
    setup, state = open_run(tmp_path / "run", {})
    assert len(setup.scene.points) == 300
    assert state.primitives(setup) == 300
    write_cloud(tmp_path / "cloud.ply", 200)
    with pytest.raises(UserError, match="points"):
        open_run(tmp_path / "run", {})


def test_a_point_cloud_with_random_initialization_is_refused(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene", views=4, width=24, height=16)
    write_cloud(tmp_path / "cloud.ply")
    with pytest.raises(UserError, match=r"data\.points"):
        cg.run(scene, points=tmp_path / "cloud.ply", init="random", out=tmp_path / "run", **SHORT)
