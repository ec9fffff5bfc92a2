"""Decisions about exposure, degree of spherical harmonics, and the 3D scale filter."""

from math import isnan
from typing import Final

from crossgrad_plugins.planner.evidence import Evidence
from crossgrad_plugins.planner.finding import Finding, given

#: Higher SH degrees are used only if view dependence explains at least this share of the variance
#: of tracks.
LEAST_SHARE: Final = 0.02
#: Number of values per Gaussian without SH bands above 0: position, shape, opacity and colour.
_OTHER_NUMBERS: Final = 14
#: If the largest footprint of a view is below this multiple of the smallest, all photos show the
#: scene at one scale.
ONE_SCALE: Final = 2.0


def exposure(evidence: Evidence) -> Finding:
    """Decide if each photo gets an exposure."""
    part, config = "exposure", evidence.config
    if evidence.is_given("exposure", "exposure_from") or not evidence.is_measured:
        chosen = config.exposure.name if config.exposure else "default of a run"
        return given(part, chosen, "--exposure NAME")
    from crossgrad_plugins.exposures.tracks.gains import (
        LEAST_RATIO,
        LEAST_REDUCTION,
        LEAST_SPREAD,
        deciding_gains,
    )

    rule = (
        f"gain if the spread is at least {LEAST_SPREAD} stops and {LEAST_RATIO:.0f} "
        f"standard errors, and the deviation falls by at least {LEAST_REDUCTION:.0%}"
    )
    source = "docs/exposure.md, six scenes"
    plain = Finding(part, "none", "default", "", rule, source, "--exposure gain")
    if not any(len(view.seen) for view in evidence.scene.train_views):
        return plain.found(
            "no SfM tracks connect the photos, so their brightness cannot be compared"
        )
    gains = deciding_gains(evidence.scene)
    photos = int(gains.known.sum())
    if not photos:
        return plain.found(gains.evidence)
    figures = {
        "spread_stops": gains.spread,
        "error_stops": gains.error,
        "reduction": gains.fit.reduction,
        "photos": photos,
    }
    shown = plain.found(
        f"gains of {photos} photos: standard deviation {gains.spread:.2f} stops "
        f"(standard error {gains.error:.2f}), which reduce the deviation of tracks by "
        f"{gains.fit.reduction:.0%}",
        decided=True,
        saved="one gain per photo and its updates",
        figures=figures,
    )
    if not gains.differ:
        return shown
    because = f"photos differ in brightness by {gains.spread:.2f} stops"
    return shown.changed("gain", {"exposure": "gain"}, because, "--exposure none")


def degree(evidence: Evidence) -> Finding:
    """Decide the degree of spherical harmonics by how much colour depends on the direction."""
    part, config = "SH degree", evidence.config
    name = config.backbone.name
    of_bands = ("backbone.sh_degree", "backbone.lr_f_rest", "sh_from", "rules.sparse-sh")
    if evidence.is_given(*of_bands, "data.init"):
        chosen = config.backbone.options.get("sh_degree", "as set at the start")
        return given(part, chosen, "--set backbone.sh_degree=N")
    rule = (
        f"0 if degree 1 explains less than {LEAST_SHARE:.0%} of the variation in "
        "tracks, with its whole interval"
    )
    source = "ours: leave-one-out over the directions of a track, after removing exposure"
    force = "--set backbone.sh_degree=N"
    default = "default of the backbone" if evidence.degree is None else str(evidence.degree)
    plain = Finding(part, default, "default", "", rule, source, force)
    if evidence.degree is None:
        return plain.found(f"backbone {name} has no SH degree")
    if evidence.degree == 0:
        return plain.found("too few views for a higher degree", decided=True)
    if not any(len(view.seen) for view in evidence.scene.train_views):
        return plain.found("no SfM tracks show how colours depend on the direction")
    return _of_tracks(evidence, plain)


def _of_tracks(evidence: Evidence, plain: Finding) -> Finding:
    """Decide the degree by the view dependence of SfM tracks."""
    from crossgrad_plugins.planner.view_dependence import (
        FEWEST_TRACKS,
        LEAST_OBSERVATIONS,
        LEAST_RADIUS,
        view_dependence,
    )

    dependence = view_dependence(evidence.scene)
    figures = {
        "tracks": dependence.tracks,
        "share": dependence.share,
        "low": dependence.low,
        "high": dependence.high,
    }
    if dependence.tracks < FEWEST_TRACKS or isnan(dependence.share):
        return plain.found(
            f"{dependence.tracks} tracks with at least {LEAST_OBSERVATIONS} views over at "
            f"least {LEAST_RADIUS:.0f} degrees; {FEWEST_TRACKS} are needed",
            figures=figures,
        )
    shown = (
        f"degree 1 explains {dependence.share:.0%} "
        f"[{dependence.low:.0%}, {dependence.high:.0%}] of the "
        f"brightness of {dependence.tracks} tracks"
    )
    if dependence.high >= LEAST_SHARE:
        return plain.found(shown, decided=dependence.low >= LEAST_SHARE, figures=figures)
    bands = 3 * ((1 + (evidence.degree or 0)) ** 2 - 1)
    saved = f"{bands} of {_OTHER_NUMBERS + bands} numbers of a Gaussian"
    made = plain.found(shown, figures=figures)
    because = "colours do not depend on the direction"
    force = f"--set backbone.sh_degree={evidence.degree}"
    return made.changed("0", {"backbone.sh_degree": 0}, because, force, saved)


def scale_filter(evidence: Evidence) -> Finding:
    """Decide if Gaussians are filtered to the sampling rate of the photos."""
    part, name = "scale filter", evidence.config.backbone.name
    if evidence.is_given("backbone"):
        return given(part, f"default of backbone {name}", "--backbone mip")
    spread = evidence.modes.spread
    rule = f"none if footprints vary by less than {ONE_SCALE:g}"
    plain = Finding(part, "none", "default", "", rule, "Mip-Splatting's zoom", "--backbone mip")
    figures = {"range": spread}
    if spread < ONE_SCALE:
        return plain.found(
            f"footprints range over {spread:.1f}", decided=True, saved="the filter", figures=figures
        )
    return plain.found(
        f"footprints range over {spread:.1f}; at the distances of the photos a filter "
        "gains 0.3 dB on average, and a file rendered without the filter may lose "
        "0.8 dB; at distances between them it gains up to 1.3 dB",
        figures=figures,
    )
