"""Tests of the examples in `docs/examples`: each is loaded as its program does it, and runs a job on a service."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import ModuleType
from typing import Any

import httpx2
import numpy as np
import pytest
import torch
from PIL import Image

from sgsst_core.files.scene_file import read_scene
from tests.api.service import ROOT, Service
from tests.http_servers import serve
from tests.small_scenes import wall, write_files

pytestmark = pytest.mark.slow

EXAMPLES = ROOT / "docs" / "examples"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    return write_files(tmp_path_factory.mktemp("inputs"), wall())


@pytest.fixture(scope="module")
def service(whole_service: Service) -> Service:
    return whole_service


@pytest.fixture(autouse=True)
def url(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SGSST_URL", service.url)


def newest_result(service: Service) -> bytes:
    """Return the stylized PLY of the newest job."""
    job = httpx2.get(f"{service.url}/v1/jobs").json()["jobs"][0]
    return httpx2.get(f"{service.url}{job['links']['result']}").content


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModuleType]:
    """Load the files of the ComfyUI node as a package from their folder, as ComfyUI does."""
    folder = tmp_path_factory.mktemp("custom_nodes") / "sgsst"
    folder.mkdir()
    shutil.copy(EXAMPLES / "comfyui_node.py", folder / "__init__.py")
    shutil.copy(EXAMPLES / "sgsst_rest.py", folder)
    specification = importlib.util.spec_from_file_location("custom_sgsst", folder / "__init__.py")
    assert specification is not None
    assert specification.loader is not None
    module = sys.modules["custom_sgsst"] = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    yield module
    for name in ("custom_sgsst", "custom_sgsst.sgsst_rest"):
        del sys.modules[name]


def test_comfyui_node(node: ModuleType, service: Service, files: tuple[Path, Path, Path], tmp_path: Path) -> None:
    ((name, kind),) = node.NODE_CLASS_MAPPINGS.items()
    scene, cameras, style = files
    assert node.NODE_DISPLAY_NAME_MAPPINGS.keys() == {name}
    inputs = kind.INPUT_TYPES()
    image = torch.from_numpy(np.asarray(Image.open(style).convert("RGB"), dtype=np.float32) / 255)[None]
    given: dict[str, Any] = {"scene": str(scene), "style": image, "out": str(tmp_path / "a.ply"), "preset": "preview"}
    assert given.keys() == inputs["required"].keys()
    given |= {"cameras": str(cameras), "url": service.url}
    assert inputs["optional"].keys() >= given.keys() - inputs["required"].keys()
    outputs = getattr(kind(), kind.FUNCTION)(**given)
    assert len(outputs) == len(kind.RETURN_TYPES) == len(kind.RETURN_NAMES)
    path, preview = outputs
    assert Path(path).read_bytes() == newest_result(service)
    assert preview.dtype == torch.float32
    assert preview.shape[0] == 1
    assert preview.shape[-1] == 3
    assert 0 <= preview.min() < preview.max() <= 1
    with pytest.raises(RuntimeError, match="Both 'cameras'"):
        node.Service(service.url).stylize(scene, style, tmp_path / "b.ply", [cameras], orbit=3)
    assert not (tmp_path / "b.ply").exists()


def test_truncated_download_is_no_result(node: ModuleType, tmp_path: Path) -> None:
    class Truncating(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("ETag", f'"{hashlib.sha256(b"content").hexdigest()}"')
            self.send_header("Content-Length", "7")
            self.end_headers()
            self.wfile.write(b"cont" if self.path.endswith("truncated") else b"content")

        def log_message(self, *arguments: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Truncating) as server:
        serve(server)
        service = node.Service(f"http://127.0.0.1:{server.server_port}")
        with pytest.raises(RuntimeError, match="truncated or damaged"):
            service.download("job", "truncated", tmp_path / "out.ply")
        assert list(tmp_path.iterdir()) == []
        service.download("job", "whole", tmp_path / "out.ply")
        assert (tmp_path / "out.ply").read_bytes() == b"content"
        server.shutdown()


def test_handoff_to_a_viewer(service: Service, files: tuple[Path, Path, Path], tmp_path: Path) -> None:
    """The viewer is a program that copies the file it is to show."""
    scene, cameras, style = files
    viewer, out = tmp_path / "viewer", tmp_path / "stylized.ply"
    viewer.write_text(f'#!/bin/sh\n[ "$1" = --view ] && cp "$2" {tmp_path}/shown.ply\n')
    viewer.chmod(0o755)
    paths = [str(path) for path in (EXAMPLES / "open_stylized.py", scene, style, out)]
    command = [sys.executable, *paths, "--cameras", str(cameras), "--viewer", str(viewer)]
    subprocess.run(command, check=True, env=os.environ, cwd=tmp_path)
    assert (tmp_path / "shown.ply").read_bytes() == newest_result(service)


def test_handoff_to_blender(service: Service, files: tuple[Path, Path, Path], tmp_path: Path) -> None:
    """Blender's module, if it is installed, holds a point for each Gaussian with its color."""
    pytest.importorskip("bpy", reason="Blender's Python module is not installed: pip install bpy")
    scene, cameras, style = files
    example = str(EXAMPLES / "open_stylized.py")
    arguments = ["blender", "--", str(scene), str(style), "stylized.ply", "--cameras", str(cameras)]
    program = f"""
import json, runpy, sys, bpy
sys.argv = {arguments!r}
runpy.run_path({example!r}, run_name="__main__")
json.dump([each.value for each in bpy.context.object.data.attributes["f_dc_0"].data], open("f_dc_0.json", "w"))
"""
    subprocess.run([sys.executable, "-c", program], check=True, env=os.environ, cwd=tmp_path)
    values = np.asarray(json.loads((tmp_path / "f_dc_0.json").read_text()), dtype=np.float32)
    assert np.array_equal(values, read_scene(tmp_path / "stylized.ply").scene.sh_dc[:, 0].numpy())
