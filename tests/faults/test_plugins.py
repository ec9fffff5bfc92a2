"""A plugin that raises: one message, the state kept, the same bits once the plugin is repaired."""

import json

import pytest
from crossgrad_faults import laws
from crossgrad_faults.faulty_plugin import HOOKS

#: Asked before anything is written.
EARLY = {"crossgrad_validate_selection", "crossgrad_run_start"}
#: Not called in these runs: they follow no clock, hold nothing back and have no terms.
UNUSED = {"crossgrad_length_changed", "crossgrad_regularize", "crossgrad_log"}


def fails(reference, folder, hook, call, error="RuntimeError"):
    settings = folder.with_suffix(".yaml")
    observer = {"name": "faulty", "hook": hook, "call": call, "error": error}
    settings.write_text(json.dumps({"observers": [observer]}))
    return reference.nursery.run(*reference.command(folder, "--config", str(settings)))


@pytest.mark.sampled(4)
@pytest.mark.parametrize("hook", [name for name in HOOKS if name not in UNUSED])
def test_a_plugin_that_fails_in_any_hook_is_named_and_the_run_can_be_resumed(
    reference, thorough, tmp_path, hook
):
    if thorough < 10 and hook not in {"crossgrad_densify", "crossgrad_evaluation"}:
        pytest.skip("only by `make faults`")
    folder = tmp_path / "run"
    end = fails(reference, folder, hook, call=3 if "run" not in hook else 1)
    if end.code == 0:  # It was called less often.
        end = fails(reference, tmp_path / "again", hook, call=1)
        folder = tmp_path / "again"
    assert end.code in ({1, 2} if hook in EARLY else {1}), end.said
    assert f"put into {hook}" in end.said
    if (folder / "config.yaml").is_file():
        kept(reference, folder, hook)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("error", ["MemoryError", "OSError"])
def test_errors_of_other_types_in_a_plugin_leave_a_run_that_can_be_resumed(
    reference, tmp_path, error
):
    folder = tmp_path / "run"
    end = fails(reference, folder, "crossgrad_aggregate_gradients", 25, error)
    assert end.code == 1, end.said
    kept(reference, folder, "crossgrad_aggregate_gradients")


def kept(reference, folder, hook):
    laws.parses(folder)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["status"] == "failed"
    assert f"put into {hook}" in summary["error"]
    off = {"FAULTY_OFF": "1"}
    end = reference.nursery.run("run", "--resume", str(folder), environment=off)
    assert end.code == 0 or "the run is finished" in end.said, end.said
    laws.same_bits(reference.folder, folder)
