"""Each concept is defined in one module only.

Each row is a pattern of the sources and the files that may hold it; one line of each guard is
enough to see that the concept has been written again elsewhere.
"""

import re

import pytest
from support.imports import ROOT, modules

SOURCES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in modules().values()
}
CORE, KERNELS = "crossgrad_core", "plugins/crossgrad_plugins/rasterizers/numba_kernels"
SCENE = f"{CORE}/contract/scene.py"
#: Base classes of slots, which no cast names: `build` and `load` answer with them.
SLOTS = (
    *("Backbone", "Sampler", "Grouping", "Operator", "Densifier", "Rasterizer", "Loss"),
    *("Exposure", "Resolution", "Reader", "Exporter", "Metric", "Observer"),
)
#: Concept -> pattern, the files that hold it.
HOMES = {
    "near and far by footprint": (r"def footprint", {SCENE}),
    "points in a camera's axes": (
        r"\[:3, :3\]\.T \+ ",
        # Tensors on the run's device, through which the reference is differentiated.
        {
            SCENE,
            "backbones/crossgrad_backbones/baking.py",
            "plugins/crossgrad_plugins/rasterizers/reference/projection.py",
        },
    ),
    "the centre of a camera": (r"-[\w.]+\[:3, :3\]\.T @ ", {SCENE}),
    "training seconds": (r"class (Clock|Seconds)\b", {f"{CORE}/training/state.py"}),
    "how a run ended": (
        r"^Status\b.*=",
        # An attempt of a sweep may also have died.
        {f"{CORE}/run/results/summary.py", "plugins/crossgrad_plugins/sweep/run_status.py"},
    ),
    "published numbers": (r"== \"absolute\" and", {f"{CORE}/contract/schedule.py"}),
    "a calibration": (r"class (Pinhole|Camera)\b", {SCENE}),
    "the rule set of rasterizers": (
        r"^(ALPHA_THRESHOLD|TRANSMITTANCE_STOP|JACOBIAN_MARGIN)\b.*=",
        {f"{CORE}/numerics/raster_constants.py"},
    ),
    "quaternion to matrix": (
        r"2(\.0)? \* \(x \* y - w \* z\)",
        {f"{CORE}/numerics/rotations.py", f"{KERNELS}/ewa.py"},
    ),
    "writing CSV": (r"csv\.(writer|DictWriter)\b", {f"{CORE}/system/text_files.py"}),
    "reading CSV": (r"csv\.(reader|DictReader)\b", {f"{CORE}/system/text_files.py"}),
    "compiled or plain passes": (r"\bnative if .* else generic", {f"{CORE}/gradients/passes.py"}),
    "weights on a diagonal": (r"\[:, :: views \+ 1\]", {f"{CORE}/contract/gramian_operator.py"}),
    "a cast to a slot's type": (rf"cast\(\s*\"(type\[)?({'|'.join(SLOTS)})\b", set()),
    "summed or separate gradients": (
        r"isinstance\([^)]*(Summed|Separate)Gradients",
        {f"{CORE}/contract/contexts.py"},
    ),
    "granularities": (r"^Granularity\b.*=", {f"{CORE}/contract/gradients.py"}),
    "K by its old name": (r"config\.views\b", set()),
    "components by string": (r"selection\.components\[\"", set()),
}


@pytest.mark.parametrize("concept", HOMES)
def test_a_concept_is_defined_in_one_module(concept):
    pattern, homes = HOMES[concept]
    found = {path for path, text in SOURCES.items() if re.search(pattern, text, re.MULTILINE)}
    assert found == homes
