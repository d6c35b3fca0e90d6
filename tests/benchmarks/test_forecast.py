"""Tests of the forecast of step times, in cases with known results."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from benchmarks import forecast
from benchmarks.forecast import (
    DEVICES,
    Job,
    Passes,
    make_loss,
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
    assert FLOP == 722_304
    for precision in ("float32", "float16"):
        for works in Passes(make_loss(H200, precision), SMALL.size, [0]).network():
            assert sum(work.operations for work in works) / (96 * 128) == FLOP


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


def test_forecast_range_contains_likely_value() -> None:
    result = forecast.forecast(SMALL, H200, "tf32")
    for kind in ("sos", "coarse"):
        low, mid, high = (result[kind][name]["total"] for name in ("optimistic", "likely", "pessimistic"))
        assert 0 < low < mid < high
    assert result["coarse"]["likely"]["total"] <= result["sos"]["likely"]["total"]
    assert "| **a step** |" in forecast.table({"tf32": result})
