"""Tests of the ComfyUI nodes: in a real ComfyUI if there is one, else with a stand-in of its published interface."""

import asyncio
import importlib
import inspect
import json
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import httpx2
import numpy as np
import pytest
import torch
from PIL import Image

from api.integrations.build import build
from sgsst_core.files.scene_file import read_scene
from tests.api.integrations import comfy_stand_in
from tests.api.service import ROOT, Service, wait_for
from tests.small_scenes import wall

pytestmark = pytest.mark.slow
WORKFLOW = ROOT / "api" / "integrations" / "comfyui" / "example_workflows" / "stylize_splat.json"


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModuleType]:
    """Load the built package with the stand-in."""
    folder = tmp_path_factory.mktemp("custom_nodes")
    with zipfile.ZipFile(build("comfyui", folder)) as archive:
        archive.extractall(folder)
    (folder / "sgsst").rename(folder / "sgsst_comfyui")
    stand_ins = comfy_stand_in.modules()
    sys.path.insert(0, str(folder))
    yield importlib.import_module("sgsst_comfyui")
    sys.path.remove(str(folder))
    for name in [*stand_ins, *(name for name in sys.modules if name.startswith("sgsst_comfyui"))]:
        del sys.modules[name]


@pytest.fixture(autouse=True)
def url(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SGSST_URL", service.url)


@pytest.fixture(scope="module")
def image(files: tuple[Path, Path, Path]) -> torch.Tensor:
    with Image.open(files[2]) as style:
        return torch.from_numpy(np.asarray(style.convert("RGB"), dtype=np.float32) / 255)[None]


def settings(**changed: Any) -> dict[str, Any]:
    return {"preset": "preview", "minutes": 0.0, "views": 4, "up": "-y", **changed}


def test_schemas_fit_nodes_and_workflow(nodes: ModuleType) -> None:
    extension = asyncio.run(importlib.import_module("sgsst_comfyui").comfy_entrypoint())
    schemas = {}
    for kind in asyncio.run(extension.get_node_list()):
        schema = kind.define_schema()
        schemas[schema.node_id] = schema
        assert list(inspect.signature(kind.execute).parameters) == [each.id for each in schema.inputs]
        for each in schema.inputs:
            if each.io_type == "COMBO":
                assert each.default in each.options
    workflow = json.loads(WORKFLOW.read_text())
    used = [node for node in workflow["nodes"] if node["type"] in schemas]
    assert {node["type"] for node in used} == {"SgsstStylize", "SgsstBlend"}
    for node in used:
        schema = schemas[node["type"]]
        assert {each["name"] for each in node["inputs"]} == {each.id for each in schema.inputs}
        assert [each["type"] for each in node["outputs"]] == [each.io_type for each in schema.outputs]


def test_stylize_and_blend(nodes: ModuleType, service: Service, image: torch.Tensor, tmp_path: Path) -> None:
    splat = comfy_stand_in.splat_of(wall(sh_degree=1))
    count = splat.positions.shape[1]
    for name in ("positions", "scales", "rotations", "opacities", "sh"):  # padding, as in a batch that was split
        part = getattr(splat, name)
        setattr(splat, name, torch.cat([part, torch.zeros_like(part[:, :5])], dim=1))
    splat.counts = torch.tensor([count])
    stylized, preview, job = nodes.Stylize.execute(splat, image, **settings()).args
    bar = comfy_stand_in.ProgressBar.last
    assert (bar.values[-1], bar.values) == (bar.total, sorted(bar.values))
    assert bar.previews
    assert (preview.dtype, preview.shape[0], preview.shape[-1]) == (torch.float32, 1, 3)
    assert 0 <= preview.min() < preview.max() <= 1
    (tmp_path / "result.ply").write_bytes(httpx2.get(f"{service.url}/v1/jobs/{job}/artifacts/stylized.ply").content)
    expected = read_scene(tmp_path / "result.ply").scene.sh_dc
    assert torch.equal(stylized.sh[0, :, 0], expected)
    assert torch.equal(stylized.positions, splat.positions[:, :count])
    blend = nodes.Blend.execute(splat, stylized, 0.25)[0]
    torch.testing.assert_close(blend.sh, 0.75 * splat.sh[:, :count] + 0.25 * stylized.sh)


def test_interruption_cancels_the_job(nodes: ModuleType, service: Service, image: torch.Tensor) -> None:
    comfy_stand_in.Interruption.wanted = True
    with pytest.raises(comfy_stand_in.InterruptProcessingException):
        nodes.Stylize.execute(comfy_stand_in.splat_of(wall()), image, **settings())
    with service.client() as client:
        newest = client.get("/v1/jobs").json()["jobs"][0]
        wait_for(lambda: client.get(newest["links"]["self"]).json()["status"] == "canceled", "the job to be canceled")


def test_what_cannot_be_done_is_said(nodes: ModuleType, image: torch.Tensor) -> None:
    one = comfy_stand_in.splat_of(wall())
    two = comfy_stand_in.splat_of(wall())
    two.positions = torch.cat([two.positions, two.positions])
    with pytest.raises(ValueError, match="batch of 2 splats"):
        nodes.Stylize.execute(two, image, **settings())
    with pytest.raises(ValueError, match="versions of the same splat"):
        nodes.Blend.execute(one, comfy_stand_in.splat_of(wall(sh_degree=1)), 0.5)
    with pytest.raises(RuntimeError, match="sgsst serve"):
        nodes.Stylize.execute(one, image, **settings(), service="http://127.0.0.1:9")
