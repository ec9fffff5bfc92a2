"""Search for pairs of photos whose matches agree with one epipolar geometry."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.commands import UserError, check_folder, write_atomically
from crossgrad_plugins.prepare.layout import Layout
from crossgrad_plugins.prepare.plan import Plan
from crossgrad_plugins.prepare.pycolmap_calls import JOURNAL, quiet, rows_of, waited

if TYPE_CHECKING:
    import pycolmap


#: Number of visual words, and number of features from which the words are computed. faiss needs at
#: least 39 features per word.
_WORDS, _SAMPLE = 2048, 100_000
#: Number of iterations of k-means, which is run once. One run is enough, because the words may be
#: approximate.
_ITERATIONS: Final = 20
#: Number of values of a feature, and of its embedding in the index (pycolmap).
_SIFT, _EMBEDDED = 128, 64


def index_of(layout: Layout, threads: int) -> Path:
    """Return the file of the visual index; create the file if it does not exist.

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
    """Return a sample of features [N, 128], with equally many from each photo."""
    import pycolmap

    rng = np.random.default_rng(0)
    with quiet():
        database = pycolmap.Database.open(layout.database)
        try:
            numbers = [image.image_id for image in database.read_all_images()]
            described = [number for number in numbers if database.exists_descriptors(number)]
            per_photo = -(-_SAMPLE // len(described))
            parts = []
            for number in described:
                descriptors = np.asarray(database.read_descriptors(number).data)
                rows = rng.permutation(len(descriptors))[:per_photo]
                parts.append(descriptors[rows].astype(np.float32))
        finally:
            database.close()
    return np.concatenate(parts)


#: Maximum number of photos for which all pairs are compared. The first value applies to scenes with
#: GPS, and the second to scenes without GPS. The third value applies to scenes without GPS and with
#: several folders, because few pairs may connect the folders.
_FEW, _SOME, _SOME_OF_FOLDERS = 60, 100, 250
#: Neighbours are chosen by GPS only if at least this share of the photos has GPS.
_MOST_LOCATED: Final = 0.9
#: Number of photos with which each photo is compared: the nearest by GPS, the most similar, and the
#: next ones by name.
_NEAREST, _ALIKE, _NEXT = 40, 40, 5
#: Number of photos after a photo, in the order of names, that count as its neighbours. This number
#: is used if neighbours are chosen neither by GPS nor by similarity.
_NEXT_ALONE: Final = 20
#: Maximum distance in metres between neighbours by GPS. A photo with a wrong GPS position is
#: therefore not paired with wrong neighbours.
_FARTHEST: Final = 500.0
#: Maximum number of features per photo for the search of similar photos.
_LOOKED_UP: Final = 2000
#: Maximum number of geometries that are tried for the matches of a pair. COLMAP's default is five
#: times as many, which costs time for pairs without common content.
_TRIALS: Final = 2000
#: Number of bytes of a pair in the database, per requested feature of a photo.
_BYTES_OF_PAIR: Final = 2
#: Method of choosing pairs -> pycolmap's pairing methods.
_WAYS: Final = {
    "exhaustive": ("exhaustive",),
    "spatial": ("spatial", "sequential"),
    "retrieval": ("vocabtree", "sequential"),
    "sequential": ("sequential",),
}


@dataclass(frozen=True)
class Link:
    """Two photos that show some of the same scene content.

    Attributes:
        first: Name of one photo.
        second: Name of the other photo.
        matches: Number of matches that agree with the epipolar geometry of the two photos.
    """

    first: str
    second: str
    matches: int


def way_of(plan: Plan) -> str:
    """Return the name of the method that chooses the pairs to compare."""
    chosen, photos = plan.settings.matching, len(plan.used)
    if chosen != "auto":
        return chosen
    if photos <= _FEW:
        return "exhaustive"
    if len(plan.located) >= _MOST_LOCATED * photos:
        return "spatial"
    most = _SOME if len(plan.folders) == 1 else _SOME_OF_FOLDERS
    return "exhaustive" if photos <= most else "retrieval"


def check_gps(plan: Plan) -> None:
    """Refuse neighbours by GPS if fewer than two photos have GPS.

    Raises:
        UserError: Fewer than two photos have GPS.
    """
    if plan.settings.matching == "spatial" and len(plan.located) < 2:  # noqa: PLR2004 - a pair
        raise UserError(
            "--matching spatial needs GPS positions, and the photos have none",
            where="--matching spatial",
            found=f"{len(plan.located)} of {len(plan.used)} photos with GPS",
            todo="leave --matching out, or use --matching retrieval",
        )


def found_links(layout: Layout, plan: Plan, threads: int) -> tuple[Link, ...]:
    """Return the pairs with verified matches.

    Pairs that were compared before are not compared again.

    Raises:
        UserError: The disk is full, or pycolmap failed.
    """
    if layout.links.is_file():
        return tuple(Link(*row) for row in json.loads(layout.links.read_bytes()))
    way = way_of(plan)
    check_folder(layout.work, _room(layout, plan, way))
    pairings = {method: _pairing(method, layout, way, threads) for method in _WAYS[way]}
    total = _pairs(layout, pairings)
    for method, pairing in pairings.items():
        waited(
            "comparing photos",
            lambda token, method=method, pairing=pairing: _match(  # type: ignore[misc]
                layout, method, pairing, threads, token
            ),
            lambda: f"{rows_of(layout.database, 'two_view_geometries')}{total} pairs ({way})",
        )
    links = _read(layout)
    rows = [[link.first, link.second, link.matches] for link in links]
    write_atomically(layout.links, json.dumps(rows).encode())
    return links


def _room(layout: Layout, plan: Plan, way: str) -> int:
    """Return the free bytes that are needed for the missing pairs.

    They are checked in advance, because SQLite aborts the process on a full disk.
    """
    photos = len(plan.used)
    pairs_per_photo = {"exhaustive": photos / 2, "sequential": _NEXT_ALONE}.get(way, _ALIKE + _NEXT)
    missing = photos * min(pairs_per_photo, photos / 2) - rows_of(
        layout.database, "two_view_geometries"
    )
    return int(max(0.0, missing) * _BYTES_OF_PAIR * plan.settings.max_features) + JOURNAL


def _match(
    layout: Layout,
    way: str,
    pairing: object,
    threads: int,
    token: "pycolmap.CancellationToken",
) -> None:
    import pycolmap

    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads = threads
    # Every pair uses a fixed seed, so that results do not depend on the order of pairs or on
    # interruptions.
    verification.ransac.random_seed = 0
    verification.ransac.max_num_trials = _TRIALS
    compare = getattr(pycolmap, f"match_{way}")
    compare(
        layout.database, matching_options=matching, pairing_options=pairing,
        verification_options=verification, device=pycolmap.Device.cpu, cancellation_token=token,
    )  # fmt: skip


def _pairing(method: str, layout: Layout, way: str, threads: int) -> object:
    """Return pycolmap's options for a pairing method."""
    import pycolmap

    options: Any
    if method == "spatial":
        options = pycolmap.SpatialPairingOptions()
        # Ignore the altitude, so that photos from the ground are neighbours of aerial photos above
        # them.
        options.ignore_z = True
        options.max_num_neighbors, options.max_distance = _NEAREST, _FARTHEST
    elif method == "vocabtree":
        options = pycolmap.VocabTreePairingOptions()
        options.vocab_tree_path = index_of(layout, threads)
        options.num_images, options.max_num_features = _ALIKE, _LOOKED_UP
        options.num_threads = threads
    elif method == "sequential":
        options = pycolmap.SequentialPairingOptions()
        options.overlap = _NEXT_ALONE if way == "sequential" else _NEXT
    else:
        options = pycolmap.ExhaustivePairingOptions()
    return options


def _pairs(layout: Layout, pairings: dict[str, object]) -> str:
    """Return a text such as " of 378": the number of pairs to compare.

    The text is empty if the number takes long to compute.
    """
    import pycolmap

    kinds: dict[str, Any] = {
        "exhaustive": pycolmap.ExhaustivePairGenerator,
        "spatial": pycolmap.SpatialPairGenerator,
        "sequential": pycolmap.SequentialPairGenerator,
    }
    if not pairings.keys() <= kinds.keys():
        return ""
    with quiet():
        database = pycolmap.Database.open(layout.database)
        try:
            pairs = [
                tuple(sorted(pair))
                for way, pairing in pairings.items()
                for pair in kinds[way](pairing, database).all_pairs()
            ]
        finally:
            database.close()
    return f" of {len({pair for pair in pairs if pair[0] != pair[1]})}"


def _read(layout: Layout) -> tuple[Link, ...]:
    import pycolmap

    with quiet():
        database = pycolmap.Database.open(layout.database)
        try:
            names = {image.image_id: image.name for image in database.read_all_images()}
            pairs, counts = database.read_two_view_geometry_num_inliers()
        finally:
            database.close()
    links = []
    for pair, count in zip(pairs, counts, strict=True):
        one, other = sorted(names[number] for number in pycolmap.pair_id_to_image_pair(pair))
        if count:
            links.append(Link(one, other, int(count)))
    return tuple(sorted(links, key=lambda link: (link.first, link.second)))
