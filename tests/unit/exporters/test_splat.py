"""`.splat` and compressed PLY files, with gaussforge as the second program."""

import gaussforge
import numpy as np
import pytest
import torch

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.contract.slots.exporter import ExportContent
from crossgrad_core.errors import UserError
from crossgrad_plugins.exporters import compressed_ply
from crossgrad_plugins.exporters.ply import Ply
from crossgrad_plugins.exporters.ply_file import read_ply
from crossgrad_plugins.exporters.splat import Splat

HERE = Similarity(np.zeros(3), 1.0)
UTM = Similarity(np.array([355_142.5, 5_812_377.25, 81.0]), 1 / 60)


def gaussians(degree: int, count: int = 300) -> Gaussians:
    rng = torch.Generator().manual_seed(degree)
    rest = 0.1 * torch.randn((count, (degree + 1) ** 2 - 1, 3), generator=rng)
    return Gaussians(
        means=torch.randn((count, 3), generator=rng),
        quats=torch.randn((count, 4), generator=rng),
        scales=torch.randn((count, 3), generator=rng).exp() * 0.05,
        opacities=torch.rand(count, generator=rng) * 0.98 + 0.01,
        sh_dc=torch.randn((count, 1, 3), generator=rng) * 0.5,
        sh_rest=rest if degree else None,
        sh_degree=degree,
    )


def test_a_second_program_reads_the_splat_file(tmp_path):
    given = gaussians(0)
    assert Splat().write(ExportContent(given, HERE), tmp_path / "a.splat") == ()
    content = (tmp_path / "a.splat").read_bytes()
    assert len(content) == 32 * len(given)
    (tmp_path / "a.ply").write_bytes(
        gaussforge.GaussForge().convert(content, "splat", "ply")["data"]
    )
    theirs = read_ply(tmp_path / "a.ply").to_gaussians()
    ours = Splat().read(tmp_path / "a.splat", HERE)
    for name in ("means", "scales", "sh_dc"):
        torch.testing.assert_close(getattr(theirs, name), getattr(ours, name), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(theirs.opacities, ours.opacities, rtol=0, atol=2e-3)
    torch.testing.assert_close(ours.means, given.means, rtol=0, atol=0)
    torch.testing.assert_close(ours.scales, given.scales, rtol=1e-6, atol=0)
    assert (ours.opacities - given.opacities).abs().max() <= 0.5 / 255 + 1e-6
    turned = (unit(ours.quats) * unit(given.quats)).sum(1).abs()
    assert turned.min() > 0.9999
    assert (unit(theirs.quats) * unit(ours.quats)).sum(1).abs().min() > 0.9999


def unit(quats: torch.Tensor) -> torch.Tensor:
    return quats / quats.norm(dim=1, keepdim=True)


def test_a_splat_far_from_the_origin_is_read_in_the_scene_that_wrote_it(tmp_path):
    given = gaussians(0)
    (note,) = Splat().write(ExportContent(given, UTM), tmp_path / "a.splat")
    assert "coordinates are relative to" in note
    read = Splat().read(tmp_path / "a.splat", UTM)
    assert (read.means - given.means).abs().max() < 1e-5
    torch.testing.assert_close(read.scales, given.scales, rtol=1e-5, atol=0)


@pytest.mark.parametrize("content", [b"", b"x" * 33, np.full(8, np.nan, "<f4").tobytes()])
def test_a_damaged_splat_is_refused(content, tmp_path):
    (tmp_path / "a.splat").write_bytes(content)
    with pytest.raises(UserError, match="splat file cannot be read"):
        Splat().read(tmp_path / "a.splat", HERE)
    with pytest.raises(UserError, match="cannot be read"):
        Splat().sh_degree_of(tmp_path / "b.splat")


def compressed(tmp_path, degree):
    # A PLY of crossgrad always has three bands, and a .splat has none.
    exporter, kind = (Ply(), "ply") if degree else (Splat(), "splat")
    exporter.write(ExportContent(gaussians(degree), HERE), tmp_path / "a")
    content = (tmp_path / "a").read_bytes()
    path = tmp_path / "a.compressed.ply"
    path.write_bytes(gaussforge.GaussForge().convert(content, kind, "compressed.ply")["data"])
    return path


@pytest.mark.parametrize("degree", [0, 3])
def test_a_compressed_ply_is_read_as_a_ply(degree, tmp_path):
    path = compressed(tmp_path, degree)
    read, given = Ply().read(path, HERE), gaussians(degree)
    assert Ply().sh_degree_of(path) == read.sh_degree == degree
    # The format sorts Gaussians; each axis has 10 or 11 bits within 256 neighbours.
    for axis in range(3):
        np.testing.assert_allclose(
            np.sort(read.means[:, axis].numpy()), np.sort(given.means[:, axis].numpy()), atol=0.01
        )
    assert abs(float(read.opacities.mean() - given.opacities.mean())) < 0.01
    if degree:
        assert float(read.sh_rest.std()) == pytest.approx(0.1, rel=0.1)


def test_a_damaged_compressed_ply_is_refused(tmp_path):
    path = compressed(tmp_path, 0)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(UserError, match="compressed PLY file cannot be read"):
        Ply().read(path, HERE)


def test_without_its_package_a_compressed_ply_is_one_error_that_names_the_extra(
    tmp_path, monkeypatch
):
    path = compressed(tmp_path, 0)
    monkeypatch.setattr(compressed_ply, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"crossgrad\[formats\]"):
        Ply().read(path, HERE)
