"""An index of visual words, made from the photos themselves, by which like photos are found."""

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.prepare.layout import Layout
from crossgrad_plugins.prepare.subprocess_wait import quiet, waited

if TYPE_CHECKING:
    import pycolmap

#: Visual words, and features that they are made from: faiss asks for 39 of each word.
_WORDS, _SAMPLE = 2048, 100_000
#: Iterations of k-means, once; the words need not be good.
_ITERATIONS: Final = 20
#: Numbers of a feature, and of its embedding in the index (pycolmap).
_SIFT, _EMBEDDED = 128, 64


def index_of(layout: Layout, threads: int) -> Path:
    """The file of the index, made where it is not there.

    Raises:
        UserError: Pycolmap failed.
    """
    path = layout.work / "index.bin"
    if not path.is_file():
        scratch = path.with_name(f".{path.name}.tmp")
        waited("indexing features", lambda _: _build(layout, threads).write(scratch), lambda: "")
        scratch.replace(path)
    return path


def _build(layout: Layout, threads: int) -> "pycolmap.VisualIndex":
    import pycolmap

    sample = _sample(layout)
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words = min(_WORDS, max(1, len(sample) // 64))
    options.num_iterations, options.num_rounds = _ITERATIONS, 1
    options.num_threads = threads
    index = pycolmap.VisualIndex.create(_SIFT, _EMBEDDED)
    index.build(
        options, pycolmap.FeatureDescriptorsFloat(pycolmap.FeatureExtractorType.SIFT, sample)
    )
    return index


def _sample(layout: Layout) -> NDArray[np.float32]:
    """[N, 128] features, as many of each photo."""
    import pycolmap

    rng = np.random.default_rng(0)
    with quiet():
        database = pycolmap.Database.open(layout.database)
        try:
            numbers = [image.image_id for image in database.read_all_images()]
            known = [number for number in numbers if database.exists_descriptors(number)]
            each = -(-_SAMPLE // len(known))
            parts = []
            for number in known:
                found = np.asarray(database.read_descriptors(number).data)
                rows = rng.permutation(len(found))[:each]
                parts.append(found[rows].astype(np.float32))
        finally:
            database.close()
    return np.concatenate(parts)
