"""Recipes for the paper's experiments: one for each arm of the grids in benchmarks/grids/paper.

A run of 600 views stands for the paper's run of 30,000 steps. Recipe `auto` decides all settings
that an arm does not set.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Final

from crossgrad_plugins.recipes.auto import Auto

#: Settings that are equal in all arms of the experiment.
BASE: Final[Mapping[str, Any]] = {
    "max_views": 1200,
    "data.max_size": 400,
    "exposure": "auto",
    "plan": "off",
    "densifier": "adc",
    "min_refinements": 6,
    "metrics": ["psnr", "ssim", "psnr-cc"],
    "eval_from": 100_000,
}
#: Settings of the arms that render a near and a far view in each step.
PAIRS: Final[Mapping[str, Any]] = {**BASE, "sampler": "near-far", "views_per_step": 2}


class Vanilla30k(Auto):
    """One view per step, as in the paper's baseline of 30,000 steps."""

    settings: ClassVar[Mapping[str, Any]] = {
        **BASE,
        "sampler": "epoch",
        "views_per_step": 1,
        "max_views": 600,
    }


class Vanilla60k(Auto):
    """One view per step, but as many rendered views as the arms with two views per step."""

    settings: ClassVar[Mapping[str, Any]] = {
        **BASE,
        "sampler": "epoch",
        "views_per_step": 1,
        "observers": ["diagnostics"],
    }


class TwoRandomViews(Auto):
    """Two random views per step."""

    settings: ClassVar[Mapping[str, Any]] = {**BASE, "sampler": "random", "views_per_step": 2}


class Balanced(Auto):
    """One view per step, alternately near and far."""

    settings: ClassVar[Mapping[str, Any]] = {
        **BASE,
        "sampler": "near-far",
        "sampler.alternating": True,
        "views_per_step": 1,
    }


class NearFar(Auto):
    """A near and a far view per step, whose gradients are added."""

    settings: ClassVar[Mapping[str, Any]] = PAIRS


class CrossGrad(Auto):
    """A near and a far view per step, combined by the symmetric projection of CrossGrad-GS."""

    settings: ClassVar[Mapping[str, Any]] = {
        **PAIRS,
        "operator": "symmetric",
        "observers": ["diagnostics"],
    }


class CaGrad(Auto):
    """A near and a far view per step, combined by CAGrad."""

    settings: ClassVar[Mapping[str, Any]] = {**PAIRS, "operator": "cagrad"}


class GradNorm(Auto):
    """A near and a far view per step, combined by GradNorm."""

    settings: ClassVar[Mapping[str, Any]] = {**PAIRS, "operator": "gradnorm"}


class ConfGate(Auto):
    """A near and a far view per step, combined by the gate on a conflict's confidence."""

    settings: ClassVar[Mapping[str, Any]] = {**PAIRS, "operator": "confgate"}


class Preconditioner(Auto):
    """A near and a far view per step, combined by the preconditioner."""

    settings: ClassVar[Mapping[str, Any]] = {**PAIRS, "operator": "preconditioner"}
