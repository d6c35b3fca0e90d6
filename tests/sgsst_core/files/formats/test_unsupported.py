"""Tests of files and folders that are no scenes: the message says what they are, and what to do."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from sgsst_core.errors import SceneError
from sgsst_core.files.scene_file import read_scene
from tests.sgsst_core.files.formats.samples import refused

OBJ = b"# Blender\nmtllib cube.mtl\no Cube\n" + b"".join(b"v %d 0 1.5\n" % i for i in range(500))


@pytest.mark.parametrize(
    ("data", "name", "message"),
    [
        (OBJ, "cube", "is an OBJ mesh"),
        (b"\r\n" + OBJ.replace(b"\n", b"\r\n"), "cube", "is an OBJ mesh"),
        (b"g empty", "mesh.obj", "is an OBJ mesh"),
        (b'\n{"scenes": [], "asset": {"version": "2.0"}}', "scene", "Save it as one GLB"),
        (b'{"scenes": []}', "scene.gltf", "Save it as one GLB"),
        (b"", "scene.ply", "is empty"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "scene.ply", "Run `git lfs pull`"),
        (b"\n<!DOCTYPE html>\n<html><body>404", "scene.ply", "is an HTML page.*Download the scene again"),
        (b"<!DOCTYPE html>\n<title>SuperSplat Viewer</title>", "a.html", "a viewer of SuperSplat.*as PLY or SOG"),
        (b'{"asset":{"version":"1.1"},"geometricError":5}', "tileset.json", "is a tileset of 3D Tiles"),
        (b'{"version":"5.0","totalSplats":1}', "scene.lcc", "of XGRIDS.*`splat-transform scene.lcc scene.ply`"),
        (b"PXR-USDC" + bytes(90), "a.usdc", "is OpenUSD, which is written but not read"),
        (b"#usda 1.0\n", "a.usda", "is OpenUSD"),
        (b"PK\x03\x04" + bytes(26) + b"default.usda#usda 1.0", "a.usdz", "is OpenUSD"),
        (
            b"PK\x03\x04" + bytes(26) + b"means3d.npy",
            "scene.zip",
            "NumPy arrays, such as those of gsplat.*export_splats",
        ),
        (b"PK\x03\x04" + bytes(90), "a.npz", "NumPy arrays"),
        (b"PK\x03\x04" + bytes(90), "a.sog4d.zip", "is a dynamic scene.*Export one moment"),
        (b'{"means": {"shape": [9, 3], "mins": [0], "maxs": [1]}}', "meta.json", "that gsplat compressed"),
        (b"x,y,z,nx,ny,nz,f_dc_0\n1,2,3", "a.csv", "a table of splat-transform"),
        (b"RAD0" + bytes(90), "a.rad", "of Spark"),
        (b"spx" + bytes(90), "a.spx", "with gsbox"),
        (b"\x80\x02}q\x00.", "model.pth", "is a checkpoint.*sgsst convert CHECKPOINT scene.ply.*ns-export"),
    ],
)
def test_error_names_the_file_type(tmp_path: Path, data: bytes, name: str, message: str) -> None:
    refused(tmp_path, data, message, name)


@pytest.mark.parametrize("legacy", [False, True])
def test_checkpoints_are_refused_as_such(tmp_path: Path, legacy: bool) -> None:
    path = tmp_path / "step-000029999.ckpt"
    content = {"splats": {"means": torch.zeros(5, 3)}}
    torch.save(content, path, _use_new_zipfile_serialization=not legacy)
    with pytest.raises(SceneError, match="is a checkpoint, not a scene"):
        read_scene(path)


def test_text_is_not_taken_for_an_obj_file(tmp_path: Path) -> None:
    refused(tmp_path, b"so it is\nv 1 2 3\n" * 100, "is not a scene file")
    refused(tmp_path, b"# only\n# comments\n" * 100, "is not a scene file")


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (
            ["point_cloud/iteration_7000/point_cloud.ply", "point_cloud/iteration_30000/point_cloud.ply", "input.ply"],
            "Give the scene in it: {}/point_cloud/iteration_30000/point_cloud.ply",
        ),
        (
            ["ply/point_cloud_6999.ply", "ply/point_cloud_29999.ply", "ckpts/ckpt_29999_rank0.pt"],
            "Give the scene in it: {}/ply/point_cloud_29999.ply",
        ),
        (["splat.ply"], "Give the scene in it: {}/splat.ply"),
        (["meta.json", "sh0.webp"], "Give the scene in it: {}/meta.json"),
        (
            ["config.yml", "nerfstudio_models/step-000029999.ckpt"],
            "`ns-export gaussian-splat --load-config {}/config.yml --output-dir exports`",
        ),
        (
            ["ckpts/ckpt_6999_rank0.pt", "ckpts/ckpt_29999_rank0.pt", "ckpts/ckpt_29999_rank1.pt"],
            "`sgsst convert {}/ckpts/ckpt_29999_rank0.pt scene.ply`",
        ),
        ([], "is a folder. Give the file of a scene"),
    ],
)
def test_folder_error_names_the_scene_in_it(tmp_path: Path, files: list[str], message: str) -> None:
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(SceneError, match=re.escape(message.format(tmp_path))):
        read_scene(tmp_path)
