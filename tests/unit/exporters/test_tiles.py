"""3D Tiles: tiles of bounded size, levels of detail, the place on Earth."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from support.splat_files import SAME, UTM, content, gaussians, glb_of, rotation_error

from crossgrad_core.numerics.rotations import rotation_matrices
from crossgrad_plugins.exporters import tile_tree
from crossgrad_plugins.exporters.ply_cloud import SplatCloud
from crossgrad_plugins.exporters.spz_file import SpzTable
from crossgrad_plugins.exporters.tiles import Tiles

BOTH = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
#: From y up in a GLB file to z up in a tile set, as the standard requires.
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


@pytest.fixture
def small_tiles(monkeypatch):
    monkeypatch.setattr(tile_tree, "MOST", 100)


def tiles_below(node: dict) -> list[dict]:
    return [node, *(tile for child in node.get("children", []) for tile in tiles_below(child))]


def cloud_of(path: Path) -> SplatCloud:
    """The Gaussians of a tile, in its coordinates, y up."""
    document, binary = glb_of(path)
    assert document["extensionsRequired"] == BOTH
    primitive = document["meshes"][0]["primitives"][0]
    view = primitive["extensions"][BOTH[0]]["extensions"][BOTH[1]]["bufferView"]
    cloud = SpzTable.unpacked(
        binary[: document["bufferViews"][view]["byteLength"]], path
    ).to_cloud()
    assert all(a["count"] == len(cloud) for a in document["accessors"])
    assert all("bufferView" not in a for a in document["accessors"])
    return cloud


def inside(points: np.ndarray, box: list[float]) -> bool:
    center, half = np.array(box[:3]), np.array(box[3:]).reshape(3, 3).diagonal()
    return bool((np.abs(points - center) <= half * (1 + 1e-9)).all())


@pytest.mark.usefixtures("small_tiles")
def test_the_leaves_contain_each_gaussian_once_and_no_tile_more_than_the_limit(tmp_path: Path):
    given = gaussians(1, 2000)
    notes = Tiles().write(content(given), tmp_path / "a")
    assert len(notes) == 1 and "place of the scene on Earth is not known" in notes[0]
    tileset = json.loads((tmp_path / "a" / "tileset.json").read_text())
    assert tileset["asset"]["version"] == "1.1"
    gltf = tileset["extensions"]["3DTILES_content_gltf"]
    assert gltf["extensionsRequired"] == gltf["extensionsUsed"] == BOTH
    tiles = tiles_below(tileset["root"])
    assert {f"{path.name}" for path in (tmp_path / "a").iterdir()} == {
        "tileset.json",
        *(tile["content"]["uri"] for tile in tiles),
    }
    leaves = []
    for tile in tiles:
        cloud = cloud_of(tmp_path / "a" / tile["content"]["uri"])
        means = cloud.means @ Z_UP.T
        assert 0 < len(cloud) <= 100
        assert inside(means, tile["boundingVolume"]["box"])
        diagonal = 2 * np.linalg.norm(np.array(tile["boundingVolume"]["box"][3:]).reshape(3, 3))
        assert tile["geometricError"] == pytest.approx(diagonal if "children" in tile else 0.0)
        for child in tile.get("children", []):
            low, high = (
                np.array(child["boundingVolume"]["box"][:3])
                + sign * np.array(child["boundingVolume"]["box"][3:]).reshape(3, 3).diagonal()
                for sign in (-1, 1)
            )
            assert inside(np.stack([low, high]), tile["boundingVolume"]["box"])
        if "children" not in tile:
            leaves.append(means)
    found = np.concatenate(leaves)
    order, wanted = np.lexsort(found.T.round(3)), np.lexsort(given.means.numpy().T.round(3))
    np.testing.assert_allclose(found[order], given.means[wanted], atol=1e-3)
    # The Gaussians of a leaf are neighbours.
    spread = np.mean([leaf.std(axis=0).mean() for leaf in leaves])
    assert spread < 0.6 * found.std(axis=0).mean()


@pytest.mark.usefixtures("small_tiles")
def test_the_stored_gaussians_are_those_of_the_leaves(tmp_path: Path):
    given = gaussians(3, 500)
    stored = Tiles().stored(given, SAME)
    torch.testing.assert_close(stored.means, given.means, atol=1e-4, rtol=0)
    torch.testing.assert_close(stored.scales.log(), given.scales.log(), atol=1 / 30, rtol=0)
    assert rotation_error(stored.quats, given.quats) < 0.2
    assert stored.sh_rest is not None and given.sh_rest is not None
    assert 0.01 < (stored.sh_rest - given.sh_rest).abs().max() < 0.15
    Tiles().write(content(given), tmp_path / "a")
    path = next(p for p in sorted((tmp_path / "a").glob("0-*.glb")))
    leaf = cloud_of(path)
    row = int(np.abs(stored.means.numpy() - leaf.means[0] @ Z_UP.T).sum(axis=1).argmin())
    turned = leaf.to_gaussians().rotated(torch.from_numpy(Z_UP))
    for name in ("means", "scales", "opacities", "sh_dc", "sh_rest"):
        torch.testing.assert_close(getattr(turned, name)[0], getattr(stored, name)[row])


def test_the_transform_of_the_root_places_the_gaussians_on_earth(tmp_path: Path):
    given = gaussians(0, 50)
    to_ecef = np.eye(4)
    to_ecef[:3, :3] = 2.0 * np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
    to_ecef[:3, 3] = [3.8e6, 1.1e6, -5e6]
    assert len(Tiles().write(content(given, UTM, to_ecef=to_ecef), tmp_path / "a")) == 1
    root = json.loads((tmp_path / "a" / "tileset.json").read_text())["root"]
    place = np.array(root["transform"]).reshape(4, 4).T
    found = cloud_of(tmp_path / "a" / "0.glb").means @ Z_UP.T
    found = found @ place[:3, :3].T + place[:3, 3]
    expected = UTM.to_input(given.means.double().numpy()) @ to_ecef[:3, :3].T + to_ecef[:3, 3]
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_equal_points_and_one_far_away_are_divided():
    means = np.zeros((230_001, 3))
    means[-1] = 1e6
    part = tile_tree.Part.of(means, np.arange(len(means)))
    sizes = [len(leaf.rows) for leaf in part.leaves()]
    assert max(sizes) <= 50_000 and min(sizes) > 20_000
    assert sorted(np.concatenate([leaf.rows for leaf in part.leaves()])) == [*range(len(means))]


def test_a_merged_gaussian_has_the_moments_of_those_that_it_replaces():
    cloud = SplatCloud.from_gaussians(gaussians(1, 8))
    merged = tile_tree.merged(cloud)
    sizes, opacities = np.exp(cloud.log_scales), 1 / (1 + np.exp(-cloud.logit_opacities))
    ordered = np.sort(sizes, axis=1)
    weights = opacities * ordered[:, 1] * ordered[:, 2]
    shares = weights / weights.sum()
    # Draw points from all, and compare with the one Gaussian.
    rng = np.random.default_rng(0)
    who = rng.choice(8, 200_000, p=shares)
    quats = torch.from_numpy(cloud.quats)
    axes = rotation_matrices(quats).numpy() * sizes[:, None]
    points = cloud.means[who] + np.einsum("nij,nj->ni", axes[who], rng.normal(size=(len(who), 3)))
    np.testing.assert_allclose(merged.means[0], points.mean(axis=0), atol=0.05)
    own = rotation_matrices(torch.from_numpy(merged.quats)).numpy()[0] * np.exp(
        merged.log_scales[0]
    )
    np.testing.assert_allclose(own @ own.T, np.cov(points.T), atol=0.2)
    np.testing.assert_allclose(merged.sh_dc[0], shares @ cloud.sh_dc, rtol=1e-5)
    area = np.sort(np.exp(merged.log_scales[0]))[1:].prod()
    opacity = 1 / (1 + np.exp(-merged.logit_opacities[0]))
    assert opacity * area == pytest.approx(weights.sum(), rel=1e-4)


def test_ten_gaussians_become_two():
    assert len(tile_tree.merged(SplatCloud.from_gaussians(gaussians(0, 10)))) == 2


def test_the_tile_of_one_gaussian_is_a_tile_set(tmp_path: Path):
    Tiles().write(content(gaussians(0, 1)), tmp_path / "a")
    assert len(cloud_of(tmp_path / "a" / "0.glb")) == 1
    assert struct.unpack("<I", (tmp_path / "a" / "0.glb").read_bytes()[4:8]) == (2,)
