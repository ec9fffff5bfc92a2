"""Each contract check fails for a component that breaks what it checks: checks times defects."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import ClassVar
from unittest import SkipTest

import numpy as np
import pytest
import torch
from pydantic import ConfigDict, field_serializer

from crossgrad_core import plugin as api
from crossgrad_core.registry.entries import load
from crossgrad_core.testing import (
    backbones,
    densifiers,
    exporters,
    exposures,
    groupings,
    initializers,
    metrics,
    observers,
    operators,
    rasterizers,
    readers,
    samplers,
)
from crossgrad_core.testing.support import aggregation, components, reference
from crossgrad_core.testing.support.contract import ContractError

Vanilla = load("backbones", "vanilla")
Torch = load("rasterizers", "torch")
Radial = load("groupings", "radial")
NoDensification = load("densifiers", "none")
NoExposure = load("exposures", "none")
Ply = load("exporters", "ply")
PSNR = load("metrics", "psnr")


class Adding(api.GramianOperator):
    """The plain sum, by way of Gramians: every defect is a small change of it."""

    def weights(self, gramians, context, rng):
        return np.where(context.present, 1.0, 0.0)

    def transform(self, gramians, context, state, rng):
        return self.weights(gramians, context, rng)[:, None, :], state


class OneBlockTooFew(Adding):
    def transform(self, gramians, context, state, rng):
        matrices, state = super().transform(gramians, context, state, rng)
        return matrices[:-1], state


class SinglePrecision(Adding):
    def weights(self, gramians, context, rng):
        return super().weights(gramians, context, rng).astype(np.float32)


class DividesByZero(Adding):
    def weights(self, gramians, context, rng):
        with np.errstate(all="ignore"):
            return 1.0 / np.sqrt(np.einsum("bkk->bk", gramians))


class LooksAtOtherBlocks(Adding):
    def weights(self, gramians, context, rng):
        return super().weights(gramians, context, rng) * len(gramians)


class ChangesGramians(Adding):
    def weights(self, gramians, context, rng):
        gramians *= 2.0
        return super().weights(gramians, context, rng)


class ChangesLosses(Adding):
    def weights(self, gramians, context, rng):
        context.losses[:] = 0.0
        return super().weights(gramians, context, rng)


class GlobalRandomness(Adding):
    def weights(self, gramians, context, rng):
        return super().weights(gramians, context, rng) * torch.rand(1).item()


class HiddenCounter(Adding):
    calls: ClassVar[dict[str, int]] = {}

    def weights(self, gramians, context, rng):
        self.calls["n"] = self.calls.get("n", 0) + 1
        return super().weights(gramians, context, rng) * self.calls["n"]


class TextKeys(Adding):
    def transform(self, gramians, context, state, rng):
        matrices, _ = super().transform(gramians, context, state, rng)
        return matrices, api.PluginState({1: 2.0})


class Reverses(Adding):
    def weights(self, gramians, context, rng):
        return -super().weights(gramians, context, rng)


class AbsoluteThreshold(Adding):
    def weights(self, gramians, context, rng):
        longer = np.einsum("bkk->bk", gramians) > 20.0
        return np.where(context.present, np.where(longer, 1.0, 0.5), 0.0)


class FarViewsCountTwice(Adding):
    def weights(self, gramians, context, rng):
        far = np.array([label == "far" for label in context.labels])
        return super().weights(gramians, context, rng) * np.where(far, 2.0, 1.0)


class SaysItReadsNoGramians(Adding):
    def reads_gramians(self):
        return False

    def weights(self, gramians, context, rng):
        squares = np.einsum("bkk->bk", gramians)
        return np.where(squares >= squares.max(axis=1, keepdims=True), 1.0, 0.5)


class ForgetsATensor(Adding):
    def aggregate(self, context, state):
        aggregated, state = super().aggregate(context, state)
        gradients = {name: g for name, g in aggregated.gradients.items() if name != "means"}
        return replace(aggregated, gradients=gradients), state


class CountsViewsThatAreNotThere(Adding):
    def aggregate(self, context, state):
        aggregated, state = super().aggregate(context, state)
        share = 1.0 / context.gradients.finite("block").sum()
        gradients = {n: None if g is None else g * share for n, g in aggregated.gradients.items()}
        return replace(aggregated, gradients=gradients), state


class ChangesGradients(Adding):
    def aggregate(self, context, state):
        context.gradients.elementwise(double)
        return super().aggregate(context, state)


def double(_, gradients):
    for gradient in gradients:
        if gradient is not None:
            gradient.mul_(2.0)


class InTurn(api.Sampler):
    """K views by position, one after the other."""

    default_views = 2

    def sample(self, context, state):
        start = state.values.get("start", 0)
        number = len(context.scene.train)
        views = tuple((start + k) % number for k in range(context.views_per_step))
        groups = context.groups
        labels = None if groups is None else tuple(groups[view] for view in views)
        return api.ViewSample(views, labels), api.PluginState(
            {"start": start + context.views_per_step}
        )


class UsualViewsRefused(InTurn):
    views = api.ViewCounts(4, 4)


class OneViewTooFew(InTurn):
    def sample(self, context, state):
        draw, state = super().sample(context, state)
        return api.ViewSample(draw.views[1:]), state


class NumpyPositions(InTurn):
    def sample(self, context, state):
        draw, state = super().sample(context, state)
        return api.ViewSample(tuple(np.array(draw.views))), state


class BeyondTheEnd(InTurn):
    def sample(self, context, state):
        draw, state = super().sample(context, state)
        return api.ViewSample(tuple(view + 1 for view in draw.views)), state


class NeverTheFirst(InTurn):
    def sample(self, context, state):
        draw, state = super().sample(context, state)
        return api.ViewSample(tuple(view or 1 for view in draw.views)), state


class GlobalDraws(InTurn):
    def sample(self, context, state):
        number = len(context.scene.train)
        views = np.random.randint(number, size=context.views_per_step)  # noqa: NPY002
        return api.ViewSample(tuple(int(view) for view in views)), state


class RemembersOnItself(InTurn):
    seen: ClassVar[list[int]] = []

    def sample(self, context, state):
        self.seen.append(1)
        number = len(context.scene.train)
        return api.ViewSample((len(self.seen) % number,) * context.views_per_step), state


class ChangesItsState(InTurn):
    def sample(self, context, state):
        state.values.setdefault("steps", []).append(context.step)
        return super().sample(context, state)[0], state


class ForeignLabel(Radial):
    def fit(self, scene, rng, probe=None):
        return api.GroupingRule(lambda views: ("close",) * len(views))


class OneLabelForAll(Radial):
    def fit(self, scene, rng, probe=None):
        return api.GroupingRule(lambda views: ("near",))


class EmptyGroup(Radial):
    def fit(self, scene, rng, probe=None):
        return api.GroupingRule(lambda views: ("near",) * len(views))


class MeasuresRanks(Radial):
    def quantity(self, scene, views):
        found = super().quantity(scene, views)
        return api.Quantity(found.name, found.values.argsort().argsort().astype(float))


class FittedOnWhatIsAsked(Radial):
    def fit(self, scene, rng, probe=None):
        def labels(views):
            far = (len(views) + 1) // 2
            return ("far",) * far + ("near",) * (len(views) - far)

        return api.GroupingRule(labels)


class GlobalLabels(Radial):
    def fit(self, scene, rng, probe=None):
        torch.rand(1)
        return super().fit(scene, rng, probe)


class FlatImage(Torch):
    def render(self, gaussians, camera, background, outputs=frozenset()):
        render = super().render(gaussians, camera, background, outputs)
        return replace(render, image=render.image.mean(dim=-1))


class ForgetsTheBackground(Torch):
    def render(self, gaussians, camera, background, outputs=frozenset()):
        return super().render(gaussians, camera, torch.zeros_like(background), outputs)


class FastEverywhere(Torch):
    devices = frozenset({"cpu"})

    def speed(self, device):
        return 10.0


class NeedsGaussians(Torch):
    def render(self, gaussians, camera, background, outputs=frozenset()):
        if len(gaussians) == 0:
            raise IndexError("nothing to draw")
        return super().render(gaussians, camera, background, outputs)


class FrozenOpacities(Torch):
    def render(self, gaussians, camera, background, outputs=frozenset()):
        frozen = replace(gaussians, opacities=gaussians.opacities.detach())
        return super().render(frozen, camera, background, outputs)


class NoStatistics(Torch):
    def render(self, gaussians, camera, background, outputs=frozenset()):
        render = super().render(gaussians, camera, background, outputs)
        return replace(render, screen=api.Screen(torch.zeros_like(render.screen.radii)))


class Flickers(Torch):
    def render(self, gaussians, camera, background, outputs=frozenset()):
        render = super().render(gaussians, camera, background, outputs)
        return replace(render, image=render.image + 1e-6 * torch.rand(1))


class AsksForNoRows(Torch):
    sparse_rows: ClassVar[bool] = True


class LessOpaque(Torch):
    def render(self, gaussians, camera, background, outputs=frozenset()):
        thinner = replace(gaussians, opacities=0.9 * gaussians.opacities)
        return super().render(thinner, camera, background, outputs)


class OneDilation(Torch):
    def render(self, gaussians, camera, background, outputs=frozenset()):
        return super().render(replace(gaussians, dilation=None), camera, background, outputs)


class LooseTensor(Vanilla):
    def blocks(self):
        return super().blocks()[:-1]


class GlobalStart(Vanilla):
    def create(self, scene, rng):
        parameters = super().create(scene, rng)
        noise = torch.randn_like(parameters["quats"])
        return parameters | {"quats": noise.requires_grad_()}


class NegativeScales(Vanilla):
    def decode(self, parameters, camera, phase):
        return replace(super().decode(parameters, camera, phase), scales=-parameters["means"].abs())


class GreyColors(Vanilla):
    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        grey = gaussians.sh_dc[:, 0, :1]
        return replace(gaussians, colors=grey, sh_dc=None, sh_rest=None, sh_degree=0)


class FewerColors(GreyColors):
    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        return replace(gaussians, colors=gaussians.colors.expand(-1, 3)[1:])


class FlatBandZero(Vanilla):
    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        return replace(gaussians, sh_dc=gaussians.sh_dc[:, 0])


class TooFewBands(Vanilla):
    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        return replace(gaussians, sh_rest=gaussians.sh_dc.expand(-1, 3, -1), sh_degree=3)


class OddBands(Vanilla):
    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        return replace(gaussians, sh_rest=gaussians.sh_dc.expand(-1, 5, -1), sh_degree=1)


class TwoTypes(Vanilla):
    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        return replace(gaussians, sh_dc=gaussians.sh_dc.double())


class ShortSlots(Vanilla):
    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        return replace(gaussians, slot=torch.zeros(len(gaussians) - 1, dtype=torch.int64))


class CountsDecoded(Vanilla):
    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        return replace(gaussians, decoded=torch.arange(len(gaussians)))


class Trembles(Vanilla):
    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        noise = 1e-3 * torch.rand_like(gaussians.means) if phase.training else 0.0
        return replace(gaussians, means=gaussians.means + noise)


class BrightensAtRandom(Vanilla):
    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        chance = float(np.random.default_rng().random())
        return replace(gaussians, sh_dc=gaussians.sh_dc + chance)


class AxesOfOneLength(Vanilla):
    """Names as sizes what has other columns."""

    axes = ("opacities", "quats")


class AxesNowhere(Vanilla):
    """Has axes, and no positions that they belong to."""

    positions = ""
    axes = ("scales", "quats")


class PositionsNowhere(Vanilla):
    positions: ClassVar[str] = "centres"


class PositionsOfFourColumns(Vanilla):
    positions: ClassVar[str] = "quats"


class PositionsOfAll(Vanilla):
    positions: ClassVar[str] = "middle"

    def create(self, scene, rng):
        return super().create(scene, rng) | {"middle": torch.zeros(1, 3)}

    def blocks(self):
        middle = api.Block("middle", ("middle",), False, "neutral", api.LearningRate(0.0))
        return (*super().blocks(), middle)


class DensifierNowhere(Vanilla):
    default_densifier: ClassVar[str] = "adx"


class DensifierOfAnchors(Vanilla):
    default_densifier: ClassVar[str] = "anchor"


class FrozenQuats(Vanilla):
    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        return replace(gaussians, quats=gaussians.quats.detach())


class CountsOnItself(Vanilla):
    calls: ClassVar[list[int]] = []

    def decode(self, parameters, camera, phase):
        self.calls.append(1)
        gaussians = super().decode(parameters, camera, phase)
        return replace(gaussians, means=gaussians.means + len(self.calls))


class SortsRows(Vanilla):
    def prepare(self, parameters, scene, phase):
        order = parameters["means"].detach()[:, 0].argsort()
        return parameters | {"means": parameters["means"].detach()[order].requires_grad_()}


class NeedsNeighbours(Vanilla):
    def decode(self, parameters, camera, phase):
        parameters["means"][1]
        return super().decode(parameters, camera, phase)


class Drifts(Vanilla):
    def bake(self, parameters, phase, cameras):
        parameters["means"].data.add_(1.0)
        return super().bake(parameters, phase, cameras)


class ReadsWhatItPassesOn(Vanilla):
    passthrough: ClassVar[Mapping[str, str]] = {"sh_dc": "f_dc"}

    def decode(self, parameters, camera, phase):
        gaussians = super().decode(parameters, camera, phase)
        brightness = parameters["f_dc"][:, 0].mean(dim=1)
        return replace(gaussians, opacities=gaussians.opacities * brightness.sigmoid())


class HandsOverACopy(Vanilla):
    passthrough: ClassVar[Mapping[str, str]] = {"sh_dc": "f_dc"}

    def decode(self, parameters, camera, phase):
        return replace(super().decode(parameters, camera, phase), sh_dc=parameters["f_dc"].clone())


class BakesAGraph(Vanilla):
    def bake(self, parameters, phase, cameras):
        return self.decode(parameters, cameras[0], phase)


class OverridesTheUser(Vanilla):
    def fitted_to(self, scene):
        return self.model_copy(update={"sh_degree": 0}), ("no bands",)


class Impatient(NoDensification):
    def densify(self, context, state):
        return api.Edit(counts={"cloned": 1}), state


class WrongRows(NoDensification):
    def densify(self, context, state):
        return api.NO_EDIT, api.PluginState(per_primitive={"sums": torch.zeros(3)})


class BeyondTheRows(NoDensification):
    def densify(self, context, state):
        means = context.parameters["means"].detach()
        rows = api.Rows(means[:1], torch.tensor([len(means)]))
        return api.Edit(values={"means": rows}), state


class BeforeTheRows(NoDensification):
    def densify(self, context, state):
        means = context.parameters["means"].detach()
        return api.Edit(values={"means": api.Rows(means[:1], torch.tensor([-1]))}), state


class OneColumn(NoDensification):
    def densify(self, context, state):
        means = context.parameters["means"].detach()
        return api.Edit(values={"means": api.Rows(means[:, :1])}), state


class NumpySource(NoDensification):
    def densify(self, context, state):
        return api.Edit(source=np.arange(len(context.parameters["means"]))), state


class NeedsNormals(NoDensification):
    needs: ClassVar[frozenset[str]] = frozenset({"pixels", "normals"})


class Greedy(NoDensification):
    def densify(self, context, state):
        number = len(context.parameters["means"])
        return api.Edit(source=torch.arange(2 * number) % number), state


class GlobalNoise(NoDensification):
    def densify(self, context, state):
        means = context.parameters["means"].detach()
        return api.Edit(values={"means": api.Rows(means + torch.randn_like(means))}), state


class Forgets(NoDensification):
    calls: ClassVar[list[int]] = []

    def densify(self, context, state):
        self.calls.append(1)
        means = context.parameters["means"].detach() + len(self.calls)
        return api.Edit(values={"means": api.Rows(means)}), state


class InPlace(NoDensification):
    def densify(self, context, state):
        context.parameters["means"].data.add_(1.0)
        return api.NO_EDIT, state


class TakesAnything(api.Reader):
    def accepts(self, path):
        return True

    def read(self, path, options):
        (path / "cache").write_text("") if path.is_dir() else None
        raise api.UserError("no scene here")


class ForeignErrors(TakesAnything):
    def accepts(self, path):
        return False

    def read(self, path, options):
        return Path(path / "cameras.bin").read_bytes()


class NeedsAFolder(api.Observer):
    @api.hookimpl
    def crossgrad_run_start(self, run):
        (run.folder / "notes.txt").write_text("notes")


class NeedsASession(api.Observer):
    @api.hookimpl
    def crossgrad_run_end(self, status):
        if status == "failed":
            raise ZeroDivisionError("no steps to average over")


class Swallows(api.Observer):
    @api.hookimpl(wrapper=True)
    def crossgrad_aggregate_gradients(self, context):
        yield


class DropsAView(api.Observer):
    @api.hookimpl(wrapper=True)
    def crossgrad_sample_views(self, context):
        sampled = yield
        return replace(sampled, draw=api.ViewSample(sampled.draw.views[:1]))


class ScalesBeyondOne(api.Observer):
    @api.hookimpl(wrapper=True)
    def crossgrad_choose_scales(self, context):
        scaled = yield
        return replace(scaled, scales=tuple(2.0 * scale for scale in scaled.scales))


class NoScale(api.Observer):
    @api.hookimpl(wrapper=True)
    def crossgrad_choose_scales(self, context):
        scaled = yield
        return replace(scaled, scales=())


class ObjectsInOneText(api.Observer):
    @api.hookimpl
    def crossgrad_validate_selection(self, selection):
        return f"{selection.names['backbone']} is not for me"


class WeighsInFullSize(api.Observer):
    @api.hookimpl
    def crossgrad_pixel_weights(self, context):
        return torch.ones(context.view.camera.height, context.view.camera.width)


class WeighsInWholeNumbers(api.Observer):
    @api.hookimpl
    def crossgrad_pixel_weights(self, context):
        return torch.ones_like(context.target[..., 0])


class WeighsBelowZero(api.Observer):
    @api.hookimpl
    def crossgrad_pixel_weights(self, context):
        return context.target[..., 0].float() - 1e3


class BareLoss(api.Observer):
    @api.hookimpl
    def crossgrad_regularize(self, context):
        return context.parameters["scales"].mean()


class LossOfEachPrimitive(api.Observer):
    @api.hookimpl
    def crossgrad_regularize(self, context):
        return api.RegularizeResult(context.parameters["scales"].mean(dim=1))


class LossOfNothing(api.Observer):
    @api.hookimpl
    def crossgrad_regularize(self, context):
        if context.gaussians is None:
            return api.RegularizeResult(context.parameters["scales"][:0].mean())
        return None


class BareState(api.Observer):
    @api.hookimpl
    def crossgrad_regularize(self, context):
        term = api.RegularizeResult(context.parameters["scales"].mean())
        return term.with_state("bare", {"step": context.step})


class StateOfSets(api.Observer):
    @api.hookimpl
    def crossgrad_after_step(self, context):
        return api.DensifyResult(api.NO_EDIT).with_state("sets", api.PluginState({"seen": {1}}))


class BareEdit(api.Observer):
    @api.hookimpl
    def crossgrad_after_step(self, context):
        return api.NO_EDIT


class NoEditInside(api.Observer):
    @api.hookimpl
    def crossgrad_after_step(self, context):
        return api.DensifyResult(None)


class ClampsWhatIsNotThere(api.Observer):
    @api.hookimpl
    def crossgrad_after_step(self, context):
        scales = context.parameters["scales"].detach().clamp(max=0.0)
        return api.DensifyResult(api.Edit(values={"scale": api.Rows(scales)}))


class CopiesTheParameters(api.Observer):
    @api.hookimpl
    def crossgrad_after_step(self, context):
        return None if context.parameters.copy() else api.DensifyResult(api.NO_EDIT)


class LooksAtSingleViews(api.Observer):
    @api.hookimpl(wrapper=True)
    def crossgrad_aggregate_gradients(self, context):
        assert context.separate.views == 2
        return (yield)


class AskedForSingleViews(LooksAtSingleViews):
    needs_separate_gradients = True


class RemembersNoLabels(api.Observer):
    @api.hookimpl(wrapper=True)
    def crossgrad_aggregate_gradients(self, context):
        assert len(context.labels) == 2
        return (yield)


class LooksBackAtStepsAsTuples(api.Observer):
    @api.hookimpl(wrapper=True)
    def crossgrad_sample_views(self, context):
        assert context.last is None or len(context.last) == 2
        return (yield)


class CopiesTheGaussians(api.Observer):
    """Does no wrong."""

    @api.hookimpl
    def crossgrad_regularize(self, context):
        if context.gaussians is not None:
            assert replace(context.gaussians.detached()).means.shape[1] == 3


class CountsSingleViews(api.Operator):
    separate = False

    def aggregate(self, context, state):
        count = int(context.separate.present().sum())
        return api.AggregateResult(context.gradients.total(), {"present": count}), state


class FillsBareScenesWithNothing(load("initializers", "points")):
    alone: ClassVar[bool] = True

    def more_points(self, scene):
        if len(scene.points):
            return None
        positions, colors = np.zeros((2, 3)), np.zeros((2, 3), np.uint8)
        return api.MorePoints(positions, colors, np.array([np.nan, 0.0]), np.full(2, np.nan))


class TremblesByItself(api.Observer):
    @api.hookimpl
    def crossgrad_after_step(self, context):
        means = context.parameters["means"].detach()
        noise = 1e-3 * torch.randn_like(means)
        return api.DensifyResult(api.Edit(values={"means": api.Rows(means + noise)}))


class ClampsInPlace(api.Observer):
    @api.hookimpl
    def crossgrad_after_step(self, context):
        context.parameters["scales"].data.clamp_(max=-9.0)


class Renders(api.Observer):
    @api.hookimpl
    def crossgrad_model_ready(self, model):
        assert model.render(0, 0.5).loss.isfinite()


class Shifts(api.Observer):
    @api.hookimpl
    def crossgrad_model_ready(self, model):
        model.parameters["means"].data.add_(1.0)


class KeepsATuple(api.Observer):
    @api.hookimpl
    def crossgrad_after_step(self, context):
        state = api.PluginState({"range": (0.0, 1.0)})
        return api.DensifyResult(api.NO_EDIT).with_state("range", state)


class CountsInNumpy(api.Observer):
    @api.hookimpl
    def crossgrad_after_step(self, context):
        return api.DensifyResult(api.Edit(counts={"clamped": np.int64(3)}))


class FitsToItself(NoExposure):
    def fitted_to(self, scene):
        return self


class FitsToWhatIsNotThere(NoExposure):
    def fitted_to(self, scene):
        return api.Fitted(self, "gian")


class FitsToAnotherName(NoExposure):
    def fitted_to(self, scene):
        return api.Fitted(load("exposures", "gain")(), "none")


class FitsWithoutAName(NoExposure):
    def fitted_to(self, scene):
        return api.Fitted(load("exposures", "gain")())


class OneNote(NoExposure):
    def fitted_to(self, scene):
        return api.Fitted(self, notes="nothing was found")


class RoundsWhatItWrites(Ply):
    def write(self, content, path):
        content.gaussians.sh_rest.round_(decimals=1)
        return super().write(content, path)


class RoundsWhatItStores(Ply):
    def stored(self, gaussians, similarity):
        gaussians.sh_dc.round_(decimals=1)
        return gaussians


class CalledPSNR(PSNR):
    pass


class CalledStep(PSNR):
    figure: ClassVar[api.Figure] = api.Figure("step", "step")


class CalledRegime(PSNR):
    figure: ClassVar[api.Figure] = api.Figure("regime", "regime")


class Mutable(Adding):
    model_config = ConfigDict(frozen=False)


class Tolerant(Adding):
    model_config = ConfigDict(extra="ignore")


class Unhashable(Adding):
    table: dict[str, int] = api.Field({}, description="a table")


class Rounds(Adding):
    share: float = api.Field(0.123, description="a share")

    @field_serializer("share")
    def in_short(self, share):
        return round(share, 1)


class ReadsNumbersOnly(Rounds):
    @field_serializer("share")
    def in_short(self, share):
        return f"{share:%}"


class Silent(Adding):
    share: float = 0.5


class Named(Adding):
    name: str = api.Field("adding", description="what tables call it")


class Misspelt(Adding):
    @api.hookimpl
    def crossgrad_densfy(self, context):
        return None


class MisspeltArgument(Adding):
    @api.hookimpl
    def crossgrad_step_end(self, recrod):
        return None


DEFECTS = [
    (components.options_are_frozen, Mutable),
    (components.options_are_frozen, Unhashable),
    (components.unknown_options_are_refused, Tolerant),
    (components.options_survive_the_configuration_file, Rounds),
    (components.options_survive_the_configuration_file, ReadsNumbersOnly),
    (components.options_are_described, Silent),
    (components.options_can_be_set, Named),
    (components.hooks_exist, Misspelt),
    (components.hooks_exist, MisspeltArgument),
    (aggregation.every_tensor_is_answered, ForgetsATensor),
    (aggregation.equal_gradients_have_a_scale, HiddenCounter),
    (aggregation.absent_views_have_no_weight, CountsViewsThatAreNotThere),
    (aggregation.gradients_stay_untouched, ChangesGradients),
    (aggregation.same_seed_same_aggregation, GlobalRandomness),
    (operators.matrices_have_the_shape, OneBlockTooFew),
    (operators.matrices_have_the_shape, SinglePrecision),
    (operators.matrices_are_finite, DividesByZero),
    (operators.one_block_is_enough, LooksAtOtherBlocks),
    (operators.inputs_stay_untouched, ChangesGramians),
    (operators.inputs_stay_untouched, ChangesLosses),
    (operators.same_seed_same_answer, GlobalRandomness),
    (operators.same_seed_same_answer, HiddenCounter),
    (operators.state_survives_a_checkpoint, HiddenCounter),
    (operators.state_survives_a_checkpoint, TextKeys),
    (operators.one_view_keeps_its_direction, Reverses),
    (operators.scales_with_the_gradients, AbsoluteThreshold),
    (operators.what_it_reads_is_declared, FarViewsCountTwice),
    (operators.what_it_reads_is_declared, SaysItReadsNoGramians),
    (samplers.default_views_are_admitted, UsualViewsRefused),
    (samplers.draws_are_training_views, OneViewTooFew),
    (samplers.draws_are_training_views, NumpyPositions),
    (samplers.draws_are_training_views, BeyondTheEnd),
    (samplers.every_view_comes, NeverTheFirst),
    (samplers.same_seed_same_draws, GlobalDraws),
    (samplers.resumes_exactly, RemembersOnItself),
    (samplers.old_states_stay_untouched, ChangesItsState),
    (groupings.every_view_has_a_declared_label, ForeignLabel),
    (groupings.every_view_has_a_declared_label, OneLabelForAll),
    (groupings.every_group_has_training_views, EmptyGroup),
    (groupings.the_rule_is_fitted_on_training_views, FittedOnWhatIsAsked),
    (groupings.the_quantity_is_one_number_per_view, MeasuresRanks),
    (groupings.same_seed_same_labels, GlobalLabels),
    (rasterizers.speed_says_where_it_runs, FastEverywhere),
    (rasterizers.renders_have_the_shape, FlatImage),
    (rasterizers.the_background_shows_through, ForgetsTheBackground),
    (rasterizers.nothing_to_draw_is_no_error, ForgetsTheBackground),
    (rasterizers.gradients_reach_every_input, FrozenOpacities),
    (rasterizers.statistics_are_filled, NoStatistics),
    (rasterizers.same_input_same_bits, Flickers),
    (rasterizers.rows_on_demand_are_asked_for, AsksForNoRows),
    (reference.the_reference_draws_the_same, LessOpaque),
    (rasterizers.dilations_of_gaussians_are_heeded, OneDilation),
    (backbones.blocks_cover_the_parameters, LooseTensor),
    (backbones.created_from_the_scene, GlobalStart),
    (backbones.the_default_densifier_is_there, DensifierOfAnchors),
    (backbones.decoding_has_the_shape, NegativeScales),
    (backbones.decoding_has_the_shape, GreyColors),
    (backbones.decoding_has_the_shape, FewerColors),
    (backbones.decoding_has_the_shape, FlatBandZero),
    (backbones.decoding_has_the_shape, TooFewBands),
    (backbones.decoding_has_the_shape, OddBands),
    (backbones.decoding_has_the_shape, TwoTypes),
    (backbones.decoding_has_the_shape, ShortSlots),
    (backbones.decoding_has_the_shape, CountsDecoded),
    (backbones.positions_are_those_of_primitives, PositionsNowhere),
    (backbones.positions_are_those_of_primitives, PositionsOfFourColumns),
    (backbones.positions_are_those_of_primitives, PositionsOfAll),
    (backbones.axes_are_those_of_primitives, AxesOfOneLength),
    (backbones.axes_are_those_of_primitives, AxesNowhere),
    (backbones.gradients_reach_every_block, FrozenQuats),
    (backbones.checkpoints_give_the_same_gaussians, CountsOnItself),
    (backbones.checkpoints_give_the_same_gaussians, Trembles),
    (backbones.checkpoints_give_the_same_gaussians, BrightensAtRandom),
    (backbones.edits_keep_rows_together, SortsRows),
    (backbones.parameters_stay_untouched, Drifts),
    (backbones.passed_on_tensors_are_handed_over, ReadsWhatItPassesOn),
    (backbones.passed_on_tensors_are_handed_over, HandsOverACopy),
    (backbones.baking_gives_plain_gaussians, BakesAGraph),
    (backbones.fitting_respects_the_user, OverridesTheUser),
    (densifiers.its_needs_are_statistics, NeedsNormals),
    (densifiers.quiet_before_its_time, Impatient),
    (densifiers.edits_keep_everything_aligned, WrongRows),
    (densifiers.edits_keep_everything_aligned, BeyondTheRows),
    (densifiers.edits_keep_everything_aligned, BeforeTheRows),
    (densifiers.edits_keep_everything_aligned, OneColumn),
    (densifiers.edits_keep_everything_aligned, NumpySource),
    (densifiers.never_outgrows_the_room, Greedy),
    (densifiers.same_seed_same_edits, GlobalNoise),
    (densifiers.resumes_exactly, Forgets),
    (densifiers.inputs_stay_untouched, InPlace),
    (readers.foreign_folders_are_not_accepted, TakesAnything),
    (readers.foreign_folders_are_a_user_error, ForeignErrors),
    (readers.folders_stay_as_they_are, TakesAnything),
    (observers.the_model_stays_untouched, Shifts),
    (observers.hooks_stay_answered, DropsAView),
    (observers.hooks_stay_answered, ScalesBeyondOne),
    (observers.hooks_stay_answered, NoScale),
    (observers.questions_are_answered_in_kind, ObjectsInOneText),
    (observers.questions_are_answered_in_kind, WeighsInFullSize),
    (observers.questions_are_answered_in_kind, WeighsInWholeNumbers),
    (observers.questions_are_answered_in_kind, WeighsBelowZero),
    (observers.questions_are_answered_in_kind, BareLoss),
    (observers.questions_are_answered_in_kind, LossOfEachPrimitive),
    (observers.questions_are_answered_in_kind, LossOfNothing),
    (observers.questions_are_answered_in_kind, BareState),
    (observers.questions_are_answered_in_kind, StateOfSets),
    (observers.questions_are_answered_in_kind, KeepsATuple),
    (observers.questions_are_answered_in_kind, CountsInNumpy),
    (observers.questions_are_answered_in_kind, BareEdit),
    (observers.questions_are_answered_in_kind, NoEditInside),
    (observers.questions_are_answered_in_kind, ClampsWhatIsNotThere),
    (observers.questions_are_answered_in_kind, TremblesByItself),
    (observers.questions_are_answered_in_kind, ClampsInPlace),
    (exposures.fitting_gives_an_installed_one, FitsToItself),
    (exposures.fitting_gives_an_installed_one, FitsToAnotherName),
    (exposures.fitting_gives_an_installed_one, FitsWithoutAName),
    (exposures.fitting_gives_an_installed_one, OneNote),
    (exporters.writes_one_file, RoundsWhatItWrites),
    (exporters.the_stored_ones_can_be_drawn, RoundsWhatItStores),
    (metrics.its_columns_are_its_own, CalledPSNR),
    (metrics.its_columns_are_its_own, CalledStep),
    (metrics.its_columns_are_its_own, CalledRegime),
    (initializers.adds_points, FillsBareScenesWithNothing),
]

#: What the component itself raises is not caught by the check: `plugins check` reports it.
RAISING = [
    (rasterizers.nothing_to_draw_is_no_error, NeedsGaussians, IndexError),
    (backbones.few_primitives_are_no_error, NeedsNeighbours, IndexError),
    (backbones.the_default_densifier_is_there, DensifierNowhere, api.UserError),
    (exposures.fitting_gives_an_installed_one, FitsToWhatIsNotThere, api.UserError),
    (observers.survives_every_event, NeedsAFolder, TypeError),
    (observers.survives_an_early_end, NeedsASession, ZeroDivisionError),
    (observers.hooks_stay_answered, Swallows, api.UserError),
    (observers.questions_are_answered_in_kind, CopiesTheParameters, AttributeError),
    (observers.hooks_stay_answered, LooksAtSingleViews, TypeError),
    (observers.survives_every_event, RemembersNoLabels, ContractError),
    (observers.survives_every_event, LooksBackAtStepsAsTuples, ContractError),
    (aggregation.every_tensor_is_answered, CountsSingleViews, TypeError),
]


def name_of(value):
    return getattr(value, "__name__", None)


@pytest.mark.sampled(53)
@pytest.mark.parametrize(("check", "make"), DEFECTS, ids=name_of)
def test_each_defect_fails_its_check(check, make):
    with pytest.raises(ContractError, match=r"\w+ \w+"):
        check(make)


@pytest.mark.sampled(4)
@pytest.mark.parametrize(("check", "make", "error"), RAISING, ids=name_of)
def test_an_error_of_the_component_is_passed_on(check, make, error):
    with pytest.raises(error):
        check(make)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("checks", "make"),
    [
        (operators.OPERATOR_CHECKS, Adding),
        (samplers.SAMPLER_CHECKS, InTurn),
        (observers.OBSERVER_CHECKS, Renders),
        (observers.OBSERVER_CHECKS, AskedForSingleViews),
        (observers.OBSERVER_CHECKS, CopiesTheGaussians),
    ],
    ids=name_of,
)
def test_correct_components_pass_all_checks(checks, make):
    for check in checks:
        check(make)


def test_every_check_has_a_defect_that_it_detects():
    modules = (operators, samplers, groupings, rasterizers, backbones, densifiers, readers)
    checks = {
        check
        for module in (*modules, observers)
        for name, each in vars(module).items()
        if name.endswith("_CHECKS")
        for check in each
    }
    # Other files of this folder hold further defects, in the same form: (module.check, Defect, ...
    sources = [path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("*.py")]
    case = re.compile(r"^ +\(\w+\.(\w+), \w", re.MULTILINE)
    caught = {name for each in sources for name in case.findall(each)}
    assert {check.__name__ for check in checks} - caught == set()


@pytest.mark.parametrize(
    ("check", "make", "words"),
    [
        (components.hooks_exist, MisspeltArgument, "recrod"),
        (
            densifiers.edits_keep_everything_aligned,
            NumpySource,
            "source is of type numpy.ndarray, not a tensor",
        ),
    ],
    ids=name_of,
)
def test_a_failed_check_reports_its_observation(check, make, words):
    with pytest.raises(ContractError, match=words):
        check(make)


def test_a_check_that_does_not_apply_is_skipped():
    class Pairs(Adding):
        views = api.ViewCounts(2, 2)

    with pytest.raises(SkipTest, match="K = 2"):
        operators.one_view_keeps_its_direction(Pairs)
