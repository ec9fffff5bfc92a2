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
        description="Held-out views. every: each N-th image of each folder; stratified: each "
        "N-th of each regime; none: hold out no view; auto: train_list.txt and "
        "test_list.txt if present, else every, or stratified if only that holds out "
        "two views of a regime. Default: auto.",
    )
    test_every: Annotated[int, Flag("N", SCENE)] = Field(
        8,
        ge=2,
        description="Hold out each N-th image of a folder or regime, in the order of names. "
        "Default: 8.",
    )
    init: Annotated[str, Flag("points|random|PLY", SCENE)] = Field(
        "points",
        description="Start of training: the scene's points, random points, or a PLY of "
        "Gaussians. Default: points.",
    )
    points: Annotated[Path | None, Flag("FILE", SCENE)] = Field(
        None,
        description="Point cloud (PLY, LAS, LAZ) that replaces the scene's points, in the "
        "coordinates of its cameras.",
    )
    max_points: int | None = Field(
        None,
        ge=1,
        description="maximum number of points of a point cloud, which is thinned evenly; default "
        "1,000 per photo, at least 100,000",
    )
    cache_mib: int = Field(1280, ge=16, description="memory limit of decoded photos, MiB")
    disk_mib: int = Field(
        20480, ge=0, description="disk space for resized copies of large photos, MiB; 0: none"
    )
    accept_scene: bool = Field(
        False,
        description="train although points, poses and photos do not match, as with --accept-scene",
    )
    masks: Path | None = Field(None, description="mask folder; default <scene>/masks if it exists")

    @property
    def init_file(self) -> Path | None:
        """The PLY file from which the run starts; None if the run starts from points."""
        return None if self.init in {"points", "random"} else Path(self.init)
