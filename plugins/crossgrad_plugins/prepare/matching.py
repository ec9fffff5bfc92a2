"""Which photos show the same: pairs with matches that one epipolar geometry explains."""

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


#: Up to so many photos all pairs are compared; without GPS, up to the second, and where they are in
#: several folders, which few pairs may join, up to the third.
_FEW, _SOME, _SOME_OF_FOLDERS = 60, 100, 250
#: Share of the photos that need GPS for neighbours to be told by it.
_MOST_LOCATED: Final = 0.9
#: Photos that each one is compared with: the nearest by GPS, the most alike, the next by name.
_NEAREST, _ALIKE, _NEXT = 40, 40, 5
#: Next by name where nothing else tells neighbours.
_NEXT_ALONE: Final = 20
#: Neighbours by GPS are not farther away, in metres: GPS that is wrong finds none.
_FARTHEST: Final = 500.0
#: Features of a photo by which others like it are looked up, at most.
_LOOKED_UP: Final = 2000
#: Geometries that are tried to explain the matches of a pair, at most. COLMAP tries five times as
#: many of pairs that show nothing in common.
_TRIALS: Final = 2000
#: Bytes of a pair in the database for each feature of a photo that is asked for.
_BYTES_OF_PAIR: Final = 2
#: How photos to compare are chosen -> pycolmap's ways that this takes.
_WAYS: Final = {
    "exhaustive": ("exhaustive",),
    "spatial": ("spatial", "sequential"),
    "retrieval": ("vocabtree", "sequential"),
    "sequential": ("sequential",),
}


@dataclass(frozen=True)
class Link:
    """Two photos that show the same.

    Attributes:
        first: Name of one.
        second: Name of the other.
        matches: Matches that their epipolar geometry explains.
    """

    first: str
    second: str
    matches: int


def way_of(plan: Plan) -> str:
    """How photos to compare are chosen."""
    chosen, photos = plan.settings.matching, len(plan.used)
    if chosen != "auto":
        return chosen
    if photos <= _FEW:
        return "exhaustive"
    if len(plan.located) >= _MOST_LOCATED * photos:
        return "spatial"
    some = _SOME if len(plan.folders) == 1 else _SOME_OF_FOLDERS
    return "exhaustive" if photos <= some else "retrieval"


def check_gps(plan: Plan) -> None:
    """Refuses to tell neighbours by GPS where photos have none.

    Raises:
        UserError: Fewer than two photos have GPS.
    """
    if plan.settings.matching == "spatial" and len(plan.located) < 2:  # noqa: PLR2004 - a pair
        raise UserError(
            "the photos have no GPS to tell neighbours by",
            where="--matching spatial",
            found=f"{len(plan.located)} of {len(plan.used)} photos with GPS",
            todo="leave --matching out, or use --matching retrieval",
        )


def found_links(layout: Layout, plan: Plan, threads: int) -> tuple[Link, ...]:
    """The pairs with verified matches; pairs that are done are not compared again.

    Raises:
        UserError: The disk is full, or pycolmap failed.
    """
    if layout.links.is_file():
        return tuple(Link(*row) for row in json.loads(layout.links.read_bytes()))
    way = way_of(plan)
    check_folder(layout.work, _room(layout, plan, way))
    pairings = {each: _pairing(each, layout, way, threads) for each in _WAYS[way]}
    total = _pairs(layout, pairings)
    for each, pairing in pairings.items():
        waited(
            "comparing photos",
            lambda token, each=each, pairing=pairing: _match(  # type: ignore[misc]
                layout, each, pairing, threads, token
            ),
            lambda: f"{rows_of(layout.database, 'two_view_geometries')}{total} pairs ({way})",
        )
    links = _read(layout)
    rows = [[link.first, link.second, link.matches] for link in links]
    write_atomically(layout.links, json.dumps(rows).encode())
    return links


def _room(layout: Layout, plan: Plan, way: str) -> int:
    """Bytes that the pairs that are missing take; SQLite ends the process on a full disk."""
    photos = len(plan.used)
    each = {"exhaustive": photos / 2, "sequential": _NEXT_ALONE}.get(way, _ALIKE + _NEXT)
    missing = photos * min(each, photos / 2) - rows_of(layout.database, "two_view_geometries")
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
    # Each pair by itself: the same in whatever order, and after whatever interruption.
    verification.ransac.random_seed = 0
    verification.ransac.max_num_trials = _TRIALS
    compare = getattr(pycolmap, f"match_{way}")
    compare(
        layout.database, matching_options=matching, pairing_options=pairing,
        verification_options=verification, device=pycolmap.Device.cpu, cancellation_token=token,
    )  # fmt: skip


def _pairing(each: str, layout: Layout, way: str, threads: int) -> object:
    """Pycolmap's options for one of its ways to choose pairs."""
    import pycolmap

    options: Any
    if each == "spatial":
        options = pycolmap.SpatialPairingOptions()
        # Photos from the ground are neighbours of those from above them.
        options.ignore_z = True
        options.max_num_neighbors, options.max_distance = _NEAREST, _FARTHEST
    elif each == "vocabtree":
        options = pycolmap.VocabTreePairingOptions()
        options.vocab_tree_path = index_of(layout, threads)
        options.num_images, options.max_num_features = _ALIKE, _LOOKED_UP
        options.num_threads = threads
    elif each == "sequential":
        options = pycolmap.SequentialPairingOptions()
        options.overlap = _NEXT_ALONE if way == "sequential" else _NEXT
    else:
        options = pycolmap.ExhaustivePairingOptions()
    return options


def _pairs(layout: Layout, pairings: dict[str, object]) -> str:
    """How many pairs will be compared, as " of 378"; empty where it takes long to know."""
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
    found = []
    for pair, count in zip(pairs, counts, strict=True):
        one, other = sorted(names[each] for each in pycolmap.pair_id_to_image_pair(pair))
        if count:
            found.append(Link(one, other, int(count)))
    return tuple(sorted(found, key=lambda link: (link.first, link.second)))
