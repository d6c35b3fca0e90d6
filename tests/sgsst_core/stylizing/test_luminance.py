"""Tests of whole jobs that change only the luminance of colors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from benchmarks.stability.sos_reference import sos_reference
from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.scene.colors import luminance, resize_area, style_size
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.color_transfer import luminance_start
from sgsst_core.stylizing.job import prepared_style
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.stylizer import ColorOptimizer, Stylizer
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import ball, cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")

#: Rounding error of a value around 1 that is rounded to float32 for the second time.
ROUNDING = 2**-22


def make(weights: BackboneWeights, scene: Scene, steps: int = 4, **values: Any) -> Stylizer:
    chosen: dict[str, Any] = {"coarsest_side": 24, "preserve_colors": "luminance"} | values
    settings = make_settings(steps_coarse=2, steps_sos=steps, early_stop=False, **chosen)
    return Stylizer.planned(scene, cameras(), style(), settings, weights=weights)


def chroma_off(stylized: torch.Tensor, scene: Scene) -> float:
    """Return the largest difference between the changes of two color channels of a Gaussian."""
    change = stylized.double() - scene.sh_dc.double()
    size = torch.maximum(stylized.abs(), scene.sh_dc.abs()).amax(1, keepdim=True).clamp_min(1).double()
    return float(((change - change.mean(1, keepdim=True)).abs() / size).max())


@pytest.mark.parametrize(
    ("make_scene", "values"),
    [
        (wall, {"clamp_aware_gradient": False}),
        (ball, {"warm_start": True, "training_background": "palette"}),
        (wall, {"style_loss": "mixed", "memory_limit": 1 << 20}),
        (wall, {"content_weight": 0, "views_per_step": 2}),
        (ball, {"unseen": "freeze"}),
    ],
)
def test_every_gaussian_keeps_its_chroma(
    tiny_weights: BackboneWeights, make_scene: Any, values: dict[str, Any]
) -> None:
    scene = make_scene()
    stylizer = make(tiny_weights, scene, **values)
    assert any(line.item == "colors" for line in stylizer.job.plan.decisions)
    before = stylizer.sh_dc.detach().clone()
    run(stylizer)
    stylized = stylizer.stylized()
    assert float((stylizer.sh_dc.detach() - before).abs().max()) > 0.1
    assert chroma_off(stylized, scene) < ROUNDING
    if values.get("unseen") != "freeze" and not stylizer.job.plan.seen.all():
        hidden = ~stylizer.job.plan.seen
        assert float((stylized - scene.sh_dc)[hidden].abs().max()) > 0


def test_gradient_is_the_derivative_by_luminance(tiny_weights: BackboneWeights) -> None:
    """The derivative is with respect to a value added to all channels of a Gaussian, by autograd from definitions."""
    scene, view = wall(), cameras(1)[0]
    settings = make_settings(preserve_colors="luminance", coarsest_side=24, steps_coarse=0, clamp_aware_gradient=False)
    stylizer = Stylizer.planned(scene, [view], style(), settings, weights=tiny_weights)
    actual, _ = stylizer.gradient(0, stylizer.job.scales(0))

    rasterizer = ReferenceRasterizer(scene)
    colors = (COLOR_OFFSET + SH_C0 * scene.sh_dc.double()).clamp_min(0)
    image = rasterizer.render(colors, view)
    size = (view.height, view.width)
    (painting,) = stylizer.job.style.images
    used = resize_area(painting, style_size((painting.shape[0], painting.shape[1]), size))
    _, pixels = sos_reference(stylizer.job.weights, image, used, image, coarsest=24)
    exact = rasterizer.color_gradient(pixels, view) * SH_C0 * (colors > 0)
    assert stylizer.job.weights.gray
    assert relative_error(actual.sum(1).double(), exact.sum(1)[stylizer.job.plan.seen]) < 1e-4


def test_tiles_agree_with_untiled_autograd(tiny_weights: BackboneWeights) -> None:
    weights = replace(tiny_weights, gray=True)
    image, content, painting = (
        synthetic_image(129, 161, seed=1),
        synthetic_image(129, 161, seed=2),
        synthetic_image(100, 120, seed=3),
    )
    painting = resize_area(painting, style_size((100, 120), (129, 161)))
    coverage = (synthetic_image(129, 161, seed=4)[:, :, 0] * 3 - 1).clamp(0, 1)
    expected, gradient = sos_reference(weights, image, painting, content, coverage=coverage, coarsest=70)
    for tile_size in (None, 64):
        loss = SosLoss(FeatureNetwork(weights, dtype=torch.float64), tile_size=tile_size, coarsest=70)
        targets = loss.targets.of_style(Style.of(painting), (129, 161))
        actual = loss.evaluate(image, targets, loss.targets.of_view(content, coverage))
        assert actual.loss == pytest.approx(expected, rel=1e-9)
        assert actual.image_gradient is not None
        assert relative_error(actual.image_gradient, gradient) < 1e-9


def test_colors_of_equal_luminance_have_equal_features(tiny_weights: BackboneWeights) -> None:
    network = FeatureNetwork(replace(tiny_weights, gray=True), dtype=torch.float64)
    image = synthetic_image(40, 48, seed=1)
    other = image + torch.tensor([0.587, -0.299, 0.0], dtype=torch.float64) * synthetic_image(40, 48, seed=5)[..., :1]
    first, second = (network.forward(each, cache=False).features for each in (image, other))
    for layer, features in first.items():
        torch.testing.assert_close(features, second[layer])


def test_style_gets_the_luminance_of_the_scene() -> None:
    generator = torch.Generator().manual_seed(1)
    colors = 0.4 + 0.05 * torch.randn(5000, 3, generator=generator)
    weights = torch.rand(5000, generator=generator, dtype=torch.float64)
    settings = make_settings(preserve_colors="luminance")
    painting = Style.of(0.5 + 0.1 * synthetic_image(64, 64, seed=2).float())
    (image,) = prepared_style(painting, settings, (colors - 0.5) / SH_C0, weights).images
    assert torch.equal(image[..., 0], image[..., 1])
    share, values = weights / weights.sum(), luminance(colors.double())
    mean = float((share * values).sum())
    assert float(image.double().mean()) == pytest.approx(mean, abs=1e-5)
    assert float(image[..., 0].double().std(correction=0)) == pytest.approx(
        float((share * (values - mean).square()).sum().sqrt()), rel=1e-3
    )


def test_mixture_as_a_whole_gets_the_luminance_of_the_scene() -> None:
    """Dark and bright images stay dark and bright; only the mixture has the scene's mean and deviation."""
    colors = 0.4 + 0.05 * torch.randn(5000, 3, generator=torch.Generator().manual_seed(1))
    dark, bright = (0.2 + 0.1 * synthetic_image(40, 60, seed=2), 0.6 + 0.1 * synthetic_image(60, 40, seed=3))
    mixture = Style.weighted([dark.float(), bright.float()], [3, 1])
    ones = torch.ones(5000, dtype=torch.float64)
    image = prepared_style(mixture, make_settings(preserve_colors="luminance"), (colors - 0.5) / SH_C0, ones)
    first, second = (luminance(each.double()) for each in image.images)
    assert float(first.mean()) < float(second.mean())
    values = luminance(colors.double())
    mean = 0.75 * first.mean() + 0.25 * second.mean()
    second_moment = 0.75 * first.square().mean() + 0.25 * second.square().mean()
    torch.testing.assert_close(mean, values.mean(), atol=1e-5, rtol=0)
    torch.testing.assert_close((second_moment - mean**2).sqrt(), values.std(correction=0), atol=0, rtol=1e-3)
    start = luminance_start((colors - 0.5) / SH_C0, ones, mixture)
    # Some pixels are as dark as possible.
    wanted = 0.75 * luminance(dark).mean() + 0.25 * luminance(bright).mean()
    torch.testing.assert_close(luminance(0.5 + SH_C0 * start.double()).mean(), wanted, atol=5e-3, rtol=0)


@pytest.mark.parametrize("value", [0.0, 0.3, 1.0])
def test_flat_styles_and_scenes_are_finite(value: float) -> None:
    settings = make_settings(preserve_colors="luminance")
    flat, some = torch.full((5, 4, 3), value), 0.3 * torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    ones = torch.ones(20, dtype=torch.float64)
    for scene_colors, painting in ((some, flat), (torch.full((20, 3), (value - 0.5) / SH_C0), style())):
        (image,) = prepared_style(Style.of(painting), settings, scene_colors, ones).images
        assert bool(image.isfinite().all())
        wanted = luminance((0.5 + SH_C0 * scene_colors).clamp(0, 1)).mean()
        torch.testing.assert_close(image.mean(), wanted, atol=1e-4, rtol=0)
        start = luminance_start(scene_colors, ones, Style.of(painting))
        assert chroma_off(start, replace(wall(), sh_dc=scene_colors)) < ROUNDING
        brightness = luminance(0.5 + SH_C0 * start.double())
        assert -1e-6 <= float(brightness.min()) <= float(brightness.max()) <= 1 + 1e-6


def test_rejected_step_changes_no_colors() -> None:
    original = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    colors = original + 0.7 * torch.rand(50, 3, generator=torch.Generator().manual_seed(1))
    before = colors.clone()
    optimizer = ColorOptimizer(colors, chroma_of=original)
    optimizer.update(torch.full((50, 3), 1e20), 0.1)
    assert torch.equal(colors.detach(), before)
    optimizer.update(torch.ones(50, 3), 0.1)
    assert not torch.equal(colors.detach(), before)
