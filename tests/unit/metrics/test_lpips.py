"""LPIPS against torchmetrics with one random trunk in both, and what files of weights it takes."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from crossgrad_core.errors import UserError
from crossgrad_core.plugin import Compared
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_plugins.metrics.lpips import LPIPS, LPIPSOfVGG, LPIPSOfVGGAs3DGS
from crossgrad_plugins.metrics.lpips_trunks import ALEXNET, VGG16

KINDS = (LPIPS, LPIPSOfVGG, LPIPSOfVGGAs3DGS)
NO_SELECTION = SimpleNamespace()


def alexnet_features():
    """`features` of torchvision's alexnet."""
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 2)),
    )


def vgg16_features():
    """`features` of torchvision's vgg16, its configuration D."""
    layers, channels = [], 3
    for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512, 0):
        if width == 0:
            layers.append(nn.MaxPool2d(2, 2))
        else:
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
    return nn.Sequential(*layers)


FEATURES = {"alexnet": alexnet_features, "vgg16": vgg16_features}


def state_dict(model, seed=0):
    """Random weights under torchvision's names, with those of a classifier that nobody needs."""
    torch.manual_seed(seed)
    named = {f"features.{key}": each for key, each in FEATURES[model]().state_dict().items()}
    return {**named, "classifier.1.weight": torch.zeros(2, 2)}


@pytest.fixture(scope="module")
def trunks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trunks")
    for model in FEATURES:
        torch.save(state_dict(model), folder / f"{model}.pth")
    return folder


@pytest.fixture(scope="module")
def heads(tmp_path_factory):
    """Heads of our own, for what needs no published ones."""
    folder = tmp_path_factory.mktemp("heads")
    generator = torch.Generator().manual_seed(3)
    for net in (ALEXNET, VGG16):
        named = {
            f"lin{place}.model.1.weight": torch.rand(1, layer.shape[0], 1, 1, generator=generator)
            for place, layer in enumerate(net.compared)
        }
        torch.save(named, folder / net.heads)
    return folder


def pair(seed=0, size=(70, 94), mask=None):
    generator = torch.Generator().manual_seed(seed)
    photo = torch.randint(0, 256, (*size, 3), generator=generator, dtype=torch.uint8)
    noise = torch.randint(-50, 50, photo.shape, generator=generator)
    render = (photo + noise).clamp(0, 255).to(torch.uint8)
    return Compared(sample_scene().test_views[0], render, photo, mask)


def built(kind, trunks, **more):
    return kind(trunk=trunks / f"{kind.net.model}.pth", **more)


def of_torchmetrics(monkeypatch, net, images, *, scales):
    """What torchmetrics answers, its network filled with the same random trunk."""
    lpips = pytest.importorskip("torchmetrics.functional.image.lpips")

    def features(model, pretrained=False):
        trunk = FEATURES[model]()
        own = {key.removeprefix("features."): v for key, v in state_dict(model).items()}
        trunk.load_state_dict({key: own[key] for key in trunk.state_dict()})
        return trunk

    monkeypatch.setattr(lpips, "_get_tv_model_features", features)
    network = lpips._NoTrainLpips(net=net, pnet_rand=True)
    one, two = (each.permute(2, 0, 1)[None].float() / 255 for each in images)
    return float(network(one, two, normalize=scales))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("kind", "net", "scales"),
    [(LPIPS, "alex", True), (LPIPSOfVGG, "vgg", True), (LPIPSOfVGGAs3DGS, "vgg", False)],
)
def test_lpips_agrees_with_torchmetrics(kind, net, scales, seed, trunks, monkeypatch):
    found = pair(seed)
    expected = of_torchmetrics(monkeypatch, net, (found.render, found.photo), scales=scales)
    assert expected > 1e-3
    assert built(kind, trunks).measure(found) == pytest.approx(expected, abs=1e-5, rel=1e-5)


def test_the_two_input_scalings_give_different_values(trunks, heads):
    figures = [
        built(kind, trunks, heads=heads / "vgg.pth").measure(pair())
        for kind in (LPIPSOfVGG, LPIPSOfVGGAs3DGS)
    ]
    assert abs(figures[0] - figures[1]) > 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_the_distance_of_an_image_from_itself_is_zero(kind, trunks, heads):
    metric = built(kind, trunks, heads=heads / kind.net.heads)
    same = pair()
    assert metric.measure(Compared(same.view, same.photo, same.photo, None)) == 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_masked_pixels_do_not_count_and_a_fully_masked_image_has_no_value(kind, trunks, heads):
    metric = built(kind, trunks, heads=heads / kind.net.heads)
    mask = torch.ones(70, 94, dtype=torch.bool)
    mask[:, 40:] = False
    one = pair(mask=mask)
    render = one.render.clone()
    render[~mask] = 7
    assert metric.measure(one) == metric.measure(Compared(one.view, render, one.photo, mask)) > 0
    assert metric.measure(pair(mask=torch.zeros_like(mask))) is None


@pytest.mark.parametrize("kind", KINDS)
def test_an_image_below_the_smallest_size_has_no_value_but_a_reason(kind, trunks, heads):
    metric = built(kind, trunks, heads=heads / kind.net.heads)
    least = kind.net.smallest
    assert metric.measure(pair(size=(least, least + 9))) > 0
    assert metric.measure(pair(size=(least + 9, least - 1))) is None
    assert f"at least {least} pixels" in metric.described().undefined


@pytest.mark.parametrize("kind", KINDS)
def test_lpips_without_a_weight_file_is_null_and_explains_the_option(kind):
    assert kind().measure(pair()) is None
    told = kind().described().undefined
    assert f"--set metrics.{kind.entry}.trunk=FILE" in told and kind.net.published in told
    assert kind().crossgrad_validate_selection(NO_SELECTION) == []


def test_safetensors_files_and_a_trunk_without_prefix_are_read_alike(trunks, heads, tmp_path):
    bare = {k.removeprefix("features."): v for k, v in state_dict("alexnet").items()}
    save_file({k: v.contiguous() for k, v in bare.items()}, tmp_path / "alex.safetensors")
    head = heads / "alex.pth"
    one = LPIPS(trunk=tmp_path / "alex.safetensors", heads=head).measure(pair())
    assert one == LPIPS(trunk=trunks / "alexnet.pth", heads=head).measure(pair())


def test_the_definition_in_the_results_names_the_weights(trunks, heads):
    told = LPIPS(trunk=trunks / "alexnet.pth", heads=heads / "alex.pth").described().definition
    assert "images in [-1, 1]" in told and "alexnet.pth (SHA-256 " in told
    assert "not the file that torchvision publishes" in told
    assert "linear heads of alex.pth" in told


def refused(metric):
    """The error before any training."""
    with pytest.raises(UserError) as caught:
        metric.crossgrad_validate_selection(NO_SELECTION)
    assert caught.value.todo
    return caught.value


def test_invalid_weight_files_are_refused_before_training(trunks, heads, tmp_path):
    head = heads / "alex.pth"
    assert "does not exist" in refused(LPIPS(trunk=tmp_path / "none.pth", heads=head)).what

    junk = tmp_path / "junk.pth"
    junk.write_bytes(b"no weights")
    assert "cannot be read" in refused(LPIPS(trunk=junk, heads=head)).what
    torch.save([1, 2], tmp_path / "list.pth")
    assert "type list" in refused(LPIPS(trunk=tmp_path / "list.pth", heads=head)).found

    other = refused(LPIPS(trunk=trunks / "vgg16.pth", heads=head))
    assert "another network" in other.what and "[64, 3, 3, 3]" in other.found
    swapped = refused(LPIPSOfVGG(trunk=trunks / "vgg16.pth", heads=head))
    assert "lin1.model.1.weight" in str(swapped.where)

    spoiled = state_dict("alexnet")
    spoiled["features.0.bias"][3] = torch.nan
    torch.save(spoiled, tmp_path / "nan.pth")
    assert "not finite" in refused(LPIPS(trunk=tmp_path / "nan.pth", heads=head)).found


def test_a_pickle_with_code_is_not_executed(heads, tmp_path):
    class Evil:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "ran",))

    torch.save({"features.0.weight": Evil()}, tmp_path / "evil.pth")
    error = refused(LPIPS(trunk=tmp_path / "evil.pth", heads=heads / "alex.pth"))
    assert "cannot be read" in error.what
    assert not (tmp_path / "ran").exists()


def test_linear_heads_without_a_trunk_are_refused(heads):
    reasons = LPIPS(heads=heads / "alex.pth").crossgrad_validate_selection(NO_SELECTION)
    assert len(reasons) == 1 and "metrics.lpips.trunk=FILE" in reasons[0]


def test_the_error_about_missing_heads_names_the_package_to_install(trunks, monkeypatch):
    place = "crossgrad_plugins.metrics.lpips_distance.find_spec"
    monkeypatch.setattr(place, lambda package: None)
    # A path of its own, since weights are kept once they are read.
    moved = trunks / "copy.pth"
    moved.write_bytes((trunks / "alexnet.pth").read_bytes())
    error = refused(LPIPS(trunk=moved))
    assert "linear heads" in error.what and "pip install torchmetrics" in error.todo


def test_a_relative_path_is_stored_as_an_absolute_path(trunks, monkeypatch):
    monkeypatch.chdir(trunks)
    assert LPIPS(trunk="alexnet.pth").model_dump(mode="json")["trunk"] == str(
        trunks / "alexnet.pth"
    )
