"""Photos that rot or vanish while a run trains: it ends well, or says which and goes on later."""

import random
import shutil
from dataclasses import replace

import pytest
from crossgrad_faults import laws


@pytest.mark.sampled(1)
@pytest.mark.parametrize("what", ["rot", "vanish"])
def test_a_run_whose_photo_is_lost_names_the_photo_and_can_be_resumed(
    reference, thorough, tmp_path, what
):
    scene = tmp_path / "scene"
    shutil.copytree(reference.scene, scene)
    here = replace(reference, scene=scene)
    photos = sorted((scene / "images").iterdir())
    draw = random.Random(6)
    for number in range(max(1, thorough // 20)):
        folder, photo = tmp_path / str(number), draw.choice(photos)
        whole = photo.read_bytes()
        at = draw.randrange(1, reference.writes)
        fault = {"below": str(folder), "at": at, "what": what, "file": str(photo)}
        end = here.nursery.run(*here.command(folder), fault=fault)
        assert end.code in {0, 1, 2}, end.said
        if end.code:
            assert photo.name in end.said, end.said
            assert "Traceback" not in end.said
        laws.parses(folder)
        photo.write_bytes(whole)
        here.recovers(folder)
