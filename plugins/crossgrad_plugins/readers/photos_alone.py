"""Reader of folders of photos without poses, which are estimated as by `crossgrad prepare`."""

from dataclasses import replace
from pathlib import Path

from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import Reader, Scene, SceneOptions, UserError
from crossgrad_plugins.readers.colmap import ColmapReader


class PhotosAloneReader(Reader):
    """Photos without poses (`--prepare`); their poses are estimated in minutes or hours.

    The prepared scene is stored in a new folder beside the photos. Later calls of `crossgrad
    prepare` and resumed runs use this scene again. After the scene is complete, the photos and the
    scene's folder `prepare/` may be deleted. This reader is never chosen automatically.
    """

    scene: Path | None = Field(
        None,
        description="folder of the prepared scene; by default the photo folder's name with "
        "-scene, next to it",
    )

    @override
    def accepts(self, path: Path) -> bool:
        return False

    @override
    def read(self, path: Path, options: SceneOptions) -> Scene:
        from crossgrad_plugins.prepare.app import made_or_ready
        from crossgrad_plugins.prepare.plan import Settings

        photos = path.resolve()
        if not photos.name and self.scene is None:
            raise UserError(
                "the folder for the prepared scene cannot be created next to the photos",
                where=photos,
                todo="name its folder with --set reader.scene=FOLDER",
            )
        folder = self.scene or photos.with_name(f"{photos.name}-scene")
        messages = made_or_ready(photos, folder, Settings())
        scene = ColmapReader().read(folder, options)
        lines = (f"the photos were prepared into {folder}", *messages)
        return replace(scene, notes=(*(f"prepare: {line}" for line in lines), *scene.notes))
