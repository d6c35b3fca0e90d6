"""Tests of .splat, against values computed by hand."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from sgsst_core.files.scene_file import read_scene
from tests.sgsst_core.files.formats.samples import (
    SPLAT_ROW,
    check_damage,
    refused,
)


def test_values_match_those_computed_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "scene.bin"
    row = struct.pack("<6f8B", 1, 2, 3, 1, np.e, 0.5, 0, 255, 51, 128, 128, 205, 26, 128)
    path.write_bytes(row * 3)
    loaded = read_scene(path)
    scene = loaded.scene
    assert (loaded.format, len(scene), scene.sh_degree) == ("splat", 3, 0)
    assert scene.means[2].tolist() == [1, 2, 3]
    assert scene.scales[0].tolist() == pytest.approx([0, 1, np.log(0.5)])
    assert (0.5 + 0.28209479177387814 * scene.sh_dc[0]).tolist() == pytest.approx([0, 1, 0.2], abs=1e-6)
    assert float(scene.opacities[0].sigmoid()) == pytest.approx(128 / 255)
    assert scene.quats[0].tolist() == pytest.approx([0, 77 / 128, -102 / 128, 0])


def test_truncated_file_and_flat_gaussian_are_refused(tmp_path: Path) -> None:
    refused(
        tmp_path, SPLAT_ROW * 40 + bytes(5), "40 Gaussians of 32 bytes and 5 bytes more: it is truncated", "a.splat"
    )
    flat = struct.pack("<6f8B", 1, 2, 3, 0, 1, 1, 0, 255, 51, 128, 255, 128, 128, 128)
    refused(tmp_path, SPLAT_ROW * 300 + flat, r"1 of 301 Gaussians hold .*scale_0 \(1 infinite\)", "a.splat")
    loaded = read_scene(tmp_path / "a.splat", drop_invalid=True)
    assert (len(loaded.scene), loaded.dropped) == (300, 1)


def test_random_damage_never_crashes_the_reader(tmp_path: Path) -> None:
    check_damage(tmp_path / "scene", SPLAT_ROW * 100)
