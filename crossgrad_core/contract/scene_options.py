"""What a user can say about how a scene is read."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class SceneOptions(BaseModel):
    """Options of reading, splitting and resizing."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    max_size: int | None = Field(
        None, ge=16, description="longest image side in pixels; larger photos are resized"
    )
    split: Literal["auto", "every", "none"] = Field(
        "auto",
        description="auto: train_list.txt/test_list.txt if present, else every; "
        "every: each --test-every-th image of each folder; none: train on all",
    )
    test_every: int = Field(8, ge=2, description="each n-th image by name of a folder is held out")
    init: str = Field("points", description="points (SfM), random, or the path of a PLY file")
    cache_mib: int = Field(2048, ge=16, description="memory for decoded photos, MiB")
    masks: Path | None = Field(None, description="mask folder; default <scene>/masks if present")

    @property
    def init_file(self) -> Path | None:
        """The PLY file to start from, or None where there is none."""
        return None if self.init in {"points", "random"} else Path(self.init)
