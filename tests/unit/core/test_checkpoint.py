"""Checkpoints: the same bits back, and never half a checkpoint."""

import errno
import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.errors import UserError
from crossgrad_core.run import checkpoint
from crossgrad_core.run import checkpoint as checkpoints
from crossgrad_core.run.checkpoint import (
    Checkpoint,
    Keep,
    digest,
    drop_later,
    latest,
    load,
    load_latest,
    save,
)


def make_checkpoint(step: int = 700, seed: int = 0) -> Checkpoint:
    rng = torch.Generator().manual_seed(seed)
    shared = torch.randn(40, generator=rng)
    parameters = {
        "means": torch.randn(10, 3, generator=rng, requires_grad=True),
        "z first": torch.randn(10, 15, 3, generator=rng).transpose(1, 2),
        "a last": torch.tensor(1.5),
        "empty": torch.zeros(0, 4),
        "double": torch.randn(3, generator=rng, dtype=torch.float64),
        "special": torch.tensor([0.0, -0.0, float("inf"), -float("inf"), float("nan"), 1e-45]),
    }
    generator = np.random.default_rng(seed)
    generator.standard_normal(3)
    return Checkpoint(
        step=step,
        parameters=parameters,
        exp_avg={"means": torch.randn(10, 3, generator=rng)},
        exp_avg_sq={"means": torch.rand(10, 3, generator=rng) * 1e-30},
        adam_steps={"means": 700, "a last": 3},
        plugins={
            "near-far/x": PluginState(
                values={"queue": [3, 1, 2], "ratio": 0.1, "big": 2**80, "none": None, "ok": True},
                tensors={"order": torch.arange(5), "view": shared[::2], "head": shared[:10]},
                per_primitive={"seen": torch.arange(10) % 2 == 0, "half": torch.ones(10).half()},
            ),
            "empty": PluginState(),
        },
        generators={"sampler": generator.bit_generator.state},
        scalars={"train_seconds": 38.123456789012345, "views": 1400, "best": float("nan")},
    )


def bits(tensor: Tensor) -> bytes:
    return tensor.detach().contiguous().numpy().tobytes()


def assert_tensors_equal(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    assert list(found) == list(expected)
    for name, tensor in expected.items():
        assert found[name].dtype == tensor.dtype, name
        assert found[name].shape == tensor.shape, name
        assert bits(found[name]) == bits(tensor), name


def test_a_checkpoint_keeps_every_bit(tmp_path: Path):
    before = make_checkpoint()
    folder = save(tmp_path, before)
    assert folder == tmp_path / "checkpoints" / "step-000700"
    assert sorted(path.name for path in folder.iterdir()) == ["state.json", "tensors.safetensors"]
    after = load(folder)
    for kind in ("parameters", "exp_avg", "exp_avg_sq"):
        assert_tensors_equal(getattr(after, kind), getattr(before, kind))
    assert list(after.plugins) == list(before.plugins)
    for name, state in before.plugins.items():
        assert after.plugins[name].values == state.values
        assert_tensors_equal(after.plugins[name].tensors, state.tensors)
        assert_tensors_equal(after.plugins[name].per_primitive, state.per_primitive)
    assert after.step == before.step
    assert after.adam_steps == before.adam_steps
    assert repr(after.scalars) == repr(before.scalars)


def test_restored_generators_continue_with_the_same_numbers(tmp_path: Path):
    generator = np.random.default_rng(5)
    generator.integers(0, 10, size=7)  # leaves half a word in the generator's buffer
    saved = replace(make_checkpoint(), generators={"g": generator.bit_generator.state})
    restored = np.random.default_rng(0)
    restored.bit_generator.state = load(save(tmp_path, saved)).generators["g"]
    draws = generator.integers(0, 1000, size=50), generator.standard_normal(50)
    assert np.array_equal(draws[0], restored.integers(0, 1000, size=50))
    assert np.array_equal(draws[1], restored.standard_normal(50))


def test_loaded_tensors_share_no_memory_with_the_file_or_each_other(tmp_path: Path):
    folder = save(tmp_path, make_checkpoint())
    after = load(folder)
    expected = after.plugins["near-far/x"].tensors["head"].clone()
    after.plugins["near-far/x"].tensors["view"].zero_()
    (folder / "tensors.safetensors").write_bytes(b"")
    assert torch.equal(after.plugins["near-far/x"].tensors["head"], expected)


def steps_in(run: Path) -> list[int]:
    return sorted(int(path.name[5:]) for path in (run / "checkpoints").iterdir())


@pytest.mark.parametrize(
    ("keep", "expected"),
    [(Keep(), [400, 500]), (Keep(last=1), [500]), (Keep(last=2, every=200), [200, 400, 500])],
)
def test_saving_keeps_the_last_checkpoints_and_the_milestones(
    tmp_path: Path, keep: Keep, expected: list[int]
):
    for step in range(100, 600, 100):
        save(tmp_path, make_checkpoint(step), keep)
    assert steps_in(tmp_path) == expected


def test_latest_accepts_a_run_folder_or_a_checkpoint(tmp_path: Path):
    older = save(tmp_path, make_checkpoint(900))
    newer = save(tmp_path, make_checkpoint(1_000_000))
    assert latest(tmp_path) == newer
    assert latest(tmp_path / "checkpoints") == newer
    assert latest(older) == older


def test_latest_skips_incomplete_checkpoints(tmp_path: Path):
    good = save(tmp_path, make_checkpoint(100))
    (tmp_path / "checkpoints" / "step-000300").write_text("")
    broken = tmp_path / "checkpoints" / ".scratch-step-000400"
    broken.mkdir()
    (broken / "state.json").write_text("{}")
    (broken / "tensors.safetensors").write_bytes(b"")
    assert latest(tmp_path) == good


@pytest.mark.parametrize("name", ["state.json", "tensors.safetensors"])
def test_a_checkpoint_that_lost_a_file_is_reported_as_damaged(tmp_path: Path, name: str):
    save(tmp_path, make_checkpoint(100))
    (save(tmp_path, make_checkpoint(200)) / name).unlink()
    with pytest.raises(UserError, match="the checkpoint is damaged") as told:
        load_latest(tmp_path)
    assert told.value.found == f"no {name}" and "continues from step-000100" in told.value.todo


@pytest.mark.parametrize("name", ["", "nowhere", "checkpoints"])
def test_a_missing_checkpoint_is_refused_with_a_remedy(tmp_path: Path, name: str):
    with pytest.raises(UserError, match="no checkpoint to resume from"):
        latest(tmp_path / name)


def test_a_ply_file_is_not_accepted_as_a_checkpoint(tmp_path: Path):
    with pytest.raises(UserError, match="no optimizer state") as told:
        latest(tmp_path / "point_cloud.ply")
    assert "--init" in str(told.value)


def test_resuming_an_earlier_step_deletes_later_checkpoints(tmp_path: Path):
    for step in (100, 200, 300):
        save(tmp_path, make_checkpoint(step), Keep(last=9))
    drop_later(tmp_path, 200)
    assert steps_in(tmp_path) == [100, 200]


def full_disk(path: Path, _packed: dict[str, Tensor]) -> None:
    path.write_bytes(b"half")
    raise OSError(errno.ENOSPC, "No space left on device")


def crash(path: Path, _packed: dict[str, Tensor]) -> None:
    path.write_bytes(b"half")
    raise KeyboardInterrupt


@pytest.mark.parametrize("step", [100, 200])
@pytest.mark.parametrize(("failure", "error"), [(full_disk, UserError), (crash, KeyboardInterrupt)])
def test_a_failed_save_keeps_the_earlier_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int, failure, error
):
    before = make_checkpoint(100, seed=1)
    save(tmp_path, before)
    monkeypatch.setattr("crossgrad_core.run.checkpoint.write_tensors", failure)
    with pytest.raises(error):
        save(tmp_path, make_checkpoint(step, seed=2))
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["step-000100"]
    after = load(latest(tmp_path))
    assert_tensors_equal(after.parameters, before.parameters)


def test_a_full_disk_is_reported_with_the_required_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("crossgrad_core.run.checkpoint.write_tensors", full_disk)
    big = replace(make_checkpoint(), parameters={"means": torch.zeros(3 * 2**18)})
    with pytest.raises(UserError, match=r"expected: 3\.0 MiB free"):
        save(tmp_path, big)


@pytest.mark.parametrize(
    ("keep", "left"), [(Keep(), [200, 300]), (Keep(every=100), [100, 200]), (Keep(3), [100, 200])]
)
def test_on_a_full_disk_an_old_checkpoint_is_deleted_before_the_save(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keep: Keep, left: list[int]
):
    for step in (100, 200):
        save(tmp_path, make_checkpoint(step), keep)
    write = checkpoints.write_tensors

    def with_room_for_two(path: Path, packed: dict[str, Tensor]) -> None:
        if len(list(path.parents[1].glob("step-*"))) > 1:
            full_disk(path, packed)
        write(path, packed)

    monkeypatch.setattr("crossgrad_core.run.checkpoint.write_tensors", with_room_for_two)
    with nullcontext() if 300 in left else pytest.raises(UserError, match="not enough disk space"):
        save(tmp_path, make_checkpoint(300), keep)
    assert steps_in(tmp_path) == left


def test_a_reader_loads_the_newer_checkpoint_if_the_older_is_deleted_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    save(tmp_path, make_checkpoint(100))
    read_state = checkpoint.read_state

    def slowly(folder: Path) -> dict[str, object]:
        if folder.name == "step-000100":
            save(tmp_path, make_checkpoint(200), Keep(last=1))
        return read_state(folder)

    monkeypatch.setattr(checkpoint, "read_state", slowly)
    assert load_latest(tmp_path).step == 200


def test_loading_a_damaged_checkpoint_raises_without_a_retry(tmp_path: Path):
    flip_byte(save(tmp_path, make_checkpoint(100)))
    with pytest.raises(UserError, match="SHA-256 differs"):
        load_latest(tmp_path)


def test_the_library_reports_a_full_disk_as_an_os_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    import safetensors.torch

    def fail(_packed: dict[str, Tensor], _path: Path) -> None:
        message = "Error while serializing: I/O error: No space left on device (os error 28)"
        raise safetensors.SafetensorError(message)

    monkeypatch.setattr(safetensors.torch, "save_file", fail)
    with pytest.raises(OSError, match="No space left") as told:
        checkpoints.write_tensors(tmp_path / "t", {})
    assert told.value.errno == errno.ENOSPC


def test_a_failed_rename_restores_the_old_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    before = make_checkpoint(100, seed=1)
    save(tmp_path, before)
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if self.name == ".scratch-step-000100":
            raise OSError(errno.EIO, "input/output error")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(OSError, match="input/output"):
        save(tmp_path, make_checkpoint(100, seed=2))
    assert_tensors_equal(load(latest(tmp_path)).parameters, before.parameters)


def test_temporary_files_of_a_killed_run_are_deleted(tmp_path: Path):
    leftover = tmp_path / "checkpoints" / ".scratch-step-000050"
    leftover.mkdir(parents=True)
    (leftover / "tensors.safetensors").write_bytes(b"half")
    save(tmp_path, make_checkpoint(100))
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["step-000100"]


def flip_byte(folder: Path) -> None:
    path = folder / "tensors.safetensors"
    raw = bytearray(path.read_bytes())
    raw[-5] ^= 1
    path.write_bytes(raw)


def cut(folder: Path) -> None:
    path = folder / "tensors.safetensors"
    path.write_bytes(path.read_bytes()[:-100])


def change_state(**changes: object):
    """Another state with a digest that is right."""

    def damage(folder: Path) -> None:
        path = folder / "state.json"
        state = {**json.loads(path.read_text()), **changes}
        path.write_text(json.dumps({**state, "state_sha256": digest(state)}))

    return damage


def replace_in_state(old: str, new: str):
    def damage(folder: Path) -> None:
        path = folder / "state.json"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))

    return damage


DAMAGES = {
    "flipped bit": (flip_byte, "SHA-256 differs"),
    "cut short": (cut, "SHA-256 differs"),
    "no tensors": (lambda folder: (folder / "tensors.safetensors").unlink(), "no tensors"),
    "no state": (lambda folder: (folder / "state.json").unlink(), "no state.json"),
    "half a state": (
        lambda folder: (folder / "state.json").write_text('{"format'),
        "not valid JSON",
    ),
    "other JSON": (
        lambda folder: (folder / "state.json").write_text("[1]"),
        "does not contain the state",
    ),
    "missing tensor": (change_state(tensors=["parameters/gone"]), "gone"),
    "unknown plugins": (change_state(plugins=3), "valid plugins"),
    "no step": (change_state(step=None), "valid step"),
    "negative step": (change_state(step=-1), "valid step"),
    "true steps": (change_state(adam_steps={"means": True}), "valid adam_steps"),
    "tensors by number": (change_state(tensors=[3]), "valid tensors"),
    "unknown kind": (change_state(tensors=["plugin/a/b/c"]), "plugin/a/b/c"),
    "endless JSON": (
        lambda folder: (folder / "state.json").write_text("[" * 100_000),
        "nested too deeply",
    ),
    "no digest": (replace_in_state('"state_sha256"', '"sha"'), "SHA-256 differs"),
    "another number": (replace_in_state('"views": 1400', '"views": 1401'), "SHA-256 differs"),
    "another random number": (replace_in_state('"inc": 8', '"inc": 7'), "SHA-256 differs"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_reported_and_the_earlier_checkpoint_is_named(tmp_path: Path, name: str):
    damage, message = DAMAGES[name]
    older = save(tmp_path, make_checkpoint(100))
    newer = save(tmp_path, make_checkpoint(200))
    damage(newer)
    with pytest.raises(UserError, match=message) as told:
        load(newer)
    assert f"remove this folder; the run then continues from {older.name}" in str(told.value)


def test_another_format_version_is_refused(tmp_path: Path):
    folder = save(tmp_path, make_checkpoint())
    change_state(format=99, crossgrad="7.0")(folder)
    with pytest.raises(UserError, match=r"another format version(.|\n)*version 99 \(crossgrad 7.0"):
        load(folder)


def test_loading_a_missing_checkpoint_is_refused(tmp_path: Path):
    with pytest.raises(UserError, match="the checkpoint does not exist"):
        load(tmp_path / "step-000001")


@pytest.mark.parametrize(
    "value", [{1: 2}, (1, 2), np.int64(3), torch.ones(2), {"deep": [{"set": {1}}]}]
)
def test_plugin_state_that_json_would_change_is_refused(tmp_path: Path, value: object):
    bad = replace(make_checkpoint(), plugins={"mine": PluginState({"key": value})})
    with pytest.raises(UserError, match="plugin mine"):
        save(tmp_path, bad)
    assert not (tmp_path / "checkpoints").exists()
