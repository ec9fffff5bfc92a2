"""Names that standard terms have replaced do not come back in code, settings, messages or docs."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
#: Withdrawn name -> the standard term.
WITHDRAWN = {
    "is_short": "planned views",
    "in_a_hurry": "few passes over the photos",
    "hurried": "few passes over the photos",
    "hurried_rates": "few_pass_rates",
    "counts_as_short": "planned views",
    "shelves": "buckets",
    "foresight": "prefetcher",
    "keeper": "rollback guard",
    "veils": "scale clamp",
    "stand_ins": "missing plugins",
    "settings_for_nothing": "unused settings",
    "last_words": "exit messages",
    "crossgrad_objections": "crossgrad_validate_selection",
    "crossgrad_length": "crossgrad_length_changed",
    "crossgrad_message": "crossgrad_log",
    "max_dropped": "max_nonfinite_blocks",
    "fewest_edits": "min_refinements",
    "sh_after": "sh_start",
    "final_decay": "rule lr-tail",
    "density_views": "densify_views",
    "passed_on": "passthrough",
    "own_dilation": "dilation",
    "burn_in": "self_test",
    "idle_options": "unused_options",
    "idle_at_one": "is_identity",
    "does_nothing": "is_identity",
    "wants_more": "needs_more_views",
    "eight_bit": "to_uint8",
    "writability": "check_writable",
    "way_on": "resume_hint",
    "listened_to": "signal_names",
    "of_a_run": "run_options",
    "marked_counts": "error_pixel_counts",
    "axis_split": "long_axis_split",
    "second_look": "refine_poses",
    "soundness": "model_checks",
    "vaccinate": "align",
    "max_scale_ratio": "rule scale-clamp",
    "lr_tail_factor": "rule lr-tail",
    "usual_views": "default_views",
    "usual_grouping": "default_grouping",
    "usual_growth": "default_growth",
    "usual_device": "default_device",
}
FILES = sorted(
    path
    for pattern in (
        "**/*.py",
        "docs/**/*.md",
        "README.md",
        "CONTRIBUTING.md",
        "benchmarks/**/*.yaml",
    )
    for path in ROOT.glob(pattern)
    if path != Path(__file__) and not any(part.startswith(".") for part in path.parts)
)
TEXTS = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in FILES}


@pytest.mark.parametrize("name", WITHDRAWN)
def test_a_withdrawn_name_is_not_used(name):
    # To look for a word takes ten times as long as to look for letters.
    there = [path for path, text in TEXTS.items() if name in text]
    used = [path for path in there if re.search(rf"\b{name}\b", TEXTS[path])]
    assert not used, f"write {WITHDRAWN[name]} instead of {name}"
