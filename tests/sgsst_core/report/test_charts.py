"""Tests of the loss chart, and of the running means and thinned lines of all charts."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageColor

from sgsst_core.errors import OutputError
from sgsst_core.report.charts import BINS, running_mean, thinned, write_loss_chart
from sgsst_core.report.images import COLORS, INK
from sgsst_core.scales import smoothed
from tests.sgsst_core.report.sample import sample_report

pytestmark = pytest.mark.filterwarnings("error")


def colors_in(path: Path) -> set[tuple[int, ...]]:
    with Image.open(path) as image:
        assert image.format == "PNG"
        return {tuple(pixel) for pixel in np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0).tolist()}


@pytest.mark.parametrize(("coarse", "sos", "scales"), [(0, 1, 1), (3, 0, 2), (40, 60, 3)])
def test_chart_has_a_line_for_each_optimized_scale(coarse: int, sos: int, scales: int, tmp_path: Path) -> None:
    write_loss_chart(tmp_path / "c.png", sample_report(coarse, sos, scales))
    colors = colors_in(tmp_path / "c.png")
    there = range(scales) if sos else [scales - 1]
    for place, color in enumerate(COLORS):
        assert (ImageColor.getrgb(color) in colors) == (place in there), f"scale {place}"


def test_chart_without_steps_has_only_axes(tmp_path: Path) -> None:
    write_loss_chart(tmp_path / "c.png", sample_report(0, 0))
    colors = colors_in(tmp_path / "c.png")
    assert ImageColor.getrgb(INK) in colors
    assert not colors & {ImageColor.getrgb(color) for color in COLORS}


def test_missing_folder_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError):
        write_loss_chart(tmp_path / "missing" / "c.png", sample_report())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_charts_need_no_home_folder(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("MPL", "XDG_", "HOME"))}
    environment |= {"TMPDIR": str(tmp_path), "HOME": "/proc/absent"}
    command = [sys.executable, "-c", "import sgsst_core.report.charts"]
    shown = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert shown.stdout + shown.stderr == ""


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
