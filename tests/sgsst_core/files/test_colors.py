"""Tests of the error bound of files that store only colors, as float16."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from sgsst_core.constants import SH_C0
from sgsst_core.errors import OutputError
from sgsst_core.files.formats import scene_format
from sgsst_core.files.stylized_ply import write_colors


def test_colors_round_trip_within_the_error_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_format, "BLOCK_ROWS", 100)
    generator = torch.Generator().manual_seed(1)
    size = torch.rand(1003, 3, generator=generator) * 14 - 9  # from 1e-9 to 1e5
    sh_dc = torch.randn(1003, 3, generator=generator).sign() * 10.0**size
    sh_dc[0] = torch.tensor([1e30, -65520.0, 65519.0])
    path = tmp_path / "stylized_ply.f16"
    write_colors(path, sh_dc)
    assert path.stat().st_size == 6 * 1003
    actual = np.fromfile(path, "<f2").reshape(-1, 3).astype(np.float64)
    exact = sh_dc.double().clamp(-65504, 65504).numpy()
    assert (np.abs(actual - exact) <= np.maximum(2.0**-11 * np.abs(exact), 2.0**-25)).all()
    assert actual[0].tolist() == [65504, -65504, 65504]


def test_colors_between_black_and_white_keep_their_gray_level(tmp_path: Path) -> None:
    levels = torch.linspace(0, 1, 3 * 10_001, dtype=torch.float64).reshape(-1, 3)
    write_colors(tmp_path / "c", ((levels - 0.5) / SH_C0).float())
    colors = 0.5 + SH_C0 * np.fromfile(tmp_path / "c", "<f2").astype(np.float64).reshape(-1, 3)
    assert 255 * np.abs(colors - levels.numpy()).max() < 0.04


def test_empty_scene_is_written_and_missing_folder_is_an_error(tmp_path: Path) -> None:
    write_colors(tmp_path / "c", torch.zeros(0, 3))
    assert (tmp_path / "c").read_bytes() == b""
    with pytest.raises(OutputError):
        write_colors(tmp_path / "c" / "d", torch.zeros(1, 3))
