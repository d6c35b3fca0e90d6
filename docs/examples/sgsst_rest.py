"""Client of the service for programs that cannot install packages: only Python's standard library is needed."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

#: Statuses of jobs that have ended without a result.
_FAILED = ("failed", "canceled", "expired")


class Service:
    """Connection to the service at a URL.

    Args:
        url: Address of the service; None for SGSST_URL, or this machine.
        key: API key; None for SGSST_KEY, or no key.
    """

    def __init__(self, url: str | None = None, key: str | None = None) -> None:
        self._url = (url or os.environ.get("SGSST_URL") or "http://127.0.0.1:8000").rstrip("/")
        key = key or os.environ.get("SGSST_KEY")
        self._headers = {"Authorization": f"Bearer {key}"} if key else {}

    def stylize(self, scene: Path, style: Path, out: Path, cameras: list[Path] | None = None, **options: Any) -> str:
        """Stylize a scene, write it to a file, and return the job's id.

        Args:
            scene: 3DGS scene.
            style: Style image.
            out: File to write, a PLY.
            cameras: Camera files; None requires the option `orbit`, a number of views.
            options: Parameters of the job, as in /docs of the service.

        Raises:
            RuntimeError: If the service refuses the job, or the job fails.
        """
        job = {
            "scene": self.upload(scene),
            "style": self.upload(style),
            "cameras": [self.upload(path) for path in cameras or ()],
            "parameters": options,
        }
        job_id = json.load(self.request("POST", "/v1/jobs", job))["id"]
        self.wait(job_id)
        self.download(job_id, "stylized.ply", out)
        return str(job_id)

    def upload(self, path: Path) -> str:
        """Upload a file, and return the id of the upload."""
        tus = {"Tus-Resumable": "1.0.0"}
        name = base64.b64encode(path.name.encode()).decode()
        size = path.stat().st_size
        created = {**tus, "Upload-Length": str(size), "Upload-Metadata": f"filename {name}"}
        upload_id = str(json.load(self.request("POST", "/v1/uploads", None, created))["id"])
        part = {**tus, "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
        with path.open("rb") as file:
            self.request("PATCH", f"/v1/uploads/{upload_id}", file, part | {"Content-Length": str(size)})
        return upload_id

    def wait(self, job_id: str) -> None:
        """Wait until a job has succeeded."""
        while True:
            answer = self.request("GET", f"/v1/jobs/{job_id}")
            job = json.load(answer)
            if job["status"] == "succeeded":
                return
            if job["status"] in _FAILED:
                raise RuntimeError(f"The job has {job['status']}: {(job['error'] or {}).get('message', job_id)}")
            time.sleep(float(answer.headers["Retry-After"]))

    def download(self, job_id: str, name: str, out: Path) -> None:
        """Write a file of a job to `out`, which is replaced once the file is complete.

        Raises:
            RuntimeError: If the connection was lost, or the SHA-256 of the file is not the one of its ETag.
        """
        part = out.with_name(out.name + ".part")
        digest = hashlib.sha256()
        with self.request("GET", f"/v1/jobs/{job_id}/artifacts/{name}") as answer, part.open("wb") as file:
            while block := answer.read(1 << 20):
                file.write(block)
                digest.update(block)
        if digest.hexdigest() not in answer.headers.get("ETag", ""):
            part.unlink()
            raise RuntimeError(f"The download of {name} was truncated or damaged. Try again.")
        part.replace(out)

    def request(self, method: str, path: str, body: object = None, headers: dict[str, str] | None = None) -> Any:
        """Send a request and return the response; `body` is an open file, or an object to send as JSON."""
        data: Any = body
        headers = {**self._headers, **(headers or {})}
        if body is not None and not hasattr(body, "read"):
            data, headers["Content-Type"] = json.dumps(body).encode(), "application/json"
        try:
            return urllib.request.urlopen(urllib.request.Request(self._url + path, data, headers, method=method))
        except urllib.error.HTTPError as error:
            raise RuntimeError(json.load(error)["detail"]) from error
