"""Decisions about modes of cameras, pairs of views, views per step, and the operator."""

from dataclasses import replace
from math import isfinite, isnan
from typing import TYPE_CHECKING, Final

from crossgrad_core.commands import ComponentChoice
from crossgrad_core.plugin import ViewsPerStepSpec
from crossgrad_plugins.planner.evidence import Evidence
from crossgrad_plugins.planner.finding import NOTHING, Finding, given
from crossgrad_plugins.planner.modes import FEWEST, LEAST_RATIO, LEAST_SHARE, ONE_OF, Modes

if TYPE_CHECKING:
    from crossgrad_plugins.planner.probe import Probe

#: Minimum ratio sigma_b^2 / sigma_w^2 (variance between groups / within groups) for pairs of views.
#: Pairs reduce the gradient variance of a step by about this share.
LEAST_RHO: Final = 0.1
#: Minimum share of the views in the smaller mode for pairs of views. Pairs give both modes equal
#: weights. With a smaller share, the training objective would change too much.
EVEN: Final = 0.4
#: Expected share of conflicting pairs if gradients have independent directions.
CHANCE: Final = 0.5

#: Number of groups of a sampler that draws near and far views.
_BOTH: Final = 2
_TWO_VIEWS: Final = "docs/results/two-views.md"
#: Names of rows in docs/results/two-views.md and docs/results/paper.md.
_TWO_AGAINST_ONE: Final = (
    "two views minus one over our scenes, both drawn in epochs: -0.22 dB (-0.33 to -0.10 dB; n = "
    "12) at equal seconds, different; -0.01 dB (-0.11 to +0.09 dB; n = 12) at equal views, open, "
    "with two views ahead on city_hybrid (+0.19 dB). With two views drawn at random: -0.07 dB "
    "(-0.19 to +0.07 dB; n = 12) at equal seconds, inconclusive"
)
_NOT_KNOWN: Final = "not known; --probe SECONDS measures it"


def modes(evidence: Evidence) -> Finding:
    """Report the number of modes of the camera distances."""
    camera_modes = evidence.modes
    rule = (
        f"two: distances or heights that Otsu's cut separates better than the best of {ONE_OF} "
        f"evenly spread samples, at least {FEWEST} views, {LEAST_SHARE:.0%} of them on each side, "
        f"far / near >= {LEAST_RATIO}; "
        f"one distance: range (95th / 5th percentile) < {LEAST_RATIO}"
    )
    source = "ours; Otsu 1979. Sarle's coefficient, the paper's, calls lopsided distances two modes"
    plain = Finding("modes", _name(camera_modes), "default", "", rule, source, "--grouping NAME")
    figures = {
        "bimodality": camera_modes.bimodality,
        "separability": camera_modes.cut.separability,
        "separability_of_even": camera_modes.cut.usual,
        "smaller_share": camera_modes.cut.share,
        "far_over_near": camera_modes.cut.ratio,
        "range": camera_modes.spread,
        "views": len(camera_modes.logs),
    }
    evidence_text = (
        f"{_figures(camera_modes)} over {len(camera_modes.logs)} views, "
        f"range {camera_modes.spread:.1f}"
    )
    return plain.found(evidence_text, decided=camera_modes.two or camera_modes.one, figures=figures)


def pairs(evidence: Evidence) -> Finding:
    """Decide if steps use pairs of near and far views."""
    config, camera_modes = evidence.config, evidence.modes
    part, configured = "pairs of views", config.sampler.name
    if evidence.is_given("sampler", "grouping"):
        return given(part, configured, "--sampler NAME")
    rule = (
        f"two modes, {EVEN:.0%} of the views or more in each, and sigma_b^2 / sigma_w^2 >= "
        f"{LEAST_RHO} with its whole interval"
    )
    plain = Finding(
        part, configured, "default", "", rule, "paper, Proposition 2", "--sampler near-far"
    )
    if camera_modes.one:
        return plain.found(
            "one mode: no near and far groups", decided=True, saved="groups of views"
        )
    if not camera_modes.two:
        return plain.found("modes undecided")
    return _pairs_of_two_modes(evidence, plain)


def _pairs_of_two_modes(evidence: Evidence, plain: Finding) -> Finding:
    """Decide by the probe if pairs of views are worth their cost."""
    probe = evidence.probe
    if probe is None:
        return plain.found(f"two modes; sigma_b^2 / sigma_w^2 is {_NOT_KNOWN}")
    if probe.problem or not isfinite(probe.rho_low + probe.rho_high):
        return plain.found(
            f"the probe is not conclusive: {probe.problem or _without_interval(probe)}"
        )
    figures = {"rho": probe.rho, "rho_low": probe.rho_low, "rho_high": probe.rho_high}
    shown = f"sigma_b^2 / sigma_w^2 {probe.rho:.3f} [{probe.rho_low:.3f}, {probe.rho_high:.3f}]"
    if probe.rho_low < LEAST_RHO:
        decided = probe.rho_high < LEAST_RHO
        saved = "groups of views" if decided else NOTHING
        return plain.found(shown, decided=decided, saved=saved, figures=figures)
    if evidence.is_given("views_per_step") and not _even(evidence.view_plan):
        return plain.found(f"{shown}; pairs need an even --views", figures=figures)
    cut = evidence.modes.cut
    if cut.share < EVEN:
        return plain.found(
            f"{shown}; but the smaller mode has {cut.share:.0%} of the views, and pairs "
            f"would draw each of them {0.5 / cut.share:.1f} times as often, which changes "
            "the objective",
            figures={**figures, "smaller_share": cut.share},
        )
    grouping = cut.grouping
    return plain.found(shown, figures=figures).changed(
        f"near-far by {grouping.name}",
        {"sampler": "near-far", **settings_of(grouping)},
        "gradients of near and far views differ",
        f"--sampler {plain.choice}",
        f"{probe.rho / (1.0 + probe.rho):.0%} of a step's gradient variance",
    )


def views_of_steps(evidence: Evidence) -> ViewsPerStepSpec:
    """Return the number of views per step after the decision about pairs."""
    planned = "sampler" in pairs(evidence).settings and not evidence.is_given("views_per_step")
    return ViewsPerStepSpec((2,)) if planned else evidence.view_plan


def _draws_pairs(evidence: Evidence) -> bool:
    """Return True if each step has near and far views, by the plan or by the user's sampler."""
    if "sampler" in pairs(evidence).settings:
        return True
    return evidence.sampler.groups == _BOTH and _even(evidence.view_plan)


def _even(views: ViewsPerStepSpec) -> bool:
    return all(count % 2 == 0 for count in views.counts)


def settings_of(grouping: ComponentChoice) -> dict[str, str]:
    """Return the grouping as settings of a run."""
    options = {f"grouping.{name}": str(value) for name, value in grouping.options.items()}
    return {"grouping": grouping.name, **options}


def _without_interval(probe: "Probe") -> str:
    """Return the reason why sigma_b^2 / sigma_w^2 has no interval for a decision."""
    if probe.rho < 0.0 and isnan(probe.rho_low):
        return f"sigma_b^2 / sigma_w^2 {probe.rho:.3f}, 95 % interval none, the estimate is below 0"
    return "no variance"


def views_per_step(evidence: Evidence) -> Finding:
    """Decide the number of views per step."""
    part = "views per step"
    if evidence.is_given("views_per_step"):
        return given(part, evidence.config.views_per_step, "--views K")
    rule = "1, unless pairs are drawn: a second view in a step costs as much as a further step"
    default = str(max(evidence.view_plan.counts))
    plain = Finding(part, default, "default", "", rule, _TWO_VIEWS, "--views K")
    if "sampler" in pairs(evidence).settings:
        return replace(plain, choice="2").found("a step has a near and a far view", decided=True)
    if evidence.is_given("sampler", "operator", "batch_rule", "densify_views", "backward"):
        return plain.found("follows from your settings of sampler, operator and steps")
    probe, figures = evidence.probe, {}
    shown = _TWO_AGAINST_ONE
    if probe is not None and probe.problem:
        shown += f"; the probe is not conclusive: {probe.problem}"
    elif probe is not None and not isnan(probe.noise_scale):
        figures = {"noise_scale": probe.noise_scale}
        finite = isfinite(probe.noise_scale)
        scale = (
            f"{probe.noise_scale:.0f} views" if finite else "larger than all views: no common part"
        )
        shown += f"; gradient noise scale {scale}"
    saved = "extra renders per step"
    return plain.found(shown, decided=True, saved=saved, figures=figures)


def operator(evidence: Evidence) -> Finding:
    """Decide if gradients are stored per view, and how they are combined."""
    part = "operator"
    configured = "+".join(link.name for link in evidence.config.operators)
    if evidence.is_given("operator"):
        return given(part, configured, "--operator NAME")
    rule = (
        "project conflicting gradients if pairs are drawn and the conflict is above "
        f"{CHANCE:.0%} with its interval"
    )
    source = "paper; half of all random directions conflict"
    plain = Finding(part, configured, "default", "", rule, source, "--operator NAME")
    apart = "separate gradients of each view"
    joint = evidence.config.backward == "joint"
    if joint or evidence.modes.one:
        why = "--backward joint: one gradient of all views" if joint else "one mode"
        return plain.found(
            f"{why}: no near and far groups that could conflict", decided=True, saved=apart
        )
    probe = evidence.probe
    if probe is None:
        return plain.found(f"the conflict of near and far gradients is {_NOT_KNOWN}")
    if probe.problem or not isfinite(probe.conflict):
        return plain.found(f"the probe is not conclusive: {probe.problem or 'no pairs'}")
    figures = {"conflict": probe.conflict, "conflict_low": probe.conflict_low}
    shown = f"{probe.conflict:.0%} of near-far pairs conflict, at least {probe.conflict_low:.0%}"
    if probe.conflict_low > CHANCE and _draws_pairs(evidence):
        made = plain.found(shown, figures=figures)
        return made.changed(
            "symmetric",
            {"operator": "symmetric"},
            "gradients of near and far views conflict",
            f"--operator {configured}",
        )
    return plain.found(shown, decided=True, saved=apart, figures=figures)


def _name(camera_modes: Modes) -> str:
    if camera_modes.two:
        return "two modes"
    if not camera_modes.one:
        return "undecided"
    return "one mode, one distance" if camera_modes.spread < LEAST_RATIO else "one mode, continuous"


def _figures(camera_modes: Modes) -> str:
    shown = "undefined" if isnan(camera_modes.bimodality) else f"{camera_modes.bimodality:.2f}"
    cut = camera_modes.cut
    return (
        f"splitting {cut.quantity} in two explains {cut.separability:.0%} of its "
        f"variance, the best of {ONE_OF} even samples {cut.usual:.0%}; far / near "
        f"{cut.ratio:.1f}, smaller side {cut.share:.0%}; bimodality of distances "
        f"{shown}"
    )
