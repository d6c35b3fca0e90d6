from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageColor

from sgsst_core.errors import OutputError
from sgsst_core.report.charts import write_loss_chart
from sgsst_core.report.images import COLORS, INK
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
