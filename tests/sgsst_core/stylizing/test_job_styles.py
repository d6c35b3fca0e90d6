from __future__ import annotations

import math

import pytest
import torch

from sgsst_core.constants import SH_C0
from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.scene.colors import resize_area, style_size
from sgsst_core.settings import MAX_RESOLUTION, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import check_style_size, prepared_style, rotated
from sgsst_core.stylizing.stylizer import Stylizer
from tests.small_scenes import cameras, wall


def synthetic_image(height: int = 40, width: int = 60) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))


def ramp(height: int, width: int, slope_y: float, slope_x: float) -> torch.Tensor:
    """Return an image with a linear gradient and the value 0.5 at its center."""
    y = torch.arange(height) - (height - 1) / 2
    x = torch.arange(width) - (width - 1) / 2
    return (0.5 + slope_y * y[:, None] + slope_x * x).unsqueeze(2).expand(-1, -1, 3).contiguous()


def test_rotations_by_90_degrees_only_move_pixels() -> None:
    style = synthetic_image()
    assert torch.equal(rotated(style, 90), torch.rot90(style, 1, (0, 1)))
    assert torch.equal(rotated(style, -90), torch.rot90(style, -1, (0, 1)))
    assert torch.equal(rotated(style, 360), style)
    assert rotated(style, 180).is_contiguous()


@pytest.mark.parametrize("degrees", [1, 17, 45, 89, 107, -30, 200])
@pytest.mark.parametrize("size", [(80, 80), (60, 150), (150, 60)])
def test_brightness_ramp_rotates_with_the_image(degrees: float, size: tuple[int, int]) -> None:
    """Every pixel comes from inside the image: edges are not extended and nothing is filled in."""
    height, width = size
    image = rotated(ramp(height, width, 0.001, 0.002), degrees)[..., 0]
    angle = math.radians(degrees)
    # Counterclockwise, as seen with y pointing down: what was on the right moves up.
    slope_x = 0.002 * math.cos(angle) + 0.001 * math.sin(angle)
    slope_y = 0.001 * math.cos(angle) - 0.002 * math.sin(angle)
    wanted = ramp(image.shape[0], image.shape[1], slope_y, slope_x)[..., 0]
    shift = 0.0025  # the crop is half a pixel off center
    torch.testing.assert_close(image - image.mean(), wanted - wanted.mean(), atol=1e-4, rtol=0)
    assert abs(float(image.mean()) - 0.5) <= shift


def test_matched_colors_have_the_scenes_mean_and_covariance() -> None:
    generator = torch.Generator().manual_seed(1)
    colors = 0.5 + 0.08 * torch.randn(5000, 3, generator=generator) @ torch.tensor(
        [[1.0, 0.3, 0.0], [0.0, 1.0, 0.5], [0.0, 0.0, 0.4]]
    )
    weights = torch.rand(5000, generator=generator, dtype=torch.float64)
    settings = make_settings("standard", preserve_colors="match")
    style = 0.5 + 0.05 * torch.randn(64, 64, 3, generator=generator)
    (image,) = prepared_style(Style.of(style), settings, (colors - 0.5) / SH_C0, weights).images
    matched = image.reshape(-1, 3).double()
    share = (weights / weights.sum())[:, None]
    inside = colors.double().clamp(0, 1)
    mean = (share * inside).sum(dim=0)
    covariance = (share * (inside - mean)).T @ (inside - mean)
    torch.testing.assert_close(matched.mean(dim=0), mean, atol=1e-4, rtol=0)
    torch.testing.assert_close(matched.T.cov(correction=0), covariance, atol=1e-4, rtol=0)


def test_uniform_style_gets_the_mean_of_the_scene() -> None:
    settings = make_settings("standard", preserve_colors="match")
    gray = Style.of(torch.full((4, 4, 3), 0.9))
    (image,) = prepared_style(gray, settings, torch.zeros(10, 3), torch.ones(10).double()).images
    torch.testing.assert_close(image, torch.full((4, 4, 3), 0.5))


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_style_scale_uses_statistics_of_a_resized_style(tiny_weights: BackboneWeights, scale: float) -> None:
    style, view = synthetic_image(96, 120), (64, 96)
    size = style_size((96, 120), view, scale)
    assert size == (round(64 * scale), round(80 * scale))
    network = FeatureNetwork(tiny_weights)
    actual = SosLoss(network, style_scale=scale).targets.of_style(Style.of(style), view)[0][0]
    wanted = SosLoss(network).targets.of_style(Style.of(resize_area(style, size)), size)[0][0]
    for layer in actual.layers:
        torch.testing.assert_close(actual.layers[layer].gram, wanted.layers[layer].gram)


def test_style_size_has_the_limit_of_views() -> None:
    (view,) = cameras()[:1]
    line = Style.of(torch.zeros(1, 100, 3))
    most = MAX_RESOLUTION / 100
    check_style_size(line, [view], most)
    check_style_size(Style.of(torch.zeros(1, MAX_RESOLUTION + 1, 3)), [view], 1)  # the style is never enlarged
    with pytest.raises(SettingsError, match=rf"for views of {view.width} x {view.height}\. .* at most 16,384"):
        check_style_size(line, [view], most + 0.1)


def test_job_uses_the_prepared_style(tiny_weights: BackboneWeights) -> None:
    settings = make_settings("standard", style_rotation=90, preserve_colors="match", style_scale=2, coarsest_side=24)
    scene, style = wall(), synthetic_image()
    stylizer = Stylizer.planned(scene, cameras(), style, settings, weights=tiny_weights)
    (used,) = stylizer.job.style.images
    assert used.shape == (60, 40, 3)
    assert stylizer.job.loss.targets.style_scale == 2
    weights = stylizer.job.plan.survey.total_blend_weights
    (wanted,) = prepared_style(Style.of(style), settings, scene.sh_dc, weights).images
    assert torch.equal(used, wanted)
    stylizer.run_step()
