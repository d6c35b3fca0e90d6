from functools import reduce
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.stability.sos_reference import layer_statistics_reference
from sgsst_core.features.statistics import LayerStatistics, layer_statistics, merge


def features(height=40, width=50, channels=24, *, ratio=1.0, dtype=torch.float64, seed=0):
    """Return features [h, w, c] whose mean is `ratio` times their standard deviation."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn((height, width, channels), generator=generator, dtype=torch.float64)
    return (noise + ratio).to(dtype)


def assert_equal(actual: LayerStatistics, expected: LayerStatistics, tolerance: float):
    torch.testing.assert_close(actual.count, expected.count, rtol=tolerance, atol=0)
    torch.testing.assert_close(actual.mean, expected.mean, rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(actual.std(), expected.std(), rtol=tolerance, atol=0)
    torch.testing.assert_close(actual.gram(), expected.gram(), rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
@pytest.mark.parametrize("weighted", [False, True])
def test_agrees_with_reference(dtype, tolerance, weighted):
    x = features(dtype=dtype)
    a = torch.rand(x.shape[:2]) if weighted else None
    assert_equal(layer_statistics(x, a), layer_statistics_reference(x, a), tolerance)


@settings(max_examples=25, deadline=None)
@given(cuts=st.lists(st.integers(0, 40), max_size=6), weighted=st.booleans())
def test_merge_does_not_depend_on_the_division(cuts, weighted):
    x = features()
    a = torch.rand(x.shape[:2], dtype=torch.float64) if weighted else None
    edges = [0, *sorted(cuts), 40]
    parts = [layer_statistics(x[top:bottom], None if a is None else a[top:bottom]) for top, bottom in pairwise(edges)]
    assert_equal(reduce(merge, parts), layer_statistics_reference(x, a), 1e-11)


def test_empty_statistics_are_neutral_in_merges():
    x = features()
    whole = layer_statistics(x)
    nothing = layer_statistics(x[:0])
    weightless = layer_statistics(x, torch.zeros(x.shape[:2]))
    assert not float(nothing.count)
    assert not float(weightless.count)
    assert_equal(merge(merge(nothing, whole), weightless), whole, 0)


def test_half_precision_features_are_summed_in_float32():
    x = features(200, 200, 8, ratio=3).to(torch.bfloat16)
    assert_equal(layer_statistics(x), layer_statistics_reference(x), 1e-5)


def test_shift_far_from_the_mean_is_replaced():
    """If all sampled positions are outliers, a shift from them would cost three digits of the variance."""
    x = features(1024, 1000, 2, dtype=torch.float32)
    x[:, 0] = 1e3
    assert_equal(layer_statistics(x), layer_statistics_reference(x), 1e-5)


@pytest.mark.parametrize("height", [40, 700])
def test_shift_comes_from_covered_features(height):
    """The shift must come from covered features, which a sample of all positions would hardly contain."""
    x = features(height, 50, 8, dtype=torch.float32)
    covered = torch.zeros(x.shape[:2])
    covered[7:9, 11:14] = 0.5
    x[covered == 0] += 1e5
    actual, expected = layer_statistics(x, covered), layer_statistics_reference(x, covered)
    assert_equal(actual, expected, 1e-5)


def test_constant_channels_have_exact_mean_and_zero_deviation():
    generator = torch.Generator().manual_seed(2)
    x = (torch.rand((1, 1, 64), generator=generator) * 10 ** torch.arange(-20, 12, 0.5)).expand(130, 70, 64)
    some = torch.rand((130, 70), generator=generator)
    for weights in (None, some, (some > 0.99).float()):
        statistics = layer_statistics(x, weights)
        assert not statistics.std().any()
        torch.testing.assert_close(statistics.mean, x[0, 0].double(), rtol=0, atol=0)


def test_tiny_weights_do_not_vanish():
    x = features(dtype=torch.float32)
    whole, tiny = layer_statistics(x), layer_statistics(x, torch.full(x.shape[:2], 1e-35))
    torch.testing.assert_close(tiny.std(), whole.std(), rtol=1e-5, atol=0)
    torch.testing.assert_close(tiny.mean, whole.mean, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("channels", [1, 3, 31, 33, 100, 512])
@pytest.mark.parametrize("width", [1, 7, 4099])
def test_blocks_and_strips_of_any_shape_agree_with_reference(channels, width):
    x = features(3 if width > 7 else 70, width, channels, dtype=torch.float32)
    a = torch.rand(x.shape[:2], generator=torch.Generator().manual_seed(1))
    assert_equal(layer_statistics(x, a), layer_statistics_reference(x, a), 2e-5)
