"""MCP server of `sgsst mcp`: tools with which a language model uses the service, over the asynchronous client.

The SDK evaluates the annotations of the tools, so that all of their names are imported when the module is loaded.
"""

import json
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import anyio.to_thread
from mcp.server.mcpserver import Image, MCPServer
from mcp.server.mcpserver.exceptions import ToolError
from mcp_types import CallToolResult, TextContent, ToolAnnotations
from pydantic import Field

from api import installed_version
from api.client import AsyncClient
from api.client.client import IMAGE_SUFFIXES, input_files
from api.client.transport import Job
from service.inputs import RESULT, JobParameters
from sgsst_core.errors import SgsstError
from sgsst_core.files import formats
from sgsst_core.files.formats.ply import PLY
from worker.options import path_or_url

_INSTRUCTIONS = """
Style transfer for 3D Gaussian Splatting scenes: the colors of a scene are optimized so that its views look like a
painting. Call `estimate` to learn how long a job takes, `submit` to queue it, `status` every few seconds until it has
ended, and `result` for a preview and the stylized scene. `blend` mixes the scene with its result, or with several.
"""
#: Suffixes of the files that are read, by role.
_SUFFIXES = {
    "scene": tuple(each.suffix for each in formats.FORMATS),
    "style": IMAGE_SUFFIXES,
    "cameras": (".json", ".bin", ".txt"),
    "photos": IMAGE_SUFFIXES,
}
#: What an estimate tells of a plan.
_ESTIMATED = ("total_seconds", "memory_bytes", "gaussians", "views", "warnings")
_READS = ToolAnnotations(read_only_hint=True, open_world_hint=False)
_CREATES = ToolAnnotations(read_only_hint=False, destructive_hint=False, open_world_hint=False)

Scene = Annotated[str, Field(description=f"Scene: path of a file ({formats.SUFFIXES}), or a URL.")]
Styles = Annotated[list[str], Field(min_length=1, description="Style images: paths or URLs. Several are mixed.")]
Cameras = Annotated[
    str | None,
    Field(description="Cameras: path of a cameras.json, transforms.json or COLMAP model; null for an orbit."),
]
Photos = Annotated[str | None, Field(description="Folder of the photos of the cameras; null if there are none.")]
Options = Annotated[
    dict[str, Any] | None,
    Field(
        description="Options by name, such as `preset` (preview, standard or paper), `orbit` (number of views around "
        "an object, in place of cameras), `content_weight` (light, balanced or strong), `style_weights`, "
        "`preserve_colors`, `within` (time budget in seconds). /docs of the service lists all."
    ),
]
JobId = Annotated[str, Field(description="ID of a job, from `submit`.")]
Out = Annotated[
    str | None,
    Field(
        description=f"File to write the scene to, which must not exist: {formats.DOWNLOAD_SUFFIXES}. Null writes none."
    ),
]


class Tools:
    """Tools of the MCP server. Expected errors become messages to the model.

    Args:
        root: Folder below which files are read and written; relative paths start there.
    """

    def __init__(self, client: AsyncClient, root: Path) -> None:
        self._client, self._root = client, root.resolve()

    async def estimate(
        self, scene: Scene, style: Styles, cameras: Cameras = None, photos: Photos = None, options: Options = None
    ) -> dict[str, Any]:
        """Check the files of a job and estimate its time and memory, without queueing it."""
        with _messages():
            files = await anyio.to_thread.run_sync(self._files, scene, style, cameras, photos)
            plan = await self._client.plan(**files, **_known(options))
        return {name: plan[name] for name in _ESTIMATED}

    async def submit(
        self, scene: Scene, style: Styles, cameras: Cameras = None, photos: Photos = None, options: Options = None
    ) -> dict[str, Any]:
        """Queue a job that stylizes a scene. It continues on the service whatever happens here."""
        with _messages():
            files = await anyio.to_thread.run_sync(self._files, scene, style, cameras, photos)
            return self._state(await self._client.submit(**files, **_known(options)))

    async def status(self, job_id: JobId) -> dict[str, Any]:
        """Show the status and progress of a job."""
        with _messages():
            return self._state(await self._client.job(job_id))

    async def result(self, job_id: JobId, out: Out = None) -> Annotated[CallToolResult, dict[str, Any]]:
        """Show the newest image of a job and the addresses of its files, and write its scene to a file."""
        with _messages():
            target = self._new_file(out, [f".{name}" for name in formats.DOWNLOADS])
            job = await self._client.job(job_id)
            artifacts = await self._client.artifacts(job_id)
            path = target and str(await self._client.download(job_id, target, RESULT))
            preview = job.data["preview"]
            image = None
            if preview:
                with tempfile.TemporaryDirectory() as folder:
                    file = await self._client.download(job_id, Path(folder) / "preview.jpg", preview)
                    image = Image(data=await anyio.to_thread.run_sync(file.read_bytes), format="jpeg")
        urls = {each["name"]: self._address(job_id, each["name"]) for each in artifacts}
        result = {"job_id": job_id, "status": job.status, "urls": urls, "path": path}
        text = TextContent(type="text", text=json.dumps(result))
        content = [text] if image is None else [text, image.to_image_content()]
        return CallToolResult(content=content, structured_content=result)

    async def blend(
        self,
        job_id: JobId,
        weight: Annotated[float, Field(description="Weight of the result; the scene has the rest up to 1.")],
        others: Annotated[
            dict[str, float] | None, Field(description="Weights of results of other jobs of the scene by job ID.")
        ] = None,
        out: Out = None,
    ) -> dict[str, str | None]:
        """Blend the scene of a finished job with its result, and with results of other jobs of the scene."""
        with _messages():
            target = self._new_file(out, [each.suffix for each in formats.RESULT_FORMATS])
            format = formats.format_of_name(target.name) if target else None
            name = await self._client.blend(job_id, weight, others, (format or PLY).name)
            path = await self._client.download(job_id, target, name) if target else None
        return {"url": self._address(job_id, name), "path": str(path) if path else None}

    async def share(
        self,
        job_id: JobId,
        days: Annotated[float, Field(description="Lifetime of the link, from a minute to 90 days.")] = 7.0,
        poster: Annotated[
            bool, Field(description="Whether sites where the link is posted can show an image of the result.")
        ] = False,
    ) -> dict[str, str | None]:
        """Create a read-only link to the result of a job, for people without a key."""
        with _messages():
            link = await self._client.share(job_id, days, poster=poster)
        return {name: link[name] for name in ("url", "embed_url", "expires_at")}

    def _address(self, job_id: str, name: str) -> str:
        return f"{self._client.url}/v1/jobs/{job_id}/artifacts/{name}"

    def _state(self, job: Job) -> dict[str, Any]:
        progress = job.progress or {}
        return {
            "job_id": job.id,
            **{name: job.data[name] for name in ("name", "status", "queue_position", "result")},
            **{name: progress.get(name) for name in ("stage", "fraction", "eta_s")},
            "error": job.error["message"] if job.error else None,
            "page": f"{self._client.url}/#/jobs/{job.id}",
        }

    def _files(self, scene: str, style: list[str], cameras: str | None, photos: str | None) -> dict[str, Any]:
        """Return the files of a job as arguments of the client, after checking each of them."""
        files: dict[str, Any] = {
            "scene": self._input(scene),
            "cameras": self._input(cameras) if cameras else None,
            "photos": self._inside(photos) if photos else None,
        }
        styles = [self._input(each) for each in style]
        for file in input_files(**files, styles=styles, masks={}, painted=()):
            if isinstance(file.source, Path):
                self._inside(file.source)
                if not file.name.lower().endswith(_SUFFIXES[file.role]):
                    raise ToolError(f"{file.source}: does not end in {', '.join(_SUFFIXES[file.role])}.")
        return {**files, "style": styles}

    def _input(self, text: str) -> str | Path:
        """Return a URL as it is, or the path of a file or folder below the root."""
        path = path_or_url(text)
        return path if isinstance(path, str) else self._inside(path)

    def _new_file(self, out: str | None, suffixes: Sequence[str]) -> Path | None:
        """Return the path of a file that does not exist yet, has one of some suffixes and lies below the root."""
        if out is None:
            return None
        if not out.lower().endswith(tuple(suffixes)):
            raise ToolError(f"{out}: does not end in {formats.listed(suffixes)}. Name the file to write.")
        path = self._inside(out)
        if os.path.lexists(self._root / out):
            raise ToolError(f"{path}: exists. Name another file.")
        return path

    def _inside(self, path: str | Path) -> Path:
        """Return a path without links, after checking that it lies below the root."""
        resolved = (self._root / path).resolve()
        if not resolved.is_relative_to(self._root):
            raise ToolError(f"{path}: is not below {self._root}. Name another file, or start `sgsst mcp` with --root.")
        return resolved


def _known(options: dict[str, Any] | None) -> dict[str, Any]:
    """Return options after checking their names, among which may be no other arguments of the client."""
    unknown = sorted(set(options or {}) - set(JobParameters.model_fields))
    if unknown:
        raise ToolError(f"Unknown options: {', '.join(unknown)}. /docs of the service lists all.")
    return options or {}


@contextmanager
def _messages() -> Iterator[None]:
    """Raise ToolError, whose message is passed to the model, in place of expected errors."""
    try:
        yield
    except (SgsstError, OSError) as error:
        raise ToolError(str(error)) from error


async def serve(root: Path, url: str | None, key: str | None) -> None:
    """Serve on standard input and output until the input ends; files are below `root`."""
    server: MCPServer[None] = MCPServer(
        "sgsst", instructions=_INSTRUCTIONS, version=installed_version(), log_level="WARNING"
    )
    async with AsyncClient(url, key) as client:
        tools = Tools(client, root)
        for tool in (tools.estimate, tools.submit, tools.status, tools.result, tools.blend, tools.share):
            server.add_tool(tool, annotations=_READS if tool in (tools.estimate, tools.status) else _CREATES)
        await server.run_stdio_async()
