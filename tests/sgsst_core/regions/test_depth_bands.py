"""Tests of depth bands: strokes of the same size in the scene, compared with a float64 reference."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from benchmarks.stability.sos_reference import StyledWeights, sos_reference
from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.scale_weights import band_count, check_stroke_depth
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.targets import by_band
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.regions import maps as module
from sgsst_core.regions.maps import DepthBands, mean_level
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.stylizer import Stylizer
from tests.sgsst_core.splat_scenes import camera, cloud, rotated_pose
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import cameras, style, wall

SIZE = (112, 150)


def near_and_far() -> Scene:
    """Return two halves of a wall, the right one four times as far away and as large."""
    scene = wall()
    far = scene.means[:, 0] > 0
    factor = torch.where(far, 4.0, 1.0)[:, None]
    return replace(scene, means=scene.means * factor, scales=scene.scales + factor.log())


def level_of(mean: Tensor, view: Camera) -> float:
    depth = float((view.world_to_camera.double() @ torch.cat([mean.double(), torch.ones(1)]))[2])
    return math.log2(math.sqrt(view.fx * view.fy) / depth)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_bands_are_proportions_that_add_up_to_the_coverage(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CHUNK", 37)
    scene, view = cloud(200), camera(pose=rotated_pose())
    reference = ReferenceRasterizer(scene, background=(0.2, 0.4, 0.6))
    bands = DepthBands(count, 3.7, reference)
    fractions = torch.stack([bands.fractions(band, view) for band in range(count)], dim=1)
    assert torch.allclose(fractions.sum(dim=1), torch.ones(200, dtype=torch.float64), atol=1e-12)
    front = [j for j in range(200) if bands._means[j].double() @ view.world_to_camera[2, :3] > 0.2]
    for j in front[:40]:  # by the definition
        level = min(max(level_of(scene.means[j], view) - 3.7 + (count - 1) / 2, 0), count - 1)
        expected = [max(0.0, 1 - abs(level - band)) for band in range(count)]
        assert fractions[j].tolist() == pytest.approx(expected, abs=1e-9)
    maps = bands.render(view)
    assert torch.allclose(maps.sum(dim=2), reference.coverage(view), atol=1e-9)
    fast = DepthBands(count, 3.7, CpuRasterizer(scene, background=(0.2, 0.4, 0.6))).render(view)
    assert torch.allclose(fast.double(), maps, atol=2e-5)


def test_larger_scenes_and_views_shift_all_levels_alike() -> None:
    """A scene of any unit has the same bands, and views of twice the pixels have levels that are higher by 1."""
    scene, views, weights = cloud(300), [camera(), camera(pose=rotated_pose())], torch.ones(300, dtype=torch.float64)
    level = mean_level(scene.means, weights, views)
    poses = [view.world_to_camera.clone() for view in views]
    for pose in poses:
        pose[:3, 3] *= 8
    moved = [replace(view, world_to_camera=pose) for view, pose in zip(views, poses, strict=True)]
    assert mean_level(8 * scene.means, weights, moved) == pytest.approx(level - 3, abs=1e-9)
    double = [
        replace(view, **{name: 2 * getattr(view, name) for name in ("width", "height", "fx", "fy", "cx", "cy")})
        for view in views
    ]
    assert mean_level(scene.means, weights, double) == pytest.approx(level + 1, abs=1e-9)


def test_mean_level_is_that_of_what_the_views_show() -> None:
    scene, view = cloud(300), camera(pose=rotated_pose())
    weights = torch.rand(300, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    weights[::3] = 0
    total = summed = 0.0
    for mean, weight in zip(scene.means, weights.tolist(), strict=True):
        x, y, z = (view.world_to_camera.double() @ torch.cat([mean.double(), torch.ones(1)]))[:3].tolist()
        if z > 0 and 0 < view.fx * x / z + view.cx < view.width and 0 < view.fy * y / z + view.cy < view.height:
            total += weight * level_of(mean, view)
            summed += weight
    assert summed > 10
    assert mean_level(scene.means, weights, [view]) == pytest.approx(total / summed, abs=1e-9)


def test_mean_level_ignores_what_the_near_plane_cuts() -> None:
    view = camera()
    to_world = view.world_to_camera.double().inverse()
    far, near = (to_world @ torch.tensor([0, 0, depth, 1.0], dtype=torch.float64) for depth in (5.0, 1e-6))
    means, weights = torch.stack([far, far, near])[:, :3].float(), torch.ones(3, dtype=torch.float64)
    assert mean_level(means, weights, [view]) == mean_level(means[:2], weights[:2], [view])


@pytest.mark.parametrize("bands", [2, 4])
def test_loss_of_bands_agrees_with_the_float64_reference(tiny_weights: BackboneWeights, bands: int) -> None:
    """The reference compares each scale with the style in its own band; missing scales count as the coarsest."""
    image, content, own = (synthetic_image(*SIZE, seed=seed) for seed in (5, 6, 7))
    raw = torch.stack([synthetic_image(*SIZE, seed=10 + band)[:, :, 0] ** 4 for band in range(bands)])
    parts = list(raw / raw.sum(dim=0))
    loss = SosLoss(FeatureNetwork(tiny_weights, dtype=torch.float64), coarsest=60, tile_size=64)
    view = loss.targets.of_view(content)
    view.regions = [loss.targets.position_weights(part) for part in parts]
    actual = loss.evaluate(image, by_band(loss.targets.of_style(Style.of(own), SIZE), bands), view)
    assert actual.scales == (0, 1)
    values, gradients = [], []
    for scale in (0, 1):
        weighted = [StyledWeights(own, part) for band, part in enumerate(parts) if min(band, 1) == scale]
        only = [float(other == scale) for other in (0, 1)]
        value, gradient = sos_reference(tiny_weights, image, weighted, content, coarsest=60, scales=only)
        values.append(value)
        gradients.append(gradient)
    assert actual.loss == pytest.approx(sum(values) / 2, rel=1e-9)
    assert actual.image_gradient is not None
    assert relative_error(actual.image_gradient, (gradients[0] + gradients[1]) / 2) < 1e-9
    single = SosLoss(FeatureNetwork(tiny_weights), coarsest=60)
    targets = by_band(single.targets.of_style(Style.of(own.float()), SIZE), bands)
    view = single.targets.of_view(content.float())
    view.regions = [single.targets.position_weights(part) for part in parts]
    fast = single.evaluate(image.float(), targets, view)
    assert fast.image_gradient is not None
    assert fast.loss == pytest.approx(actual.loss, rel=1e-5)
    assert relative_error(fast.image_gradient, actual.image_gradient) < 1e-5


@pytest.mark.usefixtures("one_thread")
def test_coarse_scales_see_near_parts_and_fine_scales_far_ones(tiny_weights: BackboneWeights) -> None:
    settings = make_settings(steps_coarse=0, steps_sos=2, early_stop=False, stroke_depth=True, coarsest_side=24)
    scene = near_and_far()
    stylizer = Stylizer.planned(scene, cameras(), style(), settings, weights=tiny_weights)
    job = stylizer.job
    bands = job.view_targets.region_weights(1)
    assert bands is not None
    assert len(bands) == band_count(cameras(), settings) >= 2
    half = bands[0][0].shape[1] // 2
    near, far = (
        [float(band[0][:, part].mean()) for band in bands] for part in (slice(0, half - 4), slice(half + 4, None))
    )
    assert sum(near[len(near) // 2 :]) > 0.9 * sum(near)
    assert sum(far[: (len(far) + 1) // 2]) > 0.9 * sum(far)
    (line,) = (each for each in job.plan.decisions if each.item == "stroke depth")
    assert "same size" not in line.decision
    assert line.reason == "requested"
    run(stylizer)
    without = Stylizer.planned(
        scene, cameras(), style(), settings.model_copy(update={"stroke_depth": False}), weights=tiny_weights
    )
    assert without.job.view_targets.region_weights(1) is None
    run(without)
    assert not torch.equal(stylizer.stylized(), without.stylized())
    assert bool(stylizer.stylized().isfinite().all())


def test_settings_that_leave_no_choice_of_scales_are_refused() -> None:
    views = cameras()
    check_stroke_depth(make_settings(), views, regions=True)
    check_stroke_depth(make_settings(stroke_depth=True, coarsest_side=24), views, regions=False)
    for values, regions, message in (
        ({"coarsest_side": 4096}, False, "at least two scales"),
        ({"coarsest_side": 24}, True, "--stroke-depth and --region both weight positions"),
        ({"coarsest_side": 24, "scales": (1.0, 0.5)}, False, "--stroke-depth and --scales both weight positions"),
    ):
        with pytest.raises(SettingsError, match=message):
            check_stroke_depth(make_settings(stroke_depth=True, **values), views, regions=regions)
