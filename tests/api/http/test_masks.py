"""Tests of whole jobs whose regions are masks sent over HTTP or by the client."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from api.client import Client
from tests.api.service import Service
from tests.small_scenes import wall, write_files

pytestmark = pytest.mark.slow
COLORS = ("f_dc_0", "f_dc_1", "f_dc_2")


def colors(path: Path) -> np.ndarray:
    rows = PlyData.read(path)["vertex"].data
    return np.stack([rows[name] for name in COLORS], axis=1)


def test_frozen_mask_stays_bit_identical(whole_service: Service, tmp_path: Path) -> None:
    """The mask has a bit for each row of the file, also for a dropped one."""
    ply, cameras, style = write_files(tmp_path, wall())
    rows = PlyData.read(ply)["vertex"].data.copy()
    rows["x"][40] = np.nan
    PlyData([PlyElement.describe(rows, "vertex")]).write(ply)
    mask = np.random.default_rng(3).random(616) < 0.5
    (tmp_path / "bits.bin").write_bytes(np.packbits(mask, bitorder="little").tobytes())
    with Client(whole_service.url) as client:
        job = client.submit(
            ply,
            style,
            cameras=cameras,
            masks={"half.bin": tmp_path / "bits.bin"},
            regions=[{"name": "half", "select": "mask=half.bin", "freeze": True}],
            steps_coarse=0,
            steps_sos=6,
            drop_invalid=True,
            backbone="vgg16",
        )
        assert client.wait(job.id).status == "succeeded"
        client.download(job.id, tmp_path / "result.ply")
    before, after = colors(ply), colors(tmp_path / "result.ply")
    remaining = np.arange(616) != 40
    same = (before[remaining].view(np.uint32) == after.view(np.uint32)).all(axis=1)
    assert same[mask[remaining]].all()
    assert not same[~mask[remaining]].any()
