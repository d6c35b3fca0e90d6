"""Tests of the planner's probe: its measurements, the views it uses, and the data that a job reuses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from sgsst_core.errors import CameraError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import ALIGNMENT, has_bfloat16_instructions
from sgsst_core.loss.sos import SosLoss
from sgsst_core.parallel.collectives import ALONE
from sgsst_core.planning.context import PlanningContext, equip
from sgsst_core.planning.facts import Link, Rate
from sgsst_core.planning.planner import make_plan
from sgsst_core.planning.probe import _side, measure, measure_rate
from sgsst_core.planning.survey import progress_of, survey_views
from sgsst_core.progress import Progress
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.tile_intersections import build_tile_intersections
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import prepare_job
from sgsst_core.stylizing.stylizer import Stylizer
from sgsst_core.timing import Timer
from tests.small_scenes import ball, blind_camera, cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")

FREE = Link(float("inf"), 0.0)


def equipped(weights: BackboneWeights, scene: Scene, **values: Any) -> PlanningContext:
    return equip(scene, cameras(3), make_settings(**values), weights, ALONE)


def test_probe_contains_the_measured_facts(tiny_weights: BackboneWeights) -> None:
    scene = replace(wall(), sh_rest=torch.zeros(len(wall()), 15, 3))
    planning_context = equipped(tiny_weights, scene, memory_limit=10**9)
    probe = measure(planning_context, survey_views(scene, planning_context.cameras, planning_context.rasterizer), FREE)
    assert (probe.scene.gaussians, probe.scene.sh_degree, probe.scene.used_degree) == (len(scene), 3, 0)
    assert probe.sizes == tuple((camera.height, camera.width) for camera in cameras(3))
    assert (probe.network.halo, probe.network.held_bytes) == (
        planning_context.network.halo,
        planning_context.network.held_bytes_per_pixel(),
    )
    assert 0 < probe.network.rate.forward < 10 * probe.network.rate.both
    assert 0 < probe.network.rate.features < 10 * probe.network.rate.forward
    assert probe.network.fixed == Rate(0.0, 0.0, 0.0)
    assert (probe.network.precision_ratio is None) == (not has_bfloat16_instructions("cpu"))
    assert probe.network.gradient_error is None
    assert probe.device_bytes == 0
    assert probe.raster.bytes is not None
    assert probe.raster.half_bytes is not None
    assert 0 < probe.raster.half_bytes < probe.raster.bytes
    assert probe.raster.seconds > 0
    sizes = [build_tile_intersections(scene, camera).nbytes for camera in cameras(3)]
    assert probe.raster.intersection_bytes == sum(sizes) // 3
    assert probe.raster.first_seconds > 0 < probe.raster.colors_seconds
    assert (probe.machine.memory_limit, probe.machine.memory, probe.machine.ranks) == (10**9, 10**9, 1)
    assert (probe.raster.fixed, probe.raster.first_fixed) == (0.0, 0.0)
    assert probe.process_bytes > 10**7


def test_time_that_does_not_depend_on_pixels_is_measured_for_several_ranks(tiny_weights: BackboneWeights) -> None:
    scene = wall()
    two = equipped(tiny_weights, scene)
    two = replace(two, machine=replace(two.machine, ranks=2))
    raster = measure(two, survey_views(scene, two.cameras, two.rasterizer), FREE).raster
    assert 0 < raster.fixed <= raster.seconds
    assert 0 < raster.first_fixed <= raster.first_seconds


def test_feature_matching_is_timed_separately(tiny_weights: BackboneWeights) -> None:
    scene = wall()
    survey = survey_views(scene, cameras(3), make_rasterizer("cpu", scene))
    plain, nnfm, mixed = (
        measure(equipped(tiny_weights, scene, style_loss=style_loss, precision="bfloat16"), survey, FREE).network
        for style_loss in ("sos", "nnfm", "mixed")
    )
    assert (plain.rate.search, plain.vector_channels, plain.deepest) == (0.0, 0, "relu5_1")
    assert nnfm.rate.search > 0 < mixed.rate.search
    assert (nnfm.vector_channels, nnfm.deepest) == (48, "relu4_2")
    assert (mixed.vector_channels, mixed.deepest) == (48, "relu5_1")


def test_synthetic_images_are_as_large_as_the_device_needs(tiny_weights: BackboneWeights) -> None:
    """On a GPU, images are as large as the memory for their activations allows.

    `measure_rate` also limits them to the size of the views.
    """
    planning_context = equipped(tiny_weights, wall(), memory_limit=10**9)
    on_gpu = replace(planning_context, machine=replace(planning_context.machine, device="cuda"))
    network = planning_context.network
    a_pixel = network.held_bytes_per_pixel() + network.working_bytes_per_pixel()
    for memory, on_cpu, with_gpu in ((1 << 40, 384, 2048), (int(500.5**2 * a_pixel), 384, 500), (1, 384, ALIGNMENT)):
        loss = SosLoss(network, memory=memory)
        assert (_side(planning_context, loss), _side(on_gpu, loss)) == (on_cpu, with_gpu)


def test_fastest_run_of_the_network_counts(tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first run is a warm-up; two runs with gradient, two without, and two of the network alone follow."""
    taken = iter([1.0, 5.0, 3.0, 4.0, 2.0, 1.0, 1.5])

    class Clock(Timer):
        def read(self) -> dict[str, float]:
            return {**super().read(), "evaluation": next(taken)}

    monkeypatch.setattr("sgsst_core.planning.probe.Timer", Clock)
    loss = SosLoss(equipped(tiny_weights, wall()).network, memory=1 << 30)
    assert measure_rate(loss, 64) == Rate(1.0 / 64**2, 2.0 / 64**2, 3.0 / 64**2)
    assert next(taken, None) is None


def test_survey_counts_the_gaussians_that_a_view_shows() -> None:
    scene, views = wall(), [*cameras(2), blind_camera()]
    rasterizer = make_rasterizer("reference", scene)
    ones = torch.ones(views[0].height, views[0].width, 3)
    counts = [int((rasterizer.color_gradient(ones, camera)[:, 0] > 0).sum()) for camera in views[:2]]
    assert survey_views(scene, views, make_rasterizer("cpu", scene)).shown == sum(counts) / 2
    assert 0 < sum(counts) < 2 * len(scene)


def test_survey_reports_its_progress() -> None:
    scene, reports = wall(), list[Progress]()
    survey_views(scene, cameras(3), make_rasterizer("cpu", scene), show=reports.append)
    assert [(progress.step, progress.total) for progress in reports] == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert reports[0].eta_s is None
    assert all(progress.eta_s is not None for progress in reports[1:])
    assert reports[1].eta_s > 0  # type: ignore[operator]
    assert reports[-1].eta_s == 0
    assert [progress.fraction for progress in reports] == [0, 1 / 3, 2 / 3, 1]


def test_progress_assumes_that_other_ranks_are_as_fast() -> None:
    assert progress_of(0, 5, 2, 0.1) == Progress(stage="planning", step=0, total=5)
    assert progress_of(2, 5, 2, 4.0) == Progress(stage="planning", step=4, total=5, eta_s=1.0)
    assert progress_of(3, 5, 2, 6.0) == Progress(stage="planning", step=5, total=5, eta_s=0.0)


def test_plan_requires_cameras_that_see_the_scene(tiny_weights: BackboneWeights) -> None:
    for views, message in (([], "There are no cameras"), ([blind_camera()], "None of the 1 cameras sees")):
        with pytest.raises(CameraError, match=message):
            make_plan(wall(), views, make_settings(), weights=tiny_weights)


def test_earlier_survey_is_reused(tiny_weights: BackboneWeights) -> None:
    scene, settings, reports = wall(), make_settings(), list[Progress]()
    first, _ = make_plan(scene, cameras(2), settings, weights=tiny_weights)
    second, _ = make_plan(scene, cameras(2), settings, weights=tiny_weights, survey=first.survey, show=reports.append)
    assert reports == [Progress(stage="probing")]
    assert second.survey is first.survey
    assert torch.equal(second.seen, first.seen)


@pytest.mark.parametrize("cached", ["none", "float32"])
def test_job_reuses_objects_of_the_planning_context(tiny_weights: BackboneWeights, cached: str) -> None:
    """The probe passes on the network, and the tile intersections if every Gaussian is rendered."""
    for scene, reused in ((ball(), True), (wall(), False)):
        settings = make_settings(cached_weights=cached)
        plan, planning_context = make_plan(scene, cameras(2), settings, weights=tiny_weights)
        inputs = (plan, scene, cameras(2), Style.of(style()), settings)
        used, fresh = (
            Stylizer(prepare_job(*inputs, weights=tiny_weights, planning_context=context))
            for context in (planning_context, None)
        )
        assert bool(plan.seen.all()) is reused
        assert used.job.network is planning_context.network
        rasterizer = used.job.views.rasterizer
        own = rasterizer if isinstance(rasterizer, CpuRasterizer) else rasterizer.uncached  # type: ignore[attr-defined]
        assert (own is planning_context.rasterizer) is reused
        assert used.run_step().loss == fresh.run_step().loss
        assert torch.equal(used.sh_dc, fresh.sh_dc)


def test_requested_rasterizer_is_measured_and_used(tiny_weights: BackboneWeights) -> None:
    settings = make_settings(cached_weights="none")
    stylizer = Stylizer.planned(wall(), cameras(1), style(), settings, weights=tiny_weights, rasterizer="reference")
    assert stylizer.job.views.rasterizer.name == stylizer.job.plan.rasterizer == "reference"
