"""Observers tensorboard and wandb: tags, images, configuration; their failures end no run."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from crossgrad_core.contract.contexts import EvaluationReport, StepRecord
from crossgrad_core.registry.manager import make_manager
from crossgrad_plugins.observers import tracker
from crossgrad_plugins.observers.tensorboard import TensorBoard
from crossgrad_plugins.observers.wandb import WandB

ROW = {"step": 40, "psnr": 21.5, "psnr_far": 20.0, "lpips": None, "primitives": 900, "loss": 0.2,
       "peak_memory_mib": 512.0}  # fmt: skip


def view(name: str) -> SimpleNamespace:
    photo = torch.zeros((4, 6, 3), dtype=torch.uint8)
    return SimpleNamespace(name=name, photo=SimpleNamespace(image=lambda: photo))


def run_with(observer, folder, render=lambda view: torch.ones((4, 6, 3))) -> None:
    hook = make_manager({"observer": observer}).hook
    scene = SimpleNamespace(test_views=tuple(view(f"{i}.jpg") for i in range(3)))
    run = SimpleNamespace(folder=folder, scene=scene, config={"steps": 40, "backbone": "mip"})
    hook.crossgrad_run_start(run=run)
    for step in range(1, 41):
        hook.crossgrad_step_end(
            record=StepRecord(step, (0,), ("a",), None, (0.5, 0.25), 800 + step, {}, 0.1 * step)
        )
    report = EvaluationReport(40, ROW, ("far",), render)
    hook.crossgrad_evaluation(report=report)
    hook.crossgrad_run_end(status="finished")


def test_the_event_file_has_the_tags_of_gsplat(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run_with(TensorBoard(every=20), tmp_path)
    events = EventAccumulator(str(tmp_path / "tb")).Reload()
    tags = events.Tags()
    assert set(tags["scalars"]) == {
        *("train/loss", "train/num_GS", "train/mem", "val/psnr", "val/psnr_far", "val/num_GS")
    }
    losses = events.Scalars("train/loss")
    assert [each.step for each in losses] == [1, 20, 40]
    assert losses[0].value == pytest.approx(0.375)
    assert events.Scalars("train/num_GS")[-1].value == 840
    assert events.Scalars("val/psnr")[0].value == 21.5
    assert events.Scalars("train/mem")[0].value == 0.5
    assert tags["images"] == ["val/0.jpg", "val/1.jpg"]
    (image,) = events.Images("val/0.jpg")
    assert (image.step, image.width, image.height) == (40, 12, 4)
    (text,) = events.Tensors("config/text_summary")
    assert b'"backbone": "mip"' in text.tensor_proto.string_val[0]


class FakeWandb:
    """The parts of the package that the observer uses."""

    def __init__(self, broken: bool = False):
        self.logged, self.started, self.ended, self.broken = [], {}, None, broken

    def init(self, **options):
        self.started = options
        return self

    def log(self, values, step):
        if self.broken:
            raise ConnectionError("no\nnetwork")
        self.logged.append((step, values))

    def finish(self, exit_code):
        self.ended = exit_code

    Image = staticmethod(np.asarray)


@pytest.fixture
def fake(monkeypatch):
    package = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", package)
    monkeypatch.setattr(tracker, "find_spec", lambda name: True)
    return package


def test_wandb_gets_the_same_numbers_images_and_configuration(fake, tmp_path):
    run_with(WandB(mode="offline", images=1), tmp_path)
    assert fake.started["mode"] == "offline" and fake.started["dir"] == tmp_path
    assert fake.started["config"] == {"steps": 40, "backbone": "mip"}
    assert fake.logged[0] == (1, {"train/loss": 0.375, "train/num_GS": 801.0})
    step, numbers = fake.logged[1]
    assert (step, numbers["val/psnr"], numbers["val/num_GS"]) == (40, 21.5, 900.0)
    (image,) = fake.logged[2][1].values()
    assert image.shape == (4, 12, 3) and image[:, 6:].min() == 255 and image[:, :6].max() == 0
    assert len(fake.logged) == 3 and fake.ended == 0


def test_a_failure_is_reported_once_and_ends_no_run(fake, tmp_path, caplog):
    fake.broken = True
    run_with(WandB(every=1), tmp_path)
    (warning,) = caplog.messages
    assert warning == "observer wandb records nothing more: ConnectionError: no network"


def test_a_run_without_a_folder_sends_nothing(fake):
    run_with(WandB(), None)
    assert fake.started == {} and fake.logged == []


def test_a_missing_package_refuses_the_run_and_names_the_extra(monkeypatch):
    monkeypatch.setattr(tracker, "find_spec", lambda name: None)
    (reason,) = WandB().crossgrad_validate_selection(None)
    assert "pip install 'crossgrad[wandb]'" in reason
    monkeypatch.setattr(tracker, "find_spec", lambda name: True)
    assert WandB().crossgrad_validate_selection(None) is None
