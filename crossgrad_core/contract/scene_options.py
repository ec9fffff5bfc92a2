"""Options for reading a scene."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from crossgrad_core.contract.flags import SCENE, Flag


class SceneOptions(BaseModel):
    """Options for reading, splitting and resizing."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    max_size: Annotated[int | None, Flag("PIXELS", SCENE, common=True)] = Field(
        None, ge=16, description="Longest image side; larger photos are resized."
    )
    split: Annotated[
        Literal["auto", "every", "stratified", "none"],
        Flag("auto|every|stratified|none", SCENE),
    ] = Field(
        "auto",
        description="every: hold out each n-th image of each folder; stratified: each n-th of each "
        "regime; none: train on all; auto: train_list.txt and test_list.txt where present, else "
        "every, or stratified where only that holds out two of a regime. Default: auto.",
    )
    test_every: Annotated[int, Flag("N", SCENE)] = Field(
        8,
        ge=2,
        description="Each N-th image of a folder or regime, by name, is held out. Default: 8.",
    )
    init: Annotated[str, Flag("points|random|PLY", SCENE)] = Field(
        "points",
        description="Where training starts: the scene's points, random ones, or a PLY of "
        "Gaussians. Default: points.",
    )
    points: Annotated[Path | None, Flag("FILE", SCENE)] = Field(
        None,
        description="Point cloud (PLY, LAS, LAZ) in place of the scene's points, in the "
        "coordinates of its cameras.",
    )
    max_points: int | None = Field(
        None,
        ge=1,
        description="most points that are taken of a point cloud, which is thinned evenly; default "
        "1,000 per photo, at least 100,000",
    )
    cache_mib: int = Field(1280, ge=16, description="memory for decoded photos, MiB")
    disk_mib: int = Field(
        20480, ge=0, description="disk space for large photos in the size as trained, MiB; 0: none"
    )
    accept_scene: bool = Field(
        False, description="go on although the scene contradicts itself, as --accept-scene does"
    )
    masks: Path | None = Field(None, description="mask folder; default <scene>/masks if present")

    @property
    def init_file(self) -> Path | None:
        """The PLY file from which the run starts; None if it starts from points."""
        return None if self.init in {"points", "random"} else Path(self.init)
