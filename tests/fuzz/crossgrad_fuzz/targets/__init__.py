"""The parsers under test, by name."""

from crossgrad_fuzz.target import Target
from crossgrad_fuzz.targets import (
    checkpoints,
    colmap,
    lists,
    named,
    photos,
    places,
    ply,
    readers,
    records,
    scenes,
    settings,
    tables,
)

TARGETS: dict[str, Target] = {
    target.name: target
    for module in (
        *(ply, colmap, scenes, readers, photos, settings, checkpoints, lists, tables),
        *(records, named, places),
    )
    for target in module.TARGETS
}
