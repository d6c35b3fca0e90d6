"""Tests that gradients, losses and whole jobs on several ranks equal those on one rank, for any division of work."""

import functools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import layers_of
from sgsst_core.parallel import ALONE, Collectives, Divider, Tiling
from sgsst_core.planning.survey import survey_views
from sgsst_core.rasterizer import RASTERIZERS, make_rasterizer
from sgsst_core.regions import Region, Regions
from sgsst_core.scales import EVEN, ScaleWeights
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.colors import gray
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import StyleLossName, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import JobInputs, plan_job, prepare_job
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.styles import JobStyles
from sgsst_core.stylizing.stylizer import Stylizer
from sgsst_core.stylizing.views import Views, ViewTargets
from tests.networks import comparing_pixels, tiny_weights
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer
from tests.sgsst_core.stylizing.test_refining import on_a_rank
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import ball, cameras, style, wall
from tests.worker.ranks.spawn import on_ranks

pytestmark = pytest.mark.usefixtures("one_thread")

#: Maximum relative error of the color gradient compared with that of one rank.
BOUNDS = {torch.float32: 1e-5, torch.float64: 1e-9}


def gradient(
    collectives: Collectives,
    scene: Scene,
    camera: Camera,
    dtype: torch.dtype,
    tile_size: int | None,
    memory: int = 1 << 34,
    style_loss: StyleLossName = "sos",
    regions: Regions | None = None,
    scales: tuple[int, ...] | None = None,
    coarsest: int = 40,
    scale_weights: ScaleWeights = EVEN,
) -> tuple[Tensor, float, list[bool]]:
    """Return the color gradient [N, 3] and the SOS loss of one view at some scales, or at all two or three.

    Also return for each of this rank's tiles whether its activations are cached.
    """
    weights = comparing_pixels(tiny_weights())
    network = FeatureNetwork(weights, layers_of(style_loss, weights, content=True), dtype)
    loss = SosLoss(
        network,
        style_loss=style_loss,
        memory=memory,
        tile_size=tile_size,
        coarsest=coarsest,
        scales=scale_weights,
        collectives=collectives,
    )
    rasterizer = make_rasterizer("cpu", scene) if dtype == torch.float32 else ReferenceRasterizer(scene)
    survey = survey_views(scene, [camera], rasterizer)
    weighted = survey.uncovered_fraction > 0.01
    style_images = Style.of(synthetic_image(90, 110, seed=4, dtype=dtype))
    regions = regions and regions.resolved(survey.total_blend_weights)
    styles = JobStyles.prepared(style_images, regions, make_settings(), scene.sh_dc, survey.total_blend_weights)
    views = Views(
        scene,
        [camera],
        rasterizer,
        covered=[0],
        regions=survey.regions if weighted else None,
        divider=loss.divider,
    )
    view_targets = ViewTargets(
        views,
        loss,
        weighted=weighted,
        regions=survey.regions if weighted else None,
        maps=styles.maps(rasterizer),
        content_maps=styles.content_maps(rasterizer),
    )
    scales = scales or tuple(loss.tiling.scales((camera.height, camera.width)))
    target = view_targets.target(0, scales)
    targets = styles.targets(loss, (camera.height, camera.width))
    colors = views.colors(0, torch.roll(scene.sh_dc, 1, dims=0).to(dtype))
    result = loss.evaluate(views.render(0, colors), targets, target, scales)
    assert result.image_gradient is not None
    assert target.division is not None
    cached = loss.tiling.cached([tile.outer.pixels for tiles in target.division.tiles.values() for tile in tiles])
    return views.gradient(0, result.image_gradient, colors), result.loss, cached


def assert_ranks_agree(
    ranks: int, computed: Callable[..., tuple[Tensor, float, list[bool]]], *arguments: Any, bound: float = 1e-9
) -> list[tuple[Tensor, float, list[bool]]]:
    """Assert that all ranks compute the same gradient, and gradient and loss of one rank; return their results."""
    expected, loss, _ = computed(ALONE, *arguments)
    results = on_ranks(ranks, computed, *arguments)
    for actual, actual_loss, _ in results:
        assert relative_error(actual, expected) < bound
        assert actual_loss == pytest.approx(loss, rel=bound)
        assert torch.equal(actual, results[0][0])
    return results


@pytest.mark.parametrize(
    ("dtype", "ranks", "width", "height", "tile_size", "scene"),
    [
        (torch.float32, 2, 128, 96, None, wall(sh_degree=1)),
        (torch.float32, 3, 128, 96, 64, wall()),
        (torch.float64, 4, 101, 83, None, wall()),
        (torch.float64, 2, 150, 70, 48, ball()),
        (torch.float64, 4, 48, 36, None, wall()),  # fewer rows of raster tiles than ranks, and hardly more cells
        (torch.float32, 4, 17, 15, None, wall()),  # a single work unit
    ],
)
def test_gradient_matches_one_rank(
    dtype: torch.dtype, ranks: int, width: int, height: int, tile_size: int | None, scene: Scene
) -> None:
    camera = cameras(1, width, height)[0]
    assert_ranks_agree(ranks, gradient, scene, camera, dtype, tile_size, bound=BOUNDS[dtype])


@pytest.mark.parametrize("style_loss", ["sos", "mixed"])
def test_gradient_with_regions_matches_one_rank(style_loss: StyleLossName) -> None:
    """Some of the three ranks have no pixel of a region, and one region is frozen."""
    scene, camera = wall(), cameras(1, 128, 96)[0]
    other = Style.of(synthetic_image(64, 80, seed=5, dtype=torch.float64))
    every = (Region("rest"), Region("a", style=other, weight=3.0, content_weight=50.0), Region("b", freeze=True))
    labels = (scene.means[:, 1] > 0.8).to(torch.uint8) + 2 * (scene.means[:, 0] > 1).to(torch.uint8)
    regions = Regions(every, labels.clamp(max=2))
    arguments = scene, camera, torch.float64, 48, 1 << 34, style_loss, regions
    assert_ranks_agree(3, gradient, *arguments)


@pytest.mark.parametrize(
    ("scales", "coarsest", "scale_weights", "scene"),
    [
        ((0,), 40, EVEN, ball()),
        ((1, 2), 20, EVEN, ball()),
        ((0, 2), 20, EVEN, wall()),
        ((5,), 4, EVEN, wall()),  # its blocks are larger than the multiples of 16 pixels at which views are divided
        (None, 20, ScaleWeights((0.0, 1.0, 2.0)), ball()),  # full size is not computed
    ],
)
def test_gradient_of_some_scales_matches_one_rank(
    scales: tuple[int, ...] | None, coarsest: int, scale_weights: ScaleWeights, scene: Scene
) -> None:
    arguments = scene, cameras(1, 157, 131)[0], torch.float64, None, 1 << 34
    some = functools.partial(gradient, scales=scales, coarsest=coarsest, scale_weights=scale_weights)
    assert_ranks_agree(3, some, *arguments)


def test_partly_cached_activations_preserve_the_gradient() -> None:
    scene, camera = wall(), cameras(1, 128, 96)[0]
    memory = int(20_000 * FeatureNetwork(tiny_weights(), dtype=torch.float64).held_bytes_per_pixel())
    results = assert_ranks_agree(2, gradient, scene, camera, torch.float64, 48, memory)
    assert {flag for result in results for flag in result[2]} == {True, False}


@pytest.mark.parametrize("style_loss", ["nnfm", "mixed"])
def test_gradient_of_matched_features_matches_one_rank(style_loss: StyleLossName) -> None:
    """One of the three ranks has almost no features to match."""
    scene, camera = ball(), cameras(1, 128, 96)[0]
    arguments = scene, camera, torch.float64, 48, 1 << 34, style_loss
    assert_ranks_agree(3, gradient, *arguments)


def stylize(
    collectives: Collectives, scene: Scene, views: int, values: dict[str, Any], image: Tensor | None = None
) -> dict[str, Any]:
    """Run a whole job, by default in `style()`."""
    settings = make_settings("standard", **{"coarsest_side": 40, **values})
    image = style() if image is None else image
    stylizer = Stylizer.planned(scene, cameras(views), image, settings, weights=tiny_weights(), collectives=collectives)
    stopped = run(stylizer)
    return {
        "stopped": stopped,
        "colors": stylizer.stylized(),
        "losses": [record.loss for record in stylizer.history],
        "views": [record.view for record in stylizer.history],
        "after": stylizer.evaluate(stylizer.job.evaluation_views),
        "plan": [decision.item for decision in stylizer.job.plan.decisions],
    }


def test_refinement_matches_one_rank() -> None:
    alone = on_a_rank(ALONE, 2.0)
    assert alone is not None
    assert alone.split > 0
    for refinement in on_ranks(2, on_a_rank, 2.0):
        assert torch.equal(refinement.pieces, alone.pieces)
        assert refinement.psnr == pytest.approx(alone.psnr, abs=1e-6)


VIEWS_PER_STEP = (1, 2, 3, 4, 8)


def stylize_each(collectives: Collectives) -> list[dict[str, Any]]:
    """Run a whole job for each number of views per step, and compute its gradient in its end in float64."""
    results = []
    for count in VIEWS_PER_STEP:
        own: dict[str, Any] = {"steps_coarse": 1, "steps_sos": 1, "learning_rate": 0.01, "views_per_step": count}
        settings = make_settings("standard", coarsest_side=40, early_stop=False, **own)
        inputs, weights = (wall(), cameras(8), Style.of(style().double()), settings), tiny_weights()
        job = plan_job(JobInputs(*inputs, weights=weights), collectives=collectives)
        stylizer = Stylizer(job)
        run(stylizer)
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(RASTERIZERS, ReferenceRasterizer.name, ReferenceRasterizer)
            plan = replace(job.plan, uncached=ReferenceRasterizer.name, cached_weights="none")
            exact = prepare_job(plan, JobInputs(*inputs, weights=weights), collectives=collectives)
        exact.loss.network = FeatureNetwork(weights, job.network.layers, torch.float64)
        other = Stylizer(replace(exact, network=exact.loss.network))
        other.sh_dc = torch.nn.Parameter(torch.roll(other.sh_dc.detach(), 1, dims=0).double())
        views = list(range(count))
        results.append(
            {
                "losses": [record.loss for record in stylizer.history],
                "views": [record.view for record in stylizer.history],
                "colors": stylizer.stylized(),
                "exact": other._mean_gradient(views, job.schedule[-1])[0],
            }
        )
    return results


@functools.cache
def alone() -> list[dict[str, Any]]:
    results = stylize_each(ALONE)
    assert len({tuple(result["losses"]) for result in results}) == len(results)
    return results


@pytest.mark.parametrize("ranks", [2, 3, 8])
def test_jobs_of_any_shape_match_one_rank(ranks: int) -> None:
    by_rank = on_ranks(ranks, stylize_each)
    for results in by_rank:
        for actual, first, expected in zip(results, by_rank[0], alone(), strict=True):
            assert actual["losses"] == pytest.approx(expected["losses"], rel=BOUNDS[torch.float32])
            assert actual["views"] == expected["views"]
            assert relative_error(actual["colors"], expected["colors"]) < BOUNDS[torch.float32]
            assert torch.equal(actual["colors"], first["colors"])
            assert actual["exact"].dtype == torch.float64
            assert relative_error(actual["exact"], expected["exact"]) < BOUNDS[torch.float64]


def mean_gradient_by_hand(views: list[int]) -> Tensor:
    scene = wall()
    settings = make_settings("standard", steps_coarse=0, steps_sos=1, coarsest_side=40)
    stylizer = Stylizer.planned(scene, cameras(5), style(), settings, weights=tiny_weights())
    gradients = [stylizer.gradient(view, stylizer.job.scales(view))[0] for view in views]
    return torch.stack(gradients).mean(dim=0)


def test_gradients_of_views_in_a_step_are_averaged() -> None:
    scene = wall()
    settings = make_settings(
        "standard", steps_coarse=0, steps_sos=1, coarsest_side=40, views_per_step=3, scale_sampling=1
    )
    stylizer = Stylizer.planned(scene, cameras(5), style(), settings, weights=tiny_weights())
    order = Stylizer.planned(scene, cameras(5), style(), settings, weights=tiny_weights())
    views = [order._order.next_view() for _ in range(3)]
    stylizer.run_step()
    assert stylizer.sh_dc.grad is not None
    assert relative_error(stylizer.sh_dc.grad, mean_gradient_by_hand(views)) < 1e-6


def planned_in_groups(collectives: Collectives) -> dict[str, Any]:
    """Plan a job of small views whose steps are not given, and plan it again as after the loss of a rank."""
    inputs = wall(), cameras(4), Style.of(style())
    settings = make_settings(coarsest_side=24, measure=0)
    job = plan_job(JobInputs(*inputs, settings, weights=tiny_weights()), collectives=collectives)
    resumed = plan_job(JobInputs(*inputs, settings, weights=tiny_weights()), groups=job.plan.groups)
    stylizer = Stylizer(job)
    losses = [stylizer.run_step().loss for _ in range(2)]
    shape = job.plan.groups, job.team.groups, job.settings.views_per_step, job.total_steps
    again = resumed.plan.groups, resumed.settings.views_per_step, resumed.total_steps
    return {"shape": shape, "resumed": again, "losses": losses, "colors": stylizer.stylized()}


def test_plan_gives_each_rank_a_view_of_its_own() -> None:
    first, second = on_ranks(2, planned_in_groups)
    assert first["shape"] == second["shape"] == (2, 2, 2, 127)
    assert (first["resumed"], first["losses"]) == ((2, 2, 127), second["losses"])
    assert torch.equal(first["colors"], second["colors"])
    values: dict[str, Any] = {"steps_coarse": 0, "steps_sos": 127, "coarsest_side": 24, "views_per_step": 2}
    settings = make_settings(**values, learning_rate=0.2, learning_rate_end=0.02)
    alone = Stylizer.planned(wall(), cameras(4), style(), settings, weights=tiny_weights())
    assert [alone.run_step().loss for _ in range(2)] == pytest.approx(first["losses"], rel=1e-4)


@pytest.mark.parametrize(
    ("scene", "values", "image"),
    [
        pytest.param(wall(sh_degree=2), {"sh_attenuation": 0.3}, style(), id="attenuation"),
        pytest.param(wall(), {"scales": (0.0, 1.0), "style_loss": "mixed"}, style(), id="one-scale"),
        pytest.param(
            ball(),
            {"preserve_colors": "luminance", "training_background": "palette"},
            style(),
            id="luminance-of-a-scan",
        ),
        pytest.param(wall(), {}, gray(style()), id="color subspace"),
    ],
)
def test_several_ranks_match_one_rank(scene: Scene, values: dict[str, Any], image: Tensor) -> None:
    values = {"steps_coarse": 2, "steps_sos": 4, "learning_rate": 0.01} | values
    expected = stylize(ALONE, scene, 3, values, image)
    assert ("color subspace" in expected["plan"]) == torch.equal(image[..., 0], image[..., 1])
    actual = on_ranks(3, stylize, scene, 3, values, image)
    for result in actual:
        assert result["losses"] == pytest.approx(expected["losses"], rel=1e-4)
        assert relative_error(result["colors"], expected["colors"]) < 1e-3
        assert torch.equal(result["colors"], actual[0]["colors"])


WIDTH, HEIGHT = 128, 96
#: Two ranks render 80 columns each of a view of this size, and one rank a view of 15 rows.
TILING = Tiling(halo=16, held=math.inf, working=0.0, coarsest=511)


def make_views(collectives: Collectives, scene: Scene, camera: Camera) -> Views:
    """Return the only view of a scene, divided among the ranks."""
    rasterizer, divider = make_rasterizer("cpu", scene), Divider(TILING, collectives)
    return Views(scene, [camera], rasterizer, covered=[0], divider=divider)


def pixels(camera: Camera, seed: int) -> Tensor:
    return torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(seed))


def summed(collectives: Collectives, scene: Scene, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the color gradient [N, 3] of a divided view, and this rank's summand [H, W, 3] of the image's gradient."""
    views = make_views(collectives, scene, camera)
    window, shares = views.window(0, functools.partial(pixels, seed=collectives.rank), 3), views.shares(0)
    assert shares is not None
    summand = torch.zeros(camera.height, camera.width, 3)
    if window.numel():
        summand[shares.windows[collectives.rank].slices] = window
    return views.gradient(0, window, views.colors(0, scene.sh_dc)), summand


def left(scene: Scene) -> Scene:
    """Return the Gaussians that project to the left third of the views."""
    return scene.subset(scene.means[:, 0] < -1)


@pytest.mark.parametrize(
    ("scene", "height"),
    [
        pytest.param(wall(sh_degree=1), HEIGHT, id="wall"),
        pytest.param(left(wall()), HEIGHT, id="nothing on the right"),
        pytest.param(wall(), 15, id="narrow"),
    ],
)
def test_gradient_of_a_divided_view_is_that_of_the_whole(scene: Scene, height: int) -> None:
    camera = cameras(1, WIDTH, height)[0]
    (first, one), (second, other) = on_ranks(2, summed, scene, camera)
    alone = make_views(ALONE, scene, camera)
    expected = alone.gradient(0, one + other, alone.colors(0, scene.sh_dc))
    assert first.any()
    assert torch.equal(first, second)
    assert relative_error(first, expected) < 1e-4
