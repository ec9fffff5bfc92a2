"""Mapping: poses and points from matches, as one model or several unconnected models."""

import itertools
import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from crossgrad_core.commands import UserError, disk_errors, write_atomically
from crossgrad_plugins.prepare.contradictions import contradicted
from crossgrad_plugins.prepare.layout import Layout, emptied, models_in, scratch_of
from crossgrad_plugins.prepare.plan import Plan
from crossgrad_plugins.prepare.pycolmap_calls import quiet, waited, write_model
from crossgrad_plugins.prepare.refine_poses import looked_again

if TYPE_CHECKING:
    import pycolmap


#: Two limits. The first is the minimum number of points for a pose, as in COLMAP's incremental
#: mapping. The second is the minimum number of points that two photos of a model share, directly or
#: through other photos.
_POINTS, _SHARED = 30, 15


def sound_models(
    models: "Iterable[pycolmap.Reconstruction]", smallest: int
) -> "list[pycolmap.Reconstruction]":
    """Return the models without weakly supported photos.

    Each connected part becomes a separate model. Global mapping places every photo that rotations
    connect, even if the only connection is a wrong pair, and gives no warning. The points that are
    left after a check show if a photo is well supported.

    Args:
        models: The models after mapping.
        smallest: Minimum number of photos of a returned model.
    """
    return [
        _only(model, part) for model in models for part in _parts(model) if len(part) >= smallest
    ]


def _parts(model: "pycolmap.Reconstruction") -> list[frozenset[int]]:
    """Return the photo numbers of each connected part."""
    numbers = np.array(sorted(model.reg_image_ids()))
    counts = np.array([model.image(int(number)).num_points3D for number in numbers])
    held = numbers[counts >= _POINTS]
    if not len(held):
        return []
    tracks = [
        {element.image_id for element in point.track.elements} for point in model.points3D.values()
    ]
    rows = np.concatenate([np.array(sorted(track), dtype=np.int64) for track in tracks])
    columns = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    kept = np.isin(rows, held)
    places = np.searchsorted(held, rows[kept])
    shape = (len(held), len(tracks))
    seen = coo_matrix((np.ones(len(places)), (places, columns[kept])), shape=shape).tocsr()
    _, labels = connected_components((seen @ seen.T) >= _SHARED, directed=False)
    return [frozenset(held[labels == label].tolist()) for label in np.unique(labels)]


def _only(model: "pycolmap.Reconstruction", part: frozenset[int]) -> "pycolmap.Reconstruction":
    """Return a copy of the model that contains only the photos of one part."""
    import pycolmap

    alone = pycolmap.Reconstruction(model)
    for number in list(alone.reg_image_ids()):
        if number not in part:
            alone.deregister_frame(alone.image(number).frame_id)
    return alone


#: Minimum number of photos for global mapping: for one folder, and for several folders. Two folders
#: are often connected by few matches, and global mapping then misplaces one of them
#: (docs/prepare.md).
_MANY, _MANY_OF_FOLDERS = 100, 1000
#: Minimum number of photos in a model that is kept.
_SMALLEST: Final = 3
Models = Mapping[int, "pycolmap.Reconstruction"]


def way_of(plan: Plan) -> str:
    """Return the name of the mapping method."""
    if plan.settings.mapper != "auto":
        return plan.settings.mapper
    many = _MANY if len(plan.folders) == 1 else _MANY_OF_FOLDERS
    return "incremental" if len(plan.used) < many else "global"


def found_models(layout: Layout, plan: Plan, threads: int) -> "list[pycolmap.Reconstruction]":
    """Return the models, sorted by number of photos, largest first.

    Raises:
        UserError: No two photos could be connected, the disk is full, or pycolmap failed.
    """
    if not layout.models.is_dir():
        scratch = emptied(scratch_of(layout.models))
        below, again = emptied(scratch / "found"), emptied(scratch / "again")
        settled: frozenset[int] = frozenset()
        if way_of(plan) == "global":
            models = list(_global(layout, plan, threads, below).values())
            models = sound_models(models, _SMALLEST)
        else:
            models = list(_incremental(layout, plan, threads, below).values())
            models, settled = _looked_again(layout, plan, threads, again, models)
        models = _without_misplaced(layout, models, settled)
        if not models:
            raise _nothing(layout, plan)
        for folder in (below, again):
            shutil.rmtree(folder)
        ordered = sorted(models, key=lambda model: -model.num_reg_images())
        for number, model in enumerate(ordered):
            write_model(model, emptied(scratch / str(number)))
        scratch.replace(layout.models)
    return [model for _, model in read_models(layout.models)]


def misplaced(layout: Layout) -> dict[str, tuple[int, int]]:
    """Return by name the matches for and against the pose of each photo that was removed."""
    if not layout.misplaced.is_file():
        return {}
    return {
        name: (yes, no) for name, (yes, no) in json.loads(layout.misplaced.read_bytes()).items()
    }


def _without_misplaced(
    layout: Layout, models: "list[pycolmap.Reconstruction]", settled: frozenset[int] = frozenset()
) -> "list[pycolmap.Reconstruction]":
    """Remove photos whose matches contradict their poses, and store their names.

    Args:
        layout: The paths of the scene.
        models: The models, largest first.
        settled: Photos of the largest model for which no better pose was found.
    """
    removed: dict[str, tuple[int, int]] = {}
    for number, model in enumerate(models):
        settled_here = frozenset[int]() if number else settled
        doubted = waited(
            "checking poses",
            lambda _, model=model, settled_here=settled_here: contradicted(  # type: ignore[misc]
                model, layout.database, settled_here
            ),
            lambda: "",
        )
        for photo, votes in doubted.items():
            image = model.image(photo)
            removed[image.name] = votes
            model.deregister_frame(image.frame_id)
    kept = [model for model in models if model.num_reg_images() >= _SMALLEST]
    elsewhere = {model.image(n).name for model in kept for n in model.reg_image_ids()}
    unplaced = {name: votes for name, votes in sorted(removed.items()) if name not in elsewhere}
    write_atomically(layout.misplaced, json.dumps(unplaced, indent=1).encode())
    return kept


def read_models(folder: Path) -> "Iterator[tuple[Path, pycolmap.Reconstruction]]":
    """Yield the models of a folder and their paths, sorted by number."""
    import pycolmap

    for path in models_in(folder):
        with quiet():
            yield path, pycolmap.Reconstruction(path)


def _incremental(layout: Layout, plan: Plan, threads: int, out: Path) -> Models:
    import pycolmap

    posed = itertools.count(2)
    latest = [2]

    def one_more() -> None:
        latest[0] = next(posed)

    return waited(
        "finding cameras",
        lambda token: dict(pycolmap.incremental_mapping(
            layout.database, Path(plan.photos), out, options=_options(threads),
            next_image_callback=one_more, cancellation_token=token,
        )),
        lambda: f"{latest[0]} of {len(plan.used)} photos",
    )  # fmt: skip


def _options(threads: int) -> "pycolmap.IncrementalPipelineOptions":
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = threads, 0
    options.min_model_size = _SMALLEST
    # The fallback mapper also estimates poses from pairs of photos, but does not check how many
    # pairs agree.
    options.structure_less_registration_fallback = False
    return options


def _looked_again(
    layout: Layout,
    plan: Plan,
    threads: int,
    scratch: Path,
    models: "list[pycolmap.Reconstruction]",
) -> "tuple[list[pycolmap.Reconstruction], frozenset[int]]":
    """Return models with refined photos, and the photos that could not be improved."""
    adjust = partial(_adjusted, threads, Path(plan.photos))
    with disk_errors(scratch):
        return waited(
            "finding poses for doubtful photos",
            lambda token: looked_again(
                models, layout.database, scratch, partial(adjust, token), lambda: token.is_cancelled
            ),
            lambda: "",
        )


def _adjusted(
    threads: int, photos: Path, token: "pycolmap.CancellationToken", database: Path, folder: Path
) -> "pycolmap.Reconstruction":
    """Return the model in a folder after new triangulation and further mapping."""
    import pycolmap

    anew, mapped = (emptied(folder / name) for name in ("anew", "found"))
    options = _options(threads)
    options.multiple_models = False
    model = pycolmap.triangulate_points(
        pycolmap.Reconstruction(folder), database, photos, anew, options=options,
        cancellation_token=token,
    )  # fmt: skip
    write_model(model, anew)
    models = pycolmap.incremental_mapping(
        database, photos, mapped, options=options, input_path=anew, cancellation_token=token
    )
    return max(models.values(), key=lambda candidate: candidate.num_reg_images(), default=model)


def _global(layout: Layout, plan: Plan, threads: int, out: Path) -> Models:
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = threads, 0
    options.mapper.num_threads, options.mapper.random_seed = threads, 0
    options.min_model_size = _SMALLEST
    options.mapper.global_positioning.use_gpu = False
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    call: Callable[[object], Models] = lambda _: dict(  # noqa: E731 - it cannot be cancelled
        pycolmap.global_mapping(layout.database, Path(plan.photos), out, options=options)
    )
    return waited("finding cameras", call, lambda: f"{len(plan.used)} photos at once")


def _nothing(layout: Layout, plan: Plan) -> UserError:
    pairs = len(json.loads(layout.links.read_bytes()))
    return UserError(
        "no camera pose could be estimated: no photos match well enough",
        where=plan.photos,
        expected="photos that overlap by more than half, taken from different positions",
        found=f"{len(plan.used)} photos; {pairs} pairs of them match ({layout.links})",
        todo="add photos between the existing photos, or choose another --lens or --matching",
    )
