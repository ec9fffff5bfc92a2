"""Exporters of another frame or in place, and bakes of another picture, are refused for it."""

from dataclasses import replace
from typing import ClassVar
from unittest import SkipTest

import pytest

from crossgrad_core import plugin as api
from crossgrad_core.registry.entries import load
from crossgrad_core.testing import backbones, exporters
from crossgrad_core.testing.support.contract import ContractError

Vanilla = load("backbones", "vanilla")
Ply = load("exporters", "ply")


class Centres(api.Exporter):
    """The centres in the input frame, written at once."""

    suffix: ClassVar[str] = "raw"

    def numbers(self, gaussians, similarity):
        return similarity.to_input(gaussians.means.double().numpy())

    def write(self, content, path):
        with api.atomic_file(path) as file:
            file.write(self.numbers(content.gaussians, content.similarity).tobytes())
        return ()


class LocalFrame(Centres):
    def numbers(self, gaussians, similarity):
        return gaussians.means.double().numpy()


class OffsetAlone(Centres):
    def numbers(self, gaussians, similarity):
        return gaussians.means.double().numpy() + similarity.offset


class InPlace(Centres):
    def write(self, content, path):
        path.write_bytes(self.numbers(content.gaussians, content.similarity).tobytes())
        return ()


class ReadsTheInputFrame(Ply):
    def read(self, path, similarity):
        found = super().read(path, similarity)
        return replace(found, means=found.means / similarity.scale)


class Fainter(Vanilla):
    plain: ClassVar[bool] = True

    def bake(self, parameters, phase, cameras):
        baked = super().bake(parameters, phase, cameras)
        return replace(baked, opacities=0.9 * baked.opacities)


class OneBand(Fainter):
    def bake(self, parameters, phase, cameras):
        baked = Vanilla.bake(self, parameters, phase, cameras)
        return replace(baked, sh_rest=None, sh_degree=0, scales=1.1 * baked.scales)


@pytest.mark.parametrize(
    ("check", "make", "words"),
    [
        (exporters.writes_the_input_frame, LocalFrame, "another offset"),
        (exporters.writes_the_input_frame, OffsetAlone, "another scale"),
        (exporters.appears_at_once, InPlace, "in place"),
        (exporters.what_it_writes_is_read_again, ReadsTheInputFrame, "returns means"),
        (backbones.plain_ones_bake_what_they_draw, Fainter, "plain is True"),
        (backbones.plain_ones_bake_what_they_draw, OneBand, "plain is True"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_a_wrong_component_is_refused_with_the_right_reason(check, make, words):
    with pytest.raises(ContractError, match=words):
        check(make)


@pytest.mark.parametrize("check", exporters.EXPORTER_CHECKS, ids=lambda check: check.__name__)
def test_a_correct_component_passes(check):
    try:
        check(Centres)
    except SkipTest:
        assert check is exporters.what_it_writes_is_read_again
