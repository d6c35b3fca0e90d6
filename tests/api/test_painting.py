"""End-to-end tests of jobs with painted views over HTTP: refusals, plan, result, and a result that is painted again."""

import io
import json
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from PIL import Image

from api.cli.main import main
from api.client import Client
from sgsst_core.files.scene_file import read_scene
from tests.api.http.sending import refused
from tests.api.service import Service
from tests.small_scenes import blind_camera, cameras, wall, write_files

pytestmark = pytest.mark.slow
CAMERA = cameras()[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with scene.ply, cameras.json, style.png, and view.png, which states that it shows view_1."""
    folder = tmp_path_factory.mktemp("painting")
    scene, file, _ = write_files(folder, wall(sh_degree=1))
    exported = ["--export", "view_1", "--out", str(folder / "view.png")]
    assert main(["paint", str(scene), "--cameras", str(file), *exported]) == 0
    return folder


def entry(camera: Any = CAMERA, **changed: Any) -> dict[str, Any]:
    """Return an entry of the parameter `painted` for a camera."""
    parameters = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return {"camera": {**parameters, "world_to_camera": camera.world_to_camera.tolist(), **changed}}


def png(image: Image.Image | None = None, format_: str = "PNG") -> bytes:
    file = io.BytesIO()
    (image or Image.new("RGB", (CAMERA.width, CAMERA.height), "navy")).save(file, format_)
    return file.getvalue()


def resized(size: tuple[int, int]) -> bytes:
    return png(Image.new("RGB", size, "navy"))


NAVY, NAN = {"navy.png": png()}, Image.fromarray(np.full((CAMERA.height, CAMERA.width), np.nan, np.float32))
VIEW = {"painted": [{"view": "view_0"}]}
MIRRORED = (CAMERA.world_to_camera * -1)[:3].tolist()


@pytest.mark.parametrize(
    ("painted", "parameters", "code", "role"),
    [
        ({"a.png": png(), "b.png": png()}, {"painted": [{"view": "view_0"}] * 2}, "invalid-image", "painted"),
        ({"a.png": png(Image.new("RGBA", (64, 48)))}, VIEW, "invalid-image", "painted"),
        ({"a.png": resized((128, 96))}, VIEW, "invalid-image", "painted"),
        ({"a.png": resized((64, 40))}, VIEW, "invalid-image", "painted"),
        ({"a.png": b"no image"}, VIEW, "invalid-image", "painted"),
        ({"a.png": b""}, VIEW, "invalid-image", "painted"),
        ({"a.tiff": png(NAN, "TIFF")}, VIEW, "invalid-image", "painted"),
        (NAVY, {}, "invalid-cameras", "painted"),
        (NAVY, {"painted": [{"view": "front"}]}, "invalid-cameras", "painted"),
        (NAVY, {"painted": [entry(world_to_camera=MIRRORED)]}, "invalid-cameras", "painted"),
        (NAVY, {"painted": [entry(blind_camera())]}, "invalid-cameras", "painted"),
        (NAVY, {"painted": [entry(fx=1e300, fy=1e300, cx=-1e300)]}, "invalid-cameras", "painted"),
        (NAVY, {"painted": [entry(fx=0)]}, "invalid-request", None),
        (NAVY, {"painted": [{"view": "view_0"}] * 2}, "invalid-settings", None),
        (NAVY, {**VIEW, "preset": "preview"}, "invalid-settings", None),
        ({}, VIEW, "invalid-settings", None),
    ],
)  # fmt: skip
def test_unusable_paintings_are_refused(
    client: httpx2.Client,
    folder: Path,
    painted: dict[str, bytes],
    parameters: dict[str, Any],
    code: str,
    role: str | None,
) -> None:
    names = {"scene": "scene.ply", "cameras": "cameras.json"}
    fields = [(role, (name, (folder / name).read_bytes())) for role, name in names.items()]
    fields += [("painted", file) for file in painted.items()]
    before = client.get("/v1/jobs").json()["jobs"]
    answer = client.post("/v1/jobs", files=fields, data={"parameters": json.dumps(parameters)})
    assert refused(answer, 422, code).get("input") == role
    assert client.get("/v1/jobs").json()["jobs"] == before


def test_style_and_missing_result_are_refused(client: httpx2.Client, folder: Path) -> None:
    missing = "/v1/jobs/job_1a1fe701a104f943e9d4d8cce5b818c/artifacts/stylized.ply"
    files = [(role, (role, b"x")) for role in ("scene", "style", "painted")]
    assert refused(client.post("/v1/jobs", files=files), 422, "invalid-request")["input"] == "style"
    answer = client.post("/v1/jobs", json={"scene": missing, "painted": [missing]})
    assert refused(answer, 422, "unknown-input")["input"] == "scene"


def test_scene_follows_painted_views(whole_service: Service, folder: Path, tmp_path: Path) -> None:
    scene, file, dark = folder / "scene.ply", folder / "cameras.json", folder / "dark.png"
    with Image.open(folder / "view.png") as image:
        image.convert("RGB").point(lambda value: value // 2).save(dark)
    out = tmp_path / "command.ply"
    assert main(["paint", str(scene), "--cameras", str(file), "--view", f"view_1={dark}", "--out", str(out)]) == 0
    with Client(whole_service.url) as client:
        given: dict[str, Any] = {"cameras": file, "painted": {dark: {"view": "view_1"}}}
        plan = client.plan(scene, **given)
        assert (plan["views"], plan["pixels"], plan["style"]) == (1, CAMERA.width * CAMERA.height, [])
        assert plan["total_seconds"] > plan["estimated_seconds"] > 0
        job = client.wait(client.submit(scene, **given).id)
        assert job.status == "succeeded", job.data
        assert job.data["name"] == "scene · dark"
        assert job.data["result"]["psnr_after"] > job.data["result"]["psnr_before"] + 5
        assert job.data["progress"]["stage"] == "painting"
        assert [each["role"] for each in job.data["inputs"]] == ["scene", "cameras", "painted"]
        names = {each["name"] for each in client.artifacts(job.id)}
        assert {"stylized.ply", "colors.f16", "report.json", "plan.json", "previews/thumbnail.jpg"} <= names
        first = client.download(job.id, tmp_path / "first.ply")
        assert first.read_bytes() == out.read_bytes()
        assert client.download(job.id, tmp_path / client.blend(job.id, 0.5), client.blend(job.id, 0.5)).exists()

        strokes = Image.new("RGBA", (CAMERA.width, CAMERA.height))
        strokes.paste("red", (20, 10, 44, 38))
        strokes.save(tmp_path / "strokes.png")
        result = f"/v1/jobs/{job.id}/artifacts/stylized.ply"
        again = client.wait(client.submit(result, painted={tmp_path / "strokes.png": entry()}, orbit=4).id)
        assert again.status == "succeeded", again.data
        second = read_scene(client.download(again.id, tmp_path / "second.ply")).scene
    red = (second.sh_dc[:, 0] - read_scene(first).scene.sh_dc[:, 0]) > 0.5
    assert 20 < int(red.sum()) < len(second) / 2
