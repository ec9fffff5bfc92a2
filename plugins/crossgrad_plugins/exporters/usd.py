"""USD, the scene format of Pixar: Gaussians in a usdz package."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import (
    ExportContent,
    Exporter,
    Gaussians,
    Rounding,
    Similarity,
    UserError,
    atomic_file,
)
from crossgrad_plugins.exporters.file_units import FileCloud
from crossgrad_plugins.exporters.ply_cloud import SplatCloud
from crossgrad_plugins.exporters.spz_file import unit_quaternions

if TYPE_CHECKING:
    from pxr.Usd import Stage
    from pxr.Vt import Vec3fArray

_NAME: Final = "gaussians"


class Usd(Exporter):
    """A usdz package with a ParticleField3DGaussianSplat of OpenUSD, float32, y up."""

    suffix: ClassVar[str] = "usdz"
    up: ClassVar[str] = "y"

    @override
    def write(self, content: ExportContent, path: Path) -> tuple[str, ...]:
        _require_usd(path)
        units = FileCloud.of(
            SplatCloud.from_gaussians(content.gaussians), content.similarity, path.name
        )
        with _folder_beside(path) as folder, _errors_of_usd(path):
            package = _packed(content, units, folder)
            with package.open("rb") as source, atomic_file(path, package.stat().st_size) as file:
                while block := source.read(1 << 24):
                    file.write(block)
        return units.notes

    @override
    def rounding(self, gaussians: Gaussians, similarity: Similarity) -> Rounding:
        units = FileCloud.of(SplatCloud.from_gaussians(gaussians), similarity)
        # The transform of the file contains the offset.
        return replace(units.float32_rounding, offset=np.zeros(3))


@contextmanager
def _folder_beside(path: Path) -> Iterator[Path]:
    """Yield a folder on the disk of the file; later commands delete a left-over one by its name."""
    end = f".{os.getpid()}.tmp"
    with TemporaryDirectory(prefix=f".{path.name}.", suffix=end, dir=path.parent) as folder:
        yield Path(folder)


def _packed(content: ExportContent, units: FileCloud, folder: Path) -> Path:
    """Write the package to a folder and return its path."""
    from pxr import Sdf, Usd, UsdGeom

    crate, package = folder / f"{_NAME}.usdc", folder / f"{_NAME}.usdz"
    stage = Usd.Stage.CreateNew(str(crate))
    up = np.zeros(3) if content.up is None else content.up
    axis = UsdGeom.Tokens.z if abs(up[2]) > abs(up[1]) else UsdGeom.Tokens.y
    UsdGeom.SetStageUpAxis(stage, axis)
    if content.to_ecef is not None:
        metres = float(np.cbrt(np.linalg.det(content.to_ecef[:3, :3])))
        UsdGeom.SetStageMetersPerUnit(stage, metres)
    _define(stage, units)
    stage.SetMetadata("comment", "\n".join(content.comments))
    stage.GetRootLayer().Save()
    del stage
    writer = Sdf.ZipFileWriter.CreateNew(str(package))
    writer.AddFile(str(crate), crate.name)
    writer.Save()
    crate.unlink()
    return package


def _define(stage: "Stage", units: FileCloud) -> None:
    """Add the Gaussians to a stage of USD."""
    from pxr import Gf, UsdGeom, UsdVol, Vt

    cloud, degree = units.cloud, units.cloud.sh_degree
    splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"/{_NAME}")
    stage.SetDefaultPrim(splats.GetPrim())
    UsdGeom.Xformable(splats).AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(
        Gf.Vec3d(*units.offset.tolist())
    )
    sizes = np.exp(cloud.log_scales)
    means = cloud.means.astype(np.float32)
    reach = 3.0 * sizes.max(axis=1, keepdims=True)
    extent = np.stack([(means - reach).min(axis=0), (means + reach).max(axis=0)])
    bands = np.concatenate(
        [cloud.sh_dc[:, None], cloud.sh_rest[:, : (degree + 1) ** 2 - 1]], axis=1
    )
    splats.CreatePositionsAttr(_vectors(means))
    splats.CreateScalesAttr(_vectors(sizes))
    splats.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(unit_quaternions(cloud.quats)))
    with np.errstate(over="ignore"):
        opacities = (1.0 / (1.0 + np.exp(-cloud.logit_opacities))).astype(np.float32)
    splats.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(opacities))
    splats.CreateExtentAttr(_vectors(extent))
    splats.CreateRadianceSphericalHarmonicsDegreeAttr(degree)
    harmonics = splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(
        _vectors(bands.reshape(-1, 3))
    )
    harmonics.SetMetadata("elementSize", bands.shape[1])
    harmonics.SetMetadata("interpolation", UsdGeom.Tokens.vertex)


def _vectors(values: NDArray[Any]) -> "Vec3fArray":
    """Return [N, 3] numbers as an array of USD."""
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


@contextmanager
def _errors_of_usd(path: Path) -> Iterator[None]:
    """Turn errors of USD, which writes files itself, into a `UserError`."""
    from pxr import Tf

    try:
        yield
    except Tf.ErrorException as error:
        raise UserError(
            "USD cannot write the file",
            where=path,
            found=str(error).strip().splitlines()[-1],
            todo="check the free disk space and the permissions of the folder",
        ) from error


def _require_usd(path: Path) -> None:
    try:
        from pxr import UsdVol
    except ImportError:
        found = "the package usd-core is not installed"
    else:
        if hasattr(UsdVol, "ParticleField3DGaussianSplat"):
            return
        found = "the installed usd-core does not know Gaussians"
    raise UserError(
        "USD files cannot be written",
        where=path,
        expected="usd-core 26.11 or newer",
        found=found,
        todo='pip install "crossgrad[usd]"',
    )
