"""Tests of whole jobs whose regions are masks sent over HTTP or by the client."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData, PlyElement

from api.client import Client
from tests.api.service import Service, undisturbed
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


def test_photos_of_any_name_give_the_result_of_the_command(
    whole_service: Service, tiny_installed: Path, tmp_path: Path
) -> None:
    ply, cameras, style = write_files(tmp_path, wall())
    names = ["cam#0/v%3.png", "cam#0/v_3.png", "caf\u00e9 v#3.png"]
    views = [{**view, "img_name": name} for view, name in zip(json.loads(cameras.read_text()), names, strict=True)]
    cameras.write_text(json.dumps(views))
    for level, name in enumerate(names):
        path = tmp_path / "photos" / name.replace("\u00e9", "e\u0301")  # as macOS writes it
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.linear_gradient("L").resize((64, 48)).rotate(90 * level).save(path)
    parameters: dict[str, Any] = {"steps_coarse": 1, "steps_sos": 6, "backbone": "vgg16"}
    with Client(whole_service.url) as client:
        job = client.submit(ply, style, cameras=cameras, photos=tmp_path / "photos", **parameters)
        assert client.wait(job.id).status == "succeeded"
        client.download(job.id, tmp_path / "result.ply")
    files = {"scene": ply, "cameras": cameras, "style": style}
    own = undisturbed(files, {**parameters, "images": tmp_path / "photos"}, tmp_path)
    assert np.array_equal(colors(own), colors(tmp_path / "result.ply"))
