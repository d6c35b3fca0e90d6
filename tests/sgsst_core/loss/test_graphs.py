"""Tests on a simulated GPU that losses and steps with captured CUDA graphs are bit-identical to eager ones."""

from typing import Any

import pytest
import torch
from torch import Tensor

from sgsst_core.devices import Timer
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.graphs import LossGraphs, can_be_captured, can_use_graphs
from sgsst_core.loss.sos import SosLoss, SosResult
from sgsst_core.loss.terms import StyleTargets, ViewTarget
from sgsst_core.parallel import Tiling
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.survey import survey_views
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import JobInputs, prepare_job
from sgsst_core.stylizing.stylizer import Stylizer
from tests.pretend_cuda.counts import Counts
from tests.pretend_cuda.interpreter import leave_out_kernels
from tests.sgsst_core.synthetic_images import synthetic_image
from tests.small_scenes import ball, cameras, style, wall

if torch.cuda.is_available():
    pytest.skip("there is a GPU, which does not pretend", allow_module_level=True)
pytest.importorskip("triton")
pytestmark = pytest.mark.usefixtures("one_thread")

HEIGHT, WIDTH = 32, 48
SCALES = [0, 1]
#: Number of visits of a view before a graph speeds it up: the first visit warms up the kernels, the second is captured.
FIRST_VISITS = 2


@pytest.fixture
def without_triton(counts: Counts, monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable Triton's kernels, so that the slow interpreter is not needed."""
    leave_out_kernels(monkeypatch)


def image(seed: int, height: int = HEIGHT, width: int = WIDTH) -> Tensor:
    return synthetic_image(height, width, seed=seed, dtype=torch.float32).to("cuda")


def make_loss(weights: BackboneWeights, **options: Any) -> SosLoss:
    return SosLoss(FeatureNetwork(weights, device="cuda"), coarsest=16, timer=Timer("cuda"), **options)


def style_of(loss: SosLoss) -> StyleTargets:
    return loss.targets.of_style(Style.of(synthetic_image(40, 50, seed=1, dtype=torch.float32)), (HEIGHT, WIDTH))


def view_of(loss: SosLoss, seed: int, *, weighted: bool = False) -> ViewTarget:
    coverage = image(seed + 1000)[:, :, 0].contiguous() if weighted else None
    return loss.targets.of_view(image(seed + 100), coverage)


def assert_same(actual: SosResult, expected: SosResult) -> None:
    assert actual.scales == expected.scales
    assert actual.image_gradient is not None
    assert expected.image_gradient is not None
    assert expected.image_gradient.cpu().abs().amax() > 0
    assert actual.image_gradient.cpu().equal(expected.image_gradient.cpu())
    assert actual.values.cpu().equal(expected.values.cpu())


@pytest.mark.parametrize("weighted", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_graph_is_bit_identical_to_eager_mode_for_every_view(
    counts: Counts, tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch, weighted: bool
) -> None:
    if not weighted:  # once is enough for the Triton kernels, which are slow in the interpreter
        leave_out_kernels(monkeypatch)
    loss = make_loss(tiny_weights)
    style, views = style_of(loss), [view_of(loss, seed, weighted=weighted) for seed in (2, 3)]
    graphs, results = LossGraphs(loss), []
    for step in range(FIRST_VISITS + 1):  # replayed for another view than the captured one
        pixels, view = image(step), views[step % 2]
        expected = loss.evaluate(pixels, style, view, SCALES)
        counts.clear()
        actual = graphs.evaluate(pixels, style, view, SCALES)
        assert graphs.captured == (step + 1 >= FIRST_VISITS)
        if step >= FIRST_VISITS:
            assert not counts.waits
            assert not counts.copies
            assert counts.launches.total() < 15  # one graph; copies of image, content and coverage; the results
        assert_same(actual, expected)
        results.append((actual.values, expected.values))
    for values, expected_values in results:  # later evaluations must not change them
        assert values.cpu().equal(expected_values.cpu())
    assert graphs.problem is None
    assert loss.timer.read()["network"] > 0


@pytest.mark.usefixtures("without_triton")
def test_graphs_copy_the_content_weights_of_each_view(tiny_weights: BackboneWeights) -> None:
    loss = make_loss(tiny_weights, content_weight=1e4)
    style, views, graphs = style_of(loss), [view_of(loss, 2) for _ in range(3)], LossGraphs(loss)
    for seed, view in enumerate(views[1:]):
        view.content_weights = loss.targets.position_weights(image(seed)[:, :, 0].contiguous())
    for step in range(2 * FIRST_VISITS + 3):
        view = views[step % 3]
        expected = loss.evaluate(image(7), style, view, SCALES)
        assert_same(graphs.evaluate(image(7), style, view, SCALES), expected)
    assert graphs.problem is None
    assert graphs.captured == 2  # with and without content weights


@pytest.mark.usefixtures("without_triton")
def test_failed_capture_falls_back_to_eager_mode(
    tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "__version__", "2.13.0")  # earlier versions stay in capture mode
    loss = make_loss(tiny_weights, content_weight=0.0)
    style, view = style_of(loss), loss.targets.of_view(image(2))
    graphs = LossGraphs(loss)
    convolve = FeatureNetwork._convolve

    def waits(network: FeatureNetwork, x: Tensor, step: Any) -> Tensor:
        assert float(x.amax()) < 1e9  # reads from the device, which a graph cannot contain
        return convolve(network, x, step)

    monkeypatch.setattr(FeatureNetwork, "_convolve", waits)
    timer = loss.timer
    for step in range(4):
        assert_same(graphs.evaluate(image(step), style, view, SCALES), loss.evaluate(image(step), style, view))
        assert graphs.captured == 0
        assert loss.timer is timer
        assert (graphs.problem is not None) is (step + 1 >= FIRST_VISITS)
    assert graphs.problem == (
        "RuntimeError: operation not permitted when stream is capturing: the host waits for the device"
    )
    assert not torch.cuda.is_current_stream_capturing()


def test_graphs_need_a_pytorch_that_survives_a_failed_capture(monkeypatch: pytest.MonkeyPatch) -> None:
    for version, usable in (("2.11.0+cu128", False), ("2.12.1", False), ("2.13.0+cu130", True), ("3.0", True)):
        monkeypatch.setattr(torch, "__version__", version)
        assert can_use_graphs("cuda") is usable


def test_graphs_require_a_gpu_and_enough_memory() -> None:
    assert not can_use_graphs("cpu")
    tiling = Tiling(halo=64, held=1000.0, working=0.25, coarsest=16)
    assert can_be_captured(tiling, [400, 100])
    assert not can_be_captured(tiling, [401, 100])


#: Maximum number of launches of a step outside its graph, with views, style and intersections cached.
MOST_LAUNCHES = 60


def make(weights: BackboneWeights, *, graphs: bool, scan: bool) -> Stylizer:
    """Make a job with two views, two scales and three steps per phase; a scan gets random background colors."""
    scene, views = ball(40) if scan else wall(10, 8), cameras(2, 48, 32)
    settings = make_settings(coarsest_side=16, steps_coarse=3, steps_sos=3, scale_sampling=1)
    survey = survey_views(scene, views, make_rasterizer("cpu", scene))
    some = survey.total_blend_weights > 0
    plan = Plan(
        survey=survey,
        optimized=some,
        seen=some,
        covered=tuple(survey.covered),
        weighted=scan,
        training_background="random" if scan else "background",
        steps_coarse=settings.steps_coarse,
        memory_limit=10**9,
        device="cuda",
        rasterizer="triton",
        uncached="triton",
        graphs=graphs,
    )
    return Stylizer(prepare_job(plan, JobInputs(scene, views, Style.of(style()), settings, weights=weights)))


def test_kernels_run_on_the_device_of_their_data(counts: Counts, tiny_weights: BackboneWeights) -> None:
    """The caller's current device may be another one, as in a new thread."""
    stylizer = make(tiny_weights, graphs=False, scan=True)
    torch.cuda.set_device(1)
    stylizer.run_step()
    assert torch.cuda.current_device() == 1
    assert stylizer.step == 1


@pytest.mark.slow
@pytest.mark.parametrize("scan", [False, True])
def test_steps_with_graphs_are_bit_identical(
    counts: Counts, tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch, scan: bool
) -> None:
    """In both phases, the first of two views that share a graph prepares it, and the second is captured."""
    if not scan:  # once is enough for the network's Triton kernels, which are slow in the interpreter
        leave_out_kernels(monkeypatch)
    plain, graphs = (make(tiny_weights, graphs=graphs, scan=scan) for graphs in (False, True))
    for _ in range(plain.job.total_steps):
        expected, stage = plain.run_step(), graphs.phase.stage
        counts.clear()
        actual = graphs.run_step()
        assert (actual.view, actual.loss, actual.terms) == (expected.view, expected.loss, expected.terms)
        if sum(record.stage == stage for record in graphs.history) > FIRST_VISITS:
            assert counts.waits.total() == 1
            assert {"network", "render", "raster_backward"} <= actual.parts.keys()
            if not scan:  # a drawn background color changes the content features, which are computed outside
                assert counts.launches.total() < MOST_LAUNCHES
                assert "vgg_forward" not in actual.parts
    assert graphs.stylized().equal(plain.stylized())
    assert graphs.job.graphs is not None
    assert (graphs.job.graphs.captured, graphs.job.graphs.problem) == (2, None)
