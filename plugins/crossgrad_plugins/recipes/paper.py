"""Recipes for the paper's experiments, one per arm, as in the grids of benchmarks/grids/paper.

600 views are the 30,000 steps of the paper. Recipe `auto` decides all settings that an arm does not
set.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Final

from crossgrad_plugins.recipes.auto import Auto

#: Settings that all arms of the experiment share.
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
    """One view per step, with as many views as the paper's run of 30,000 steps."""

    settings: ClassVar[Mapping[str, Any]] = {
        **BASE,
        "sampler": "epoch",
        "views_per_step": 1,
        "max_views": 600,
    }


class Vanilla60k(Auto):
    """One view per step, with as many views in total as an arm with two views per step renders."""

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
    """A near and a far view per step, and the symmetric projection of CrossGrad-GS."""

    settings: ClassVar[Mapping[str, Any]] = {
        **PAIRS,
        "operator": "symmetric",
        "observers": ["diagnostics"],
    }


class CaGrad(Auto):
    """A near and a far view per step, and CAGrad."""

    settings: ClassVar[Mapping[str, Any]] = {**PAIRS, "operator": "cagrad"}


class GradNorm(Auto):
    """A near and a far view per step, and GradNorm."""

    settings: ClassVar[Mapping[str, Any]] = {**PAIRS, "operator": "gradnorm"}


class ConfGate(Auto):
    """A near and a far view per step, and the gate that uses the confidence of a conflict."""

    settings: ClassVar[Mapping[str, Any]] = {**PAIRS, "operator": "confgate"}


class Preconditioner(Auto):
    """A near and a far view per step, and the preconditioner."""

    settings: ClassVar[Mapping[str, Any]] = {**PAIRS, "operator": "preconditioner"}
