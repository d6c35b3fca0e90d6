from __future__ import annotations

import math

import numpy as np
import pytest

from sgsst_core.report.charts import BINS, running_mean, thinned
from sgsst_core.scales import smoothed


def test_running_mean_is_geometric_and_over_the_last_window() -> None:
    values = [1.0, 10.0, 100.0, 1000.0, 10.0]
    np.testing.assert_allclose(running_mean(values, 3), [1, 10**0.5, 10, 100, 100])
    np.testing.assert_allclose(running_mean(values, 1), values)
    np.testing.assert_allclose(running_mean(values, 99), [math.prod(values[:n]) ** (1 / n) for n in range(1, 6)])
    for window in (1, 3, 99):
        assert running_mean(values, window)[-1] == pytest.approx(smoothed(values, window))
    assert np.isfinite(running_mean([0.0, 1.0], 1)).all()
    assert len(running_mean([], 3)) == 0


def test_thinning_keeps_range_and_mean() -> None:
    random = np.random.default_rng(1)
    x = np.arange(1.0, 20_001.0)
    values = np.exp(random.normal(size=len(x)))
    line = thinned(x, values, 25, math.log(2e4) / BINS)
    assert len(line.x) <= BINS + 1
    assert (np.diff(line.x) > 0).all()
    assert line.low.min() == values.min()
    assert line.high.max() == values.max()
    assert ((line.low <= line.high) & (line.x >= 1) & (line.x <= 2e4)).all()
    places = np.floor(np.log(x) / (math.log(2e4) / BINS))
    smooth = running_mean(values, 25)
    wanted = [math.exp(np.log(smooth[places == place]).mean()) for place in np.unique(places)]
    np.testing.assert_allclose(line.mean, wanted, rtol=1e-10)


def test_thinning_preserves_distant_points() -> None:
    x, values = np.array([1.0, 2.0, 4.0, 8.0]), np.array([4.0, math.nan, 2.0, 0.0])
    line = thinned(x, values, 1, 0.01)
    np.testing.assert_allclose(line.x, [1, 4])
    for drawn in (line.mean, line.low, line.high):
        np.testing.assert_allclose(drawn, [4, 2])
