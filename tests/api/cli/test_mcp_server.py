"""Tests of `sgsst mcp`: the SDK's own client over standard input and output, against a real service."""

import base64
import io
import re
import shutil
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client as McpClient
from mcp import StdioServerParameters
from mcp_types import CallToolResult, ImageContent, TextContent
from PIL import Image

from api.client import AsyncClient
from service.inputs import JobParameters
from tests.api.service import ROOT, Service

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def files(paths: dict[str, Path]) -> dict[str, str]:
    return {role: str(path) for role, path in paths.items()}


@pytest.fixture(scope="module")
def service(whole_service: Service) -> Service:
    return whole_service


@asynccontextmanager
async def tools(url: str, root: Path = ROOT) -> AsyncIterator[McpClient]:
    """Start `sgsst mcp` as an application with a language model would, and connect to it."""
    arguments = ["-m", "api.cli", "mcp", "--url", url, "--root", str(root)]
    command = StdioServerParameters(command=sys.executable, args=arguments, env={"PYTHONPATH": str(ROOT)})
    async with McpClient(command) as client:
        yield client


async def call(client: McpClient, name: str, **arguments: Any) -> dict[str, Any]:
    """Call a tool, and return its structured result."""
    result = await client.call_tool(name, arguments)
    assert not result.is_error, result.content
    assert result.structured_content is not None
    return result.structured_content


async def refusal(client: McpClient, name: str, **arguments: Any) -> str:
    """Call a tool that refuses its arguments, and return the message."""
    result: CallToolResult = await client.call_tool(name, arguments)
    assert result.is_error
    return "".join(each.text for each in result.content if isinstance(each, TextContent))


def test_tools_describe_themselves(service: Service) -> None:
    async def run() -> None:
        async with tools(service.url) as client:
            listed = {tool.name: tool for tool in (await client.list_tools()).tools}
            assert "estimate" in (client.instructions or "")
        assert listed.keys() == {"estimate", "submit", "status", "result", "blend", "share"}
        for tool in listed.values():
            assert tool.description
            assert tool.output_schema
            assert all(each.get("description") for each in tool.input_schema["properties"].values())
        reading = {name for name, tool in listed.items() if tool.annotations and tool.annotations.read_only_hint}
        assert reading == {"estimate", "status"}
        options = listed["submit"].input_schema["properties"]["options"]["description"]
        assert set(re.findall(r"`(\w+)`", options)) <= JobParameters.model_fields.keys()

    anyio.run(run)


def test_scene_is_estimated_stylized_and_blended(service: Service, files: dict[str, str], tmp_path: Path) -> None:
    inputs = {**files, "style": [files["style"]], "options": {"steps_coarse": 0, "steps_sos": 20}}

    async def run() -> None:
        async with tools(service.url, tmp_path.parent) as client, AsyncClient(service.url) as direct:
            before = [job.id async for job in direct.jobs()]
            estimate = await call(client, "estimate", **inputs)
            assert (estimate["gaussians"], estimate["views"]) == (616, 3)
            assert [job.id async for job in direct.jobs()] == before
            job_id = (await call(client, "submit", **inputs))["job_id"]
            await direct.wait(job_id)
            state = await call(client, "status", job_id=job_id)
            assert (state["status"], state["page"]) == ("succeeded", f"{service.url}/#/jobs/{job_id}")
            assert state["result"]["loss_after"] < state["result"]["loss_before"]

            answer = await client.call_tool("result", {"job_id": job_id, "out": str(tmp_path / "new" / "a.ply")})
            image = next(each for each in answer.content if isinstance(each, ImageContent))
            assert Image.open(io.BytesIO(base64.b64decode(image.data))).format == "JPEG"
            result = answer.structured_content or {}
            expected = await direct.download(job_id, tmp_path / "expected.ply")
            assert Path(result["path"]).read_bytes() == expected.read_bytes()
            assert result["urls"]["stylized.ply"] == f"{service.url}/v1/jobs/{job_id}/artifacts/stylized.ply"

            page = await call(client, "result", job_id=job_id, out=str(tmp_path / "scene.html"))
            assert Path(page["path"]).read_bytes().startswith(b"<!doctype html>")
            assert "does not end in" in await refusal(client, "result", job_id=job_id, out="a.usdz")
            link = await call(client, "share", job_id=job_id, poster=True)
            assert link["url"].startswith(f"{service.url}/shared/shr_")

            blend = await call(client, "blend", job_id=job_id, weight=0.5, out=str(tmp_path / "half.spz"))
            name = await direct.blend(job_id, 0.5, format="spz")
            assert blend["url"].endswith(f"/{job_id}/artifacts/{name}")
            stored = await direct.download(job_id, tmp_path / "stored.spz", name)
            assert Path(blend["path"]).read_bytes() == stored.read_bytes()

    anyio.run(run)


def test_refusals_are_messages(service: Service, files: dict[str, str], tmp_path: Path) -> None:
    missing = "job_1a1fe701a104f943e9d4d8cce5b818c"
    inputs = {**files, "style": [files["style"]]}

    async def run() -> None:
        async with tools(service.url, tmp_path.parent) as client:
            assert "no job" in await refusal(client, "status", job_id=missing)
            assert "Check the path" in await refusal(client, "submit", **inputs | {"scene": "missing.ply"})
            assert "switched off" in await refusal(client, "submit", **inputs | {"scene": "https://evil.test/a.ply"})
            assert "Unknown options: webhook" in await refusal(client, "submit", **inputs, options={"webhook": "x"})
            assert "seed" in await refusal(client, "estimate", **inputs, options={"seed": -1})
            assert "does not end in" in await refusal(client, "blend", job_id=missing, weight=1, out="a.txt")
        async with tools("http://127.0.0.1:1") as client:
            assert "cannot be reached" in await refusal(client, "status", job_id=missing)

    anyio.run(run)


def test_files_are_scenes_below_the_root_and_new(files: dict[str, str], tmp_path: Path) -> None:
    root, outside = tmp_path / "root", tmp_path / "outside"
    for folder in (root / "photos", outside):
        folder.mkdir(parents=True)
    for name, path in files.items():
        shutil.copy(path, outside / Path(path).name)
        shutil.copy(path, root / Path(path).name)
        (root / f"link_{name}{Path(path).suffix}").symlink_to(outside / Path(path).name)
    (root / "photos" / "0.png").symlink_to(outside / Path(files["style"]).name)
    (root / "existing.ply").write_bytes(b"mine")
    (root / "secret.txt").write_bytes(b"mine")
    (root / "dangling.ply").symlink_to(root / "nothing.ply")
    (root / "new").symlink_to(outside)
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    own = {name: Path(path).name for name, path in files.items()}
    inputs: list[tuple[dict[str, Any], str]] = [
        ({"scene": str(outside / own["scene"])}, "is not below"),
        ({"scene": f"../outside/{own['scene']}"}, "is not below"),
        ({"scene": "link_scene.ply"}, "is not below"),
        ({"style": [f"link_style{Path(own['style']).suffix}"]}, "is not below"),
        ({"cameras": "link_cameras.json"}, "is not below"),
        ({"photos": "photos"}, "is not below"),
        ({"scene": "secret.txt"}, "does not end in"),
        ({"style": ["secret.txt"]}, "does not end in"),
    ]
    outputs = [
        ("existing.ply", "exists"),
        ("dangling.ply", "exists"),
        ("new/a.ply", "is not below"),
        ("../a.ply", "is not below"),
        (str(outside / "a.ply"), "is not below"),
        (".bash_profile", "does not end in"),
        ("a", "does not end in"),
    ]

    async def run() -> None:
        async with tools("http://127.0.0.1:1", root) as client:
            for changed, message in inputs:
                given = {**own, "style": [own["style"]], **changed}
                for tool in ("estimate", "submit"):
                    assert message in await refusal(client, tool, **given), changed
            for out, message in outputs:
                assert message in await refusal(client, "result", job_id="job_1", out=out), out
                assert message in await refusal(client, "blend", job_id="job_1", weight=1, out=out), out

    anyio.run(run)
    assert {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")} == before
