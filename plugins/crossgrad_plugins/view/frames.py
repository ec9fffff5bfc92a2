"""Frames: layers of the sources, left and right of a split line."""

from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.commands import error_map
from crossgrad_core.plugin import Similarity, View, to_uint8
from crossgrad_plugins.view.cameras import Fit, moved
from crossgrad_plugins.view.sources import Source

Pixels = NDArray[np.uint8]
Kind = Literal["render", "photo", "error", "depth", "points"]
#: Quantiles of depth that get the ends of the colour scale.
_DEPTHS: Final = (0.02, 0.98)


@dataclass(frozen=True)
class Layer:
    """A layer of a frame.

    Attributes:
        kind: render, photo, error and depth; points is the empty layer of a scene.
        source: Position of the source.
    """

    kind: Kind
    source: int = 0

    def label(self, sources: int) -> str:
        """Return the name on the page; with two sources, renders have a letter."""
        return self.kind if sources == 1 or self.kind == "photo" else f"{self.kind} {self.letter}"

    @property
    def letter(self) -> str:
        """The letter of the source on the page."""
        return "AB"[self.source]


def layers_of(sources: list[Source]) -> tuple[Layer, ...]:
    """Return the layers that the sources can show, the default first."""
    drawn = [number for number, source in enumerate(sources) if source.draw is not None]
    has_photos = any(source.views for source in sources)
    photo = [Layer("photo")] if has_photos else []
    if not drawn:
        return (*photo, Layer("points"))
    kinds: tuple[Kind, ...] = ("error", "depth") if has_photos else ("depth",)
    renders = [Layer("render", number) for number in drawn]
    return (*renders, *photo, *(Layer(kind, number) for kind in kinds for number in drawn))


@dataclass(frozen=True)
class Look:
    """The choices of a user about the frames.

    Attributes:
        left: Layer left of the split line.
        right: Layer right of the split line.
        split: Position of the line, 0 at the left border, 1 at the right border.
        exposure: True if the photo's exposure is applied at a camera of the scene.
    """

    left: Layer
    right: Layer
    split: float = 1.0
    exposure: bool = True


@dataclass
class Frame:
    """A frame in the making; each source is rendered at most once.

    Attributes:
        sources: The sources.
        world: The frame of reference of the cameras.
        fit: The camera and its place in the frame.
        view: The view whose photo is compared; None for a free camera.
        look: The choices of the user.
    """

    sources: list[Source]
    world: Similarity
    fit: Fit
    view: View | None
    look: Look
    _renders: dict[int, tuple[Tensor, Tensor | None]] = field(default_factory=dict)

    def pixels(self) -> Pixels:
        """Return the frame, [height, width, 3]."""
        fit, look = self.fit, self.look
        columns = round(min(max(look.split, 0.0), 1.0) * fit.width) - fit.left
        width = fit.camera.width
        columns = 0 if columns < 0 else min(columns, width)
        frame = np.zeros((fit.height, fit.width, 3), dtype=np.uint8)
        image = frame[fit.top :, fit.left :][: fit.camera.height, :width]
        if columns > 0:
            image[:, :columns] = self._layer(look.left)[:, :columns]
        if columns < width:
            image[:, columns:] = self._layer(look.right)[:, columns:]
        if 0 < columns < width:
            image[:, columns] = 255
        return frame

    def _layer(self, layer: Layer) -> Pixels:
        if layer.kind == "depth":
            return self._depth(layer.source)
        photo = self._photo()
        if layer.kind == "render" or (photo is None and self._can_render(layer.source)):
            return self._image(layer.source)
        if photo is None or layer.kind == "points":
            return np.zeros((self.fit.camera.height, self.fit.camera.width, 3), dtype=np.uint8)
        return photo if layer.kind == "photo" else error_map(photo, self._image(layer.source))

    def _can_render(self, source: int) -> bool:
        return self.sources[source].draw is not None

    def _photo(self) -> Pixels | None:
        """Return the photo in the size of the image; None for a free camera."""
        if self.view is None:
            return None
        photo: Pixels = self.view.photo.image().cpu().numpy()
        size = self.fit.camera.width, self.fit.camera.height
        if photo.shape[1::-1] == size:
            return photo
        from PIL import Image

        return np.asarray(Image.fromarray(photo).resize(size, Image.Resampling.BOX))

    def _image(self, number: int) -> Pixels:
        source, (image, _) = self.sources[number], self._drawn(number)
        view = None if self.view is None else source.views.get(self.view.name)
        if self.look.exposure and view is not None and source.exposed is not None:
            image = source.exposed(view, image)
        return to_uint8(image).numpy()

    def _depth(self, number: int) -> Pixels:
        """Return colours of the inverse depth, near is bright; nothing is black."""
        from matplotlib import colormaps

        _, depth = self._drawn(number)
        if depth is None:
            return np.zeros((self.fit.camera.height, self.fit.camera.width, 3), dtype=np.uint8)
        near = depth.reciprocal().nan_to_num(0.0, 0.0, 0.0).cpu().numpy()
        solid = near > 0
        low, high = np.quantile(near[solid], _DEPTHS) if solid.any() else (0.0, 1.0)
        shade = np.clip((near - low) / max(high - low, 1e-12), 0.0, 1.0)
        colors = colormaps["turbo"](shade)[..., :3] * solid[..., None]
        return np.asarray((colors * 255).round(), dtype=np.uint8)

    def _drawn(self, number: int) -> tuple[Tensor, Tensor | None]:
        """Return image [H, W, 3] and mean depth [H, W]; the depth only if a layer shows it."""
        if number not in self._renders:
            source, shown = self.sources[number], (self.look.left, self.look.right)
            outputs = frozenset({"depth"} & {layer.kind for layer in shown})
            camera = moved(self.fit.camera, self.world, source.similarity)
            if source.draw is None:
                raise RuntimeError("a scene without a model has no render")
            with torch.no_grad():
                render = source.draw(camera, outputs)
            depth = None if render.depth is None else render.depth / render.alpha
            self._renders[number] = render.image, depth
        return self._renders[number]
