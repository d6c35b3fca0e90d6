"""Tests of the forecast of step times, in cases with known results."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from benchmarks import forecast
from benchmarks.forecast import (
    DEVICES,
    JOBS,
    SHARES,
    Job,
    Part,
    Passes,
    make_loss,
    statistics,
    step_seconds,
    style_gradient,
)
from benchmarks.work import Counted, Work, meta

#: GPU of these tests.
H200 = DEVICES["H200"]
#: Job whose scene and views fit into memory.
SMALL = Job((96, 128), 1000, 4.0, 3)
#: Floating-point operations of VGG19 up to relu5_1 per pixel, by block: 9 multiply-adds for each pair of channels.
FLOP = 2 * 9 * (
    (3 * 64 + 64 * 64)
    + (64 * 128 + 128 * 128) / 4
    + (128 * 256 + 3 * 256 * 256) / 16
    + (256 * 512 + 3 * 512 * 512) / 64
    + 512 * 512 / 256
)  # fmt: skip


def test_vgg19_takes_0_72_million_operations_per_pixel_and_pass() -> None:
    forward, backward = Passes(make_loss(H200, "float32"), SMALL.size, [0]).network()
    assert FLOP == 722_304
    for works in (forward, backward):
        assert sum(work.operations for work in works) / (96 * 128) == FLOP


def test_activations_beyond_memory_are_recomputed(monkeypatch: pytest.MonkeyPatch) -> None:
    loss = make_loss(H200, "float32")
    passes = Passes(loss, SMALL.size, [0])
    passes.cached = [False]
    forward, backward = passes.network()
    assert sum(work.operations for work in backward) == 2 * sum(work.operations for work in forward)


def test_launches_are_counted_with_their_bytes() -> None:
    a, weight = meta(1, 4, 6, 8), meta(16, 4, 3, 3)
    with Counted() as counted:
        a.view(4, 48)[1:].T.add_(meta(48, 3))
        F.conv2d(a, weight, padding=1).relu_()
        torch.empty(7, device="meta")
        meta(5, dtype=torch.bfloat16) + 1
    added, convolved, last = counted.works
    assert added == Work(0, 3 * 48 * 3 * 4)
    assert convolved == Work(2 * 9 * 4 * 16 * 48, 4 * (4 * 48 + 16 * 4 * 9 + 16 * 48))
    assert last == Work(0, 2 * 5 * 2)


def test_slower_of_compute_and_memory_determines_time() -> None:
    rates = {"convolution": 100.0, "matrix": 10.0, "bytes": 50.0}
    assert Work(200, 50).seconds(rates) == 2
    assert Work(200, 500).seconds(rates) == 10
    assert Work(200, 500, "matrix").seconds(rates) == 20


def test_statistics_use_upper_triangle_of_channel_pairs() -> None:
    assert statistics(64, 1000, 4).operations == 2 * 64**2 * 1000
    assert statistics(512, 1000, 4).operations == 2 * 512**2 * 1000 * 36 / 64


def test_style_gradient_multiplies_bfloat16_by_two_matrices() -> None:
    exact, half = style_gradient(64, 1000, 4), style_gradient(64, 1000, 2)
    assert half.operations == 2 * exact.operations == 4 * 64**2 * 1000
    assert exact.bytes == 2 * half.bytes == 3 * 64 * 1000 * 4


def test_feature_precision_determines_matrix_product_rate() -> None:
    likely = SHARES["likely"]
    rates = {name: likely.rates(H200, name) for name in forecast.PRECISIONS}
    for kind, shares in (("matrix", likely.matrix), ("moments", likely.moments)):
        assert rates["tf32"][kind] == rates["float32"][kind] == H200.peaks["float32"] * shares["float32"]
        assert rates["bfloat16"][kind] == H200.peaks["bfloat16"] * shares["bfloat16"]


def test_device_and_host_times_overlap() -> None:
    shares, launches = SHARES["likely"], (500, 450)
    parts = {
        "a": Part([Work(0, 4.8e12 * shares.bandwidth)] * 3),
        "b": Part([Work(0, 4.8e12 * shares.bandwidth)], 0.5, 100),
    }
    seconds = step_seconds(parts, shares, H200, "float32", launches)
    gaps = shares.gap * (500 + 50)
    assert (seconds["a"], seconds["b"], seconds["total"]) == pytest.approx((3.0, 0.5, 3.5 + gaps))
    assert seconds["host"] == pytest.approx(shares.launch * (51 + 50))
    eager = step_seconds(parts, shares, H200, "float32", (10**9, 0))
    assert eager["total"] == pytest.approx(1e9 * shares.launch, rel=1e-6)


def test_backward_pass_of_pooling_reads_and_writes_each_value_once() -> None:
    """Its gradient is a quarter as large as its input, which is that of the convolution before it."""
    _, backward = Passes(make_loss(H200, "bfloat16"), SMALL.size, [0]).network()
    pooled = 96 * 128 * (64 + 128 / 4 + 256 / 16 + 512 / 64) * 2
    moved = [work.bytes for work in backward if not work.operations]
    assert sum(moved[index] for index in range(len(moved)) if moved[index] == 96 * 128 * 64 * 2 * 9 / 4) > 0
    assert sum(moved) >= pooled * 9 / 4


def test_cached_values_are_not_recomputed() -> None:
    everything = forecast.cached_fractions(SMALL, H200, make_loss(H200, "float32"), coarse=False)
    assert everything == {"content": 1.0, "lists": 1.0, "colors": 1.0}
    garden = forecast.cached_fractions(JOBS["5187x3361"], H200, make_loss(H200, "float32"), coarse=False)
    assert all(0 < share < 1 for share in garden.values())
    parts = forecast.step_parts(SMALL, H200, "bfloat16")
    assert [parts[name].visits for name in parts if name.endswith("recomputed")] == [0.0] * 3


def test_forecast_range_contains_likely_value() -> None:
    result = forecast.forecast(SMALL, H200, "tf32")
    for kind in ("sos", "coarse"):
        low, mid, high = (result[kind][name]["total"] for name in ("optimistic", "likely", "pessimistic"))
        assert 0 < low < mid < high
    assert result["coarse"]["likely"]["total"] <= result["sos"]["likely"]["total"]
    assert "| **a step** |" in forecast.table({"tf32": result})
