"""The report about a prepared scene: as data, as text, and as a figure."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any, Final

from crossgrad_core.commands import VERSION
from crossgrad_plugins.prepare.findings import (
    BridgeReport,
    Lost,
    ModelJoin,
    bridges_of,
    joins_of,
    lost_photos,
    parts_of,
)
from crossgrad_plugins.prepare.matching import Link
from crossgrad_plugins.prepare.plan import Plan
from crossgrad_plugins.prepare.results import Result

#: Version of the format of report.json.
FORMAT: Final = 1
#: Maximum number of lines of one kind that are printed. The files of the report contain all lines.
_SHOWN: Final = 8


@dataclass(frozen=True)
class Report:
    """The facts about a prepared scene.

    Attributes:
        plan: Photos and settings.
        features: Name of a photo -> number of features.
        links: Pairs of photos with verified matches.
        result: The models and the position of the scene.
        ways: Names of the method that chose the pairs and of the method that estimated poses.
        misplaced: Name of a photo that was removed from a model -> its matches for and against its
            pose.
    """

    plan: Plan
    features: Mapping[str, int]
    links: Sequence[Link]
    result: Result
    ways: tuple[str, str]
    misplaced: Mapping[str, tuple[int, int]]

    @property
    def posed(self) -> frozenset[str]:
        """Names of the photos in the scene."""
        return frozenset().union(*(part.photos for part in self.result.parts if part.joined))

    @property
    def lost(self) -> tuple[Lost, ...]:
        """The photos that are not in the scene."""
        models = [(frozenset(part.photos), part.joined) for part in self.result.parts]
        return lost_photos(self.plan, self.features, self.links, models, self.misplaced)

    @property
    def joins(self) -> tuple[ModelJoin, ...]:
        """The matches between the folders."""
        return joins_of(self.plan, self.links)

    @property
    def bridges(self) -> tuple[BridgeReport, ...]:
        """The gaps in the scene, where additional photos are needed."""
        parts = parts_of(self.plan, [frozenset(part.photos) for part in self.result.parts])
        return bridges_of(self.plan, self.links, parts, self.heights)

    @property
    def heights(self) -> dict[str, float]:
        """Name of a photo -> height above ground, m, if known."""
        return {
            name: height
            for part in reversed(self.result.parts)
            for name, height in part.heights.items()
        }


def data_of(report: Report) -> dict[str, Any]:
    """Return the report as data."""
    plan, posed = report.plan, report.posed
    figures = report.result.figures
    parts = [
        {"photos": len(part.photos), "points": part.points, "reprojection_error_px": part.error,
         "in_the_scene": part.joined, "not_on_earth_because": part.unplaced}
        for part in report.result.parts
    ]  # fmt: skip
    return {
        "format": FORMAT,
        "crossgrad": VERSION,
        "photos": plan.photos,
        "settings": plan.settings.model_dump(),
        "matching": report.ways[0],
        "mapper": report.ways[1],
        "used": len(plan.used),
        "registered": len(posed),
        "left_out": [photo.model_dump() for photo in plan.left_out],
        "unregistered": [asdict(photo) for photo in report.lost],
        "model": figures,
        "models": parts,
        "folders": [_folder(report, name) for name in plan.folders],
        "joins": [asdict(join) for join in report.joins],
        "bridges": [asdict(bridge) for bridge in report.bridges],
        "gps": None if report.result.georef is None else report.result.georef["residuals_m"],
        "gps_photos": len(plan.located),
        "masked_photos": sum(photo.mask is not None for photo in plan.used),
        "transparent_photos": sum(photo.transparent for photo in plan.used),
    }


def _folder(report: Report, name: str) -> dict[str, Any]:
    photos = [photo.name for photo in report.plan.used if photo.folder == name]
    heights = [report.heights[photo_name] for photo_name in photos if photo_name in report.heights]
    return {
        "folder": name,
        "photos": len(photos),
        "registered": sum(photo_name in report.posed for photo_name in photos),
        "features": median(report.features[photo_name] for photo_name in photos),
        "height_m": median(heights) if heights else None,
    }


def summary_lines(report: Report) -> list[str]:
    """Return the lines that are printed after the scene is finished."""
    return [*_in_short(report), *_missing(report, _SHOWN)]


def _in_short(report: Report) -> Iterator[str]:
    figures = report.result.figures
    yield (
        f"{len(report.posed)} of {len(report.plan.used)} photos have a pose; "
        f"{figures['points']:,.0f} points, mean reprojection error "
        f"{figures['reprojection_error_px']:.2f} pixels"
    )
    for name in report.plan.folders if len(report.plan.folders) > 1 else ():
        row = _folder(report, name)
        height = "" if row["height_m"] is None else f", {row['height_m']:.0f} m above ground"
        yield f"  {name or '(no folder)'}: {row['registered']} of {row['photos']}{height}"
    yield from _gps(report)
    yield from _masks(report.plan)


def _masks(plan: Plan) -> Iterator[str]:
    masked = sum(photo.mask is not None for photo in plan.used)
    transparent = sum(photo.transparent for photo in plan.used)
    if masked:
        yield f"masks: {masked} of {len(plan.used)} photos have one; black pixels are ignored"
    if transparent:
        yield (
            f"transparency: {transparent} of {len(plan.used)} photos have it; masks in "
            "the scene exclude pixels with alpha below one half"
        )


def _gps(report: Report) -> Iterator[str]:
    georef, located = report.result.georef, len(report.plan.located)
    if georef is not None:
        residuals = georef["residuals_m"]
        yield (
            f"GPS: {residuals['photos']} photos, {residuals['agreeing']} agree; residuals "
            f"{residuals['rms_horizontal']:.2f} m horizontally and "
            f"{residuals['rms_vertical']:.2f} m vertically (root mean square), at most "
            f"{residuals['max']:.2f} m"
        )
    elif located:
        yield f"GPS: {located} photos have it, but {report.result.parts[0].unplaced}"
    else:
        yield (
            "GPS: no photo has GPS with an altitude; the scale and the orientation of "
            "the scene are arbitrary"
        )


def _missing(report: Report, most: int) -> Iterator[str]:
    parts = report.result.parts
    others = [part for part in parts[1:] if not part.joined]
    joined = [part for part in parts[1:] if part.joined]
    if joined:
        yield (
            f"{len(joined) + 1} models are joined only by GPS: their relative error is as "
            "large as the GPS error; to reduce it, add photos between them"
        )
    if others:
        sizes = ", ".join(str(len(part.photos)) for part in others)
        yield f"not joined to the scene: {len(others)} other models with {sizes} photos"
    for bridge in report.bridges:
        yield f"models are not connected ({bridge.pairs} pairs match across): {bridge.advice}"
    yield from _some([f"no pose: {photo.name}: {photo.why}" for photo in report.lost], most)
    yield from _some([f"left out: {e.name}: {e.why}" for e in report.plan.left_out], most)


def _some(lines: Sequence[str], most: int) -> Iterator[str]:
    yield from lines[:most]
    if len(lines) > most:
        yield f"... and {len(lines) - most} more lines like this in report.md"


def _sources(report: Report) -> str:
    pairs, poses = report.ways[0], report.ways[1]
    return f"Photos: `{report.plan.photos}`. Matched pairs: {pairs}. Poses: {poses}."


def page_of(report: Report) -> str:
    """Return the report as Markdown text."""
    plan = report.plan
    everything = len(plan.used) + len(plan.left_out)
    lines = ["# From photos to a scene", "", _sources(report), "",
             *(f"- {line}" for line in _in_short(report)),
             *(f"- {line}" for line in _missing(report, everything)), "",
             "![Where the photos were taken](report.png)", "", "## Folders", "",
             "| folder | photos | with a pose | features (median) | metres above ground |",
             "|---|---|---|---|---|"]  # fmt: skip
    for name in plan.folders:
        row = _folder(report, name)
        height = "" if row["height_m"] is None else f"{row['height_m']:.1f}"
        lines.append(f"| {name or '(no folder)'} | {row['photos']} | {row['registered']} | "
                     f"{row['features']:.0f} | {height} |")  # fmt: skip
    lines += [
        "",
        "## Verified matches",
        "",
        "| between | and | pairs | matches |",
        "|---|---|---|---|",
    ]
    lines += [f"| {join.first or '(no folder)'} | {join.second or '(no folder)'} | {join.pairs} | "
              f"{join.matches} |" for join in report.joins]  # fmt: skip
    return "\n".join([*lines, ""])
