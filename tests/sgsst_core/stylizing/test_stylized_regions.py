"""Tests of jobs with regions, and with several styles: frozen regions do not change, others approach their styles."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from sgsst_core.constants import SH_C0
from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.regions import Region, RegionMaps, Regions
from sgsst_core.scene.colors import resize_area, style_size
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import MAX_RESOLUTION, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.checkpoint import Checkpoint, Checkpoints, fingerprint, load_checkpoint, versions
from sgsst_core.stylizing.job import JobInputs, check_style_size, prepare_job, prepared_style, rotated
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.stylizer import Stylizer, neighbors_change_by_region
from tests.small_scenes import ball, cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


def other_style() -> Tensor:
    return style().flip(0, 2) ** 2


def halves(scene: Scene, left: Region | None = None, right: Region | None = None) -> Regions:
    """Return the regions left and right of x = 0, of which the left one is the background."""
    labels = (scene.means[:, 0] >= 0).to(torch.uint8)
    return Regions((left or Region("rest"), right or Region("right", style=Style.of(other_style()))), labels)


def make(weights: BackboneWeights, scene: Scene, regions: Regions | None, image: Tensor | None = None, **values: Any):
    settings = make_settings(**{"steps_coarse": 2, "steps_sos": 4, "coarsest_side": 24, **values})
    image = style() if image is None else image
    return Stylizer.planned(scene, cameras(), image, settings, weights=weights, regions=regions)


# --- maps ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "background"), [("cpu", (0.0, 0.0, 0.0)), ("cached", (0.3, 1.0, 0.1)), ("reference", (0.3, 1.0, 0.1))]
)
def test_maps_sum_to_the_coverage(name: Any, background: tuple[float, float, float]) -> None:
    scene, (view, *_) = ball(), cameras()
    labels = torch.arange(len(scene), dtype=torch.uint8) % 5
    labels[labels == 4] = 200
    rasterizer = make_rasterizer(name, scene, background=background)
    maps = RegionMaps(labels, (0, 1, 2, 3, 200), rasterizer).render(view)
    assert maps.shape == (view.height, view.width, 5)
    torch.testing.assert_close(maps.sum(dim=2), rasterizer.coverage(view), atol=1e-5, rtol=0)
    black = make_rasterizer("cpu", scene)
    alone = black.render((labels == 200).float()[:, None].expand(-1, 3).contiguous(), view)[:, :, 0]
    torch.testing.assert_close(maps[:, :, 4].float(), alone, atol=1e-5, rtol=0)
    assert bool((maps[rasterizer.coverage(view) == 0] == 0).all())


def test_maps_are_exactly_0_outside_of_the_region() -> None:
    scene, (view, *_) = wall(), cameras()
    labels = (scene.means[:, 0] > 0.5).to(torch.uint8)
    rasterizer = make_rasterizer("cpu", scene, background=(0.2, 0.4, 0.6))
    maps = RegionMaps(labels, (0, 1), rasterizer).render(view)
    assert bool((maps[:, : view.width // 4, 1] == 0).all())
    assert float(maps[:, -4:, 1].min()) > 0.9


# --- frozen regions ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frozen_region", "values"),
    [
        ("rest", {"warm_start": True, "clamp_aware_gradient": True}),
        ("right", {"unseen": "neighbors", "views_per_step": 2, "background": (1.0, 0.5, 0.0)}),
        ("right", {"cached_weights": "half", "preserve_colors": "match", "style_loss": "mixed"}),
    ],
)
def test_frozen_gaussians_stay_bit_identical(
    tiny_weights: BackboneWeights, frozen_region: str, values: dict[str, Any]
) -> None:
    scene = wall(60, 40, sh_degree=1)  # extends beyond the views
    scene.sh_dc[::7] = -0.0
    keep = {"left": Region("rest", freeze=True)} if frozen_region == "rest" else {"right": Region("right", freeze=True)}
    regions = halves(scene, **keep)
    stylizer = make(tiny_weights, scene, regions, **values)
    assert run(stylizer) == "finished"
    bits, before = stylizer.stylized().view(torch.int32), scene.sh_dc.view(torch.int32)
    assert torch.equal(bits[regions.frozen], before[regions.frozen])
    changed = (bits != before).any(dim=1)
    assert bool(changed[stylizer.job.plan.optimized].all())
    assert bool(changed[~regions.frozen].all()) == (values.get("unseen") != "freeze")
    assert not bool((stylizer.job.plan.optimized & regions.frozen).any())


# --- styles of regions ---------------------------------------------------------------------------------------------


def test_region_of_everything_is_bit_identical_to_no_regions(tiny_weights: BackboneWeights) -> None:
    """Results are bit-identical, including unseen Gaussians."""
    scene = wall(60, 40, sh_degree=1)
    whole = Regions(
        (Region("rest"), Region("all", style=Style.of(other_style()))), torch.ones(len(scene), dtype=torch.uint8)
    )
    actual, wanted = make(tiny_weights, scene, whole), make(tiny_weights, scene, None, other_style())
    for stylizer in (actual, wanted):
        run(stylizer)
    assert torch.equal(actual.stylized(), wanted.stylized())
    assert [record.loss for record in actual.history] == [record.loss for record in wanted.history]


def test_each_region_approaches_its_own_style(tiny_weights: BackboneWeights) -> None:
    """A region does not approach another region's style; the styles are a uniform dark and a uniform bright image."""
    scene = wall()
    dark, bright = torch.full((40, 40, 3), 0.1), torch.full((40, 40, 3), 0.9)
    regions = halves(scene, right=Region("right", style=Style.of(bright)))
    stylizer = make(tiny_weights, scene, regions, dark, steps_sos=60, content_weight=0.0, early_stop=False)
    run(stylizer)
    labels, stylized = regions.labels[stylizer.job.plan.seen], stylizer.stylized()[stylizer.job.plan.seen]
    far = scene.means[stylizer.job.plan.seen][:, 0].abs() > 0.5  # features at the border see both regions
    left, right = (float((0.5 + 0.28209479 * stylized[(labels == place) & far]).mean()) for place in (0, 1))
    assert left < 0.4 < 0.6 < right


# --- resuming, reference and plan ----------------------------------------------------------------------------------


def test_unseen_gaussians_follow_their_own_region() -> None:
    means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.9, 0, 0], [0.1, 0, 0], [5, 0, 0]])
    change = torch.tensor([[1.0] * 3, [2.0] * 3, [0.0] * 3, [0.0] * 3, [0.0] * 3])
    weights = torch.tensor([1.0, 1, 0, 0, 0]).double()
    labels = torch.tensor([0, 1, 0, 1, 2], dtype=torch.uint8)
    regions = Regions((Region("rest"), Region("a"), Region("b", freeze=True)), labels)
    result = neighbors_change_by_region(means, change, weights, regions)
    assert result[2:, 0].tolist() == [1.0, 2.0, 0.0]
    without = replace(regions, labels=torch.tensor([0, 0, 1, 0, 2], dtype=torch.uint8))
    result = neighbors_change_by_region(means, change, weights, without)
    assert result[2, 0] == 1.5  # nothing in its region is optimized


def test_resumed_job_is_bit_identical(tiny_weights: BackboneWeights, tmp_path: Path) -> None:
    scene = wall()
    regions = halves(scene, left=Region("rest", weight=2.0))
    whole, first = (make(tiny_weights, scene, regions) for _ in range(2))
    run(whole)
    for _ in range(3):
        first.run_step()
    Checkpoints(tmp_path / "c").save(Checkpoint(first.state(), first.job.plan, 1, "r", versions()), "job")
    checkpoint = load_checkpoint(tmp_path / "c", "job")
    again = Stylizer(
        prepare_job(
            checkpoint.plan,
            JobInputs(scene, cameras(), Style.of(style()), first.job.settings, weights=tiny_weights, regions=regions),
        )
    )
    again.load_state(checkpoint.state)
    run(again)
    assert torch.equal(again.stylized(), whole.stylized())


_OTHER_TREATMENT: dict[str, Any] = {"weight": 2.0, "style": None, "freeze": True, "content_weight": 1.0}


def test_fingerprint_depends_on_regions() -> None:
    scene, views, settings = wall(), cameras(), make_settings()
    regions = halves(scene)
    moved = replace(regions, labels=1 - regions.labels)
    right = regions.every[1]
    others = [replace(right, **{name: value}) for name, value in _OTHER_TREATMENT.items()]
    every = [None, regions, moved, *(replace(regions, every=(regions.every[0], other)) for other in others)]
    fingerprints = [fingerprint(scene, views, Style.of(style()), settings, "w", "", each) for each in every]
    assert len(set(fingerprints)) == len(every)
    assert fingerprints[0] == fingerprint(scene, views, Style.of(style()), settings, "w")


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
