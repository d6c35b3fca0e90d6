"""Test of the Blender add-on: Blender's own extension system installs it, and Blender's Python module runs it."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from api.integrations.build import build
from sgsst_core.constants import SH_C0
from sgsst_core.files.scene_file import read_scene
from tests.api.service import Service

pytestmark = pytest.mark.slow
#: Python with Blender's module bpy, which has 370 MB: the one that SGSST_BPY names, or this one.
PYTHON = os.environ.get("SGSST_BPY") or (sys.executable if importlib.util.find_spec("bpy") else None)


@pytest.mark.skipif(
    PYTHON is None, reason="Blender's module is missing: pip install bpy; or name a Python in SGSST_BPY"
)
def test_add_on_in_blender(service: Service, files: tuple[Path, Path, Path], tmp_path: Path) -> None:
    scene, _, style = files
    assert PYTHON
    package = build("blender", tmp_path)
    program = Path(__file__).with_name("in_blender.py")
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "resources"), "PYTHONPATH": ""}
    command = [PYTHON, str(program), str(package), str(scene), str(style), service.url]
    subprocess.run(command, check=True, env=environment, cwd=tmp_path)
    answer = json.loads((tmp_path / "answer.json").read_text())
    assert "sgsst serve" in answer["unreachable"]
    assert "Allow Online Access" in answer["offline"]
    assert "'missing.png'" in answer["no style"]
    assert "Stanford PLY" in answer["cube"]
    assert any("left" in text for text in answer["progress"])
    expected = {
        "canceled": "The job was canceled.",
        "object": "Painted scene stylized.",
        "moved": [1, 2, 3],
        **dict.fromkeys(("unchanged", "points", "points can be stylized", "points shown"), True),
    }
    assert {name: answer[name] for name in (*expected, "timer")} == {**expected, "timer": False}
    with service.client() as client:
        jobs = client.get("/v1/jobs").json()["jobs"]
        newest, older = [job for job in jobs if job["status"] == "succeeded"][:2]
        canceled = jobs[jobs.index(older) + 1]
        assert canceled["status"] == "canceled"
        (tmp_path / "older.ply").write_bytes(client.get(older["links"]["result"]).content)
        (tmp_path / "newest.ply").write_bytes(client.get(newest["links"]["result"]).content)
    older_dc, newest_dc = (read_scene(tmp_path / f"{name}.ply").scene.sh_dc.numpy() for name in ("older", "newest"))
    assert np.array_equal(np.float32(answer["f_dc_0"]), older_dc[:, 0])
    assert (answer["attribute"], answer["added objects"]) == ("Painted scene.", 0)
    shown = np.array(answer["colors"])
    assert np.abs(shown[:, :3] - np.clip(0.5 + SH_C0 * newest_dc, 0, 1)).max() <= 0.51 / 255
    assert (shown[:, 3] == 1).all()
