"""Tests on a simulated GPU that the loss by captured CUDA graphs is bit-identical to the eager loss."""

from __future__ import annotations

import inspect
from typing import Any

import pytest
import torch
from torch import Tensor

if torch.cuda.is_available():
    pytest.skip("there is a GPU, which does not pretend", allow_module_level=True)

from sgsst_core.devices import Timer
from sgsst_core.features.layers import convolve_pixels, relu_backward
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import STYLE_LAYERS, FeatureNetwork
from sgsst_core.loss.graphs import FIRST_VISITS, LossGraphs, can_be_captured, can_use_graphs
from sgsst_core.loss.sos import SosLoss, SosResult
from sgsst_core.loss.terms import StyleTargets, ViewTarget
from sgsst_core.parallel.division import Tiling
from sgsst_core.style import Style
from tests.pretend_cuda.counts import Counts
from tests.pretend_cuda.interpreter import leave_out_kernels
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image

pytest.importorskip("triton")
pytestmark = pytest.mark.usefixtures("one_thread")

HEIGHT, WIDTH = 32, 48
SCALES = [0, 1]


@pytest.fixture
def without_triton(counts: Counts, monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable Triton's kernels, so that the slow interpreter is not needed."""
    leave_out_kernels(monkeypatch)


def lines_of(function: Any) -> list[str]:
    """Return the lines of a function of `layers` as in the counts of launches."""
    lines, first = inspect.getsourcelines(function)
    return [f"sgsst_core/features/layers.py:{first + number}" for number in range(len(lines))]


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tile_size", "dtype", "tolerance"),
    [(None, torch.float32, 1e-5), (32, torch.float32, 1e-5), (None, torch.bfloat16, 0.03)],
)
def test_kernels_agree_with_tensor_functions_and_pass_relus(
    counts: Counts,
    tiny_weights: BackboneWeights,
    monkeypatch: pytest.MonkeyPatch,
    tile_size: int | None,
    dtype: torch.dtype,
    tolerance: float,
) -> None:
    """Kernels of the style gradient and the content term pass ReLUs, but not in tiles with cells that others own."""
    loss = SosLoss(FeatureNetwork(tiny_weights, dtype=dtype, device="cuda"), coarsest=16, tile_size=tile_size)
    style, view, pixels = style_of(loss), view_of(loss, 2, weighted=True), image(1)
    results, relus, used = [], [], []
    for leave_out in (False, True):
        if leave_out:
            leave_out_kernels(monkeypatch)
        counts.clear()
        results.append(loss.evaluate(pixels, style, view, SCALES))
        first_layer, relu = (
            sum(counts.launches[line] for line in lines_of(function)) for function in (convolve_pixels, relu_backward)
        )
        used.append(first_layer > 0)
        relus.append(relu)
    fast, plain = (result.image_gradient for result in results)
    assert fast is not None
    assert plain is not None
    assert relative_error(fast.cpu(), plain.cpu().double()) < tolerance
    assert relative_error(results[0].values.cpu(), results[1].values.cpu()) < tolerance
    assert used == [dtype == torch.bfloat16, False]
    if tile_size is None:  # of eleven convolutions, relu3_2 alone is neither pooled nor part of the loss
        assert relus == [len(SCALES), 11 * len(SCALES)]


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


@pytest.mark.usefixtures("without_triton")
@pytest.mark.parametrize(("options", "fits"), [({"tile_size": 32}, 9.0), ({}, 1.9), ({}, 2.1)])
def test_only_scales_of_one_tile_that_fit_twice_are_captured(
    tiny_weights: BackboneWeights, options: dict[str, Any], fits: float
) -> None:
    network = FeatureNetwork(tiny_weights, device="cuda")
    once = HEIGHT * WIDTH * (network.held_bytes_per_pixel() + network.working_bytes_per_pixel())
    loss = make_loss(tiny_weights, content_weight=0.0, memory=int(fits * once), **options)
    style, view = style_of(loss), loss.targets.of_view(image(2))
    graphs = LossGraphs(loss)
    for step in range(FIRST_VISITS):
        assert_same(graphs.evaluate(image(step), style, view, SCALES), loss.evaluate(image(step), style, view))
    assert (graphs.captured, graphs.problem) == (int(fits == 2.1), None)


def test_graphs_require_a_gpu_enough_memory_and_one_rank(tiny_weights: BackboneWeights) -> None:
    assert not can_use_graphs("cpu")
    tiling = Tiling(halo=64, held=1000.0, working=0.25, coarsest=16)
    assert can_be_captured(tiling, [400, 100])
    assert not can_be_captured(tiling, [401, 100])
    network = FeatureNetwork(tiny_weights, STYLE_LAYERS, device="cpu")

    class Two:
        rank, size, local_size, gpu_sharing = 0, 2, 2, 1

    loss = SosLoss(network, collectives=Two())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="communication between ranks"):
        LossGraphs(loss)
