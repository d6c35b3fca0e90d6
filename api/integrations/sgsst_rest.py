"""Client of the service for programs that cannot install packages. Its splats as PLY files need NumPy; all else is
Python's standard library.
"""

import base64
import hashlib
import http.client
import json
import os
import secrets
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

#: Statuses of jobs that have ended without a result.
_FAILED = ("failed", "canceled", "expired")
#: Seconds between the moments at which `Service.watch` yields.
_TICK = 0.5
#: Seconds without an answer after which a request fails, and after which `Service.watch` gives up.
_PATIENCE = 60.0


class ServiceError(RuntimeError):
    """Request that the service did not fulfill; the message says what to do."""


class UnreachableError(ServiceError):
    """Request that the service did not answer."""


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Handler that follows no redirect: a key, and what is sent with it, are for the given address alone."""

    def redirect_request(self, *ignored: Any) -> None:
        """Return no request to follow a redirect with."""


class Service:
    """Connection to the service at a URL.

    Args:
        url: Address of the service; None or empty for SGSST_URL, or this machine.
        key: API key; None or empty for SGSST_KEY if the service is that of SGSST_URL (or this machine), or no key.
    """

    def __init__(self, url: str | None = None, key: str | None = None) -> None:
        trusted = os.environ.get("SGSST_URL") or "http://127.0.0.1:8000"
        self.url = (url or trusted).rstrip("/")
        if not key and self.url.split("/")[:3] == trusted.split("/")[:3]:  # a key belongs to one origin
            key = os.environ.get("SGSST_KEY")
        self._open = urllib.request.build_opener(_NoRedirects).open
        self._headers = {"Authorization": f"Bearer {key}"} if key else {}

    def stylize(self, scene: Path, style: Path, out: Path, cameras: list[Path] | None = None, **options: Any) -> str:
        """Stylize a scene, write it to a file, and return the job's id.

        Args:
            out: File to write, a PLY.
            cameras: Camera files; None requires the option `orbit`, a number of views.
            options: Parameters of the job, as in /docs of the service.

        Raises:
            ServiceError: If the service cannot be reached or refuses the job, or the job fails.
        """
        job_id = self.submit(scene, style, cameras, **options)
        for _ in self.watch(job_id):
            pass
        self.download(job_id, "stylized.ply", out)
        return job_id

    def submit(self, scene: Path, style: Path, cameras: list[Path] | None = None, **options: Any) -> str:
        """Upload the files, submit a job, and return its id; the arguments are those of `stylize`."""
        job = {
            "scene": self.upload(scene),
            "style": self.upload(style),
            "cameras": [self.upload(path) for path in cameras or ()],
            "parameters": options,
        }
        return str(self.json("POST", "/v1/jobs", job)["id"])

    def upload(self, path: Path) -> str:
        """Upload a file, and return the id of the upload."""
        tus = {"Tus-Resumable": "1.0.0"}
        name = base64.b64encode(path.name.encode()).decode()
        size = path.stat().st_size
        created = {**tus, "Upload-Length": str(size), "Upload-Metadata": f"filename {name}"}
        upload_id = str(self.json("POST", "/v1/uploads", None, created)["id"])
        part = {**tus, "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
        with path.open("rb") as file:
            self.request("PATCH", f"/v1/uploads/{upload_id}", file, part | {"Content-Length": str(size)})
        return upload_id

    def watch(self, job_id: str) -> Iterator[dict[str, Any]]:
        """Yield the job every half second until it has succeeded; it is requested as often as the service allows.

        Raises:
            ServiceError: If the job ends without a result, or the service cannot be reached for a minute.
        """
        job: dict[str, Any] = {}
        due = answered = time.monotonic()
        while True:
            if time.monotonic() >= due:
                try:
                    with self.request("GET", f"/v1/jobs/{job_id}") as answer:
                        job = self._receive(lambda: json.load(answer))
                        due = time.monotonic() + float(answer.headers["Retry-After"] or 0)
                    answered = time.monotonic()
                except UnreachableError:
                    if not job or time.monotonic() > answered + _PATIENCE:
                        raise
            if job["status"] in _FAILED:
                reason = (job["error"] or {}).get("message", job_id)
                raise ServiceError(f"The job has {'been ' * (job['status'] == 'canceled')}{job['status']}: {reason}")
            yield job
            if job["status"] == "succeeded":
                return
            time.sleep(_TICK)

    def cancel(self, job_id: str) -> None:
        """Cancel a job."""
        self.request("POST", f"/v1/jobs/{job_id}/cancel").close()

    def download(self, job_id: str, name: str, out: Path) -> None:
        """Write a file of a job to `out`, which is replaced once the file is complete.

        Raises:
            ServiceError: If the connection was lost, or the SHA-256 of the file is not the one of its ETag.
        """
        part, digest = out.with_name(f".sgsst-{secrets.token_hex(8)}.part"), hashlib.sha256()
        try:
            with self.request("GET", f"/v1/jobs/{job_id}/artifacts/{name}") as answer, part.open("xb") as file:
                while block := self._receive(lambda: answer.read(1 << 20)):
                    file.write(block)
                    digest.update(block)
            if digest.hexdigest() not in answer.headers.get("ETag", ""):
                raise ServiceError(f"The download of {name} was truncated or damaged. Try again.")
            part.replace(out)
        finally:
            part.unlink(missing_ok=True)

    def json(self, method: str, path: str, body: object = None, headers: dict[str, str] | None = None) -> Any:
        """Send a request and return the JSON of its response; the arguments are those of `request`."""
        with self.request(method, path, body, headers) as answer:
            return self._receive(lambda: json.load(answer))

    def request(self, method: str, path: str, body: object = None, headers: dict[str, str] | None = None) -> Any:
        """Send a request and return the response; `body` is an open file, or an object to send as JSON."""
        data: Any = body
        headers = {**self._headers, **(headers or {})}
        if body is not None and not hasattr(body, "read"):
            data, headers["Content-Type"] = json.dumps(body).encode(), "application/json"
        try:
            return self._open(urllib.request.Request(self.url + path, data, headers, method=method), timeout=_PATIENCE)
        except urllib.error.HTTPError as error:
            raise ServiceError(self._reason(error)) from error
        except (OSError, http.client.HTTPException) as error:
            message = f"No service answers at {self.url}. Start it there with `sgsst serve`, or correct the address."
            raise UnreachableError(message) from error
        except ValueError as error:
            raise ServiceError(f"{self.url!r} is no address. Write it as http://127.0.0.1:8000.") from error

    def _receive(self, read: Callable[[], Any]) -> Any:
        """Return what a function reads from a response."""
        try:
            return read()
        except (OSError, http.client.HTTPException) as error:
            raise UnreachableError(f"The connection to {self.url} was lost. Try again.") from error
        except ValueError as error:
            raise ServiceError(self._foreign("no JSON")) from error

    def _foreign(self, what: str) -> str:
        """Return the message about another program at the address."""
        return (
            f"{self.url} is no service of sgsst, or one of another version ({what}). Correct the address, or update "
            "the service."
        )

    def _reason(self, error: urllib.error.HTTPError) -> str:
        """Return why the service refused a request, and what to do."""
        if error.code == 401:
            return (
                f"The service at {self.url} requires another API key. Create one with `sgsst keys create NAME` on its "
                "machine, and enter it in the settings, or set SGSST_URL to this address and SGSST_KEY to the key."
            )
        try:
            return str(json.load(error)["detail"])
        except (ValueError, KeyError, TypeError):
            return self._foreign(f"HTTP {error.code} {error.headers.get('Location', '')}".strip())


def orbit_options(preset: str, views: int, up: str, minutes: float) -> dict[str, Any]:
    """Return the parameters of a job without cameras; 0 views are as many as needed, 0 minutes no limit."""
    limit = {"within": 60 * minutes} if minutes > 0 else {}
    return {"preset": preset, "orbit": views or "auto", "up": up, **limit}


def fraction(job: dict[str, Any]) -> float:
    """Return the fraction of a job's steps that is completed."""
    progress = job["progress"]
    return 0.0 if progress is None or progress["loss"] is None else float(progress["fraction"])


def description(job: dict[str, Any]) -> str:
    """Return the state of a job as a line."""
    progress = job["progress"]
    if job["status"] != "running" or progress is None:
        position = job["queue_position"]
        return str(job["status"]) + (f", position {position}" if position else "")
    left = progress["eta_s"]
    return f"{progress['stage']}: {progress['fraction']:.0%}" + (
        "" if left is None else f", {int(left) // 60}:{int(left) % 60:02} left"
    )


class BackgroundJob(threading.Thread):
    """Job that paints a splat while a program stays usable. The program reads the attributes from its own thread.

    Args:
        columns: The splat, as for `write_splat`.
        live: Whether to download the colors while they are being painted.

    Raises:
        ValueError: If there is no style image.

    Attributes:
        out: PLY with the result, in a folder that is deleted with the job.
        fraction: Completed fraction of the steps.
        text: State as a line.
        colors: Newest `live/colors.f16`; None before the first, and without `live`.
        error: Why there is no result; None while running, and after success.
        canceled: Event to set in order to cancel the job.
    """

    def __init__(
        self, service: Service, columns: Mapping[str, Any], style: Path, *, live: bool = False, **options: Any
    ) -> None:
        super().__init__(daemon=True)
        if not style.is_file():
            raise ValueError(f"There is no style image {str(style)!r}. Choose a file.")
        self._folder = tempfile.TemporaryDirectory()
        self._scene, self.out = (Path(self._folder.name) / name for name in ("splat.ply", "stylized.ply"))
        write_splat(self._scene, columns)
        self.fraction = 0.0
        self.text = "uploading"
        self.colors: bytes | None = None
        self.error: str | None = None
        self.canceled = threading.Event()
        self._service, self._style, self._live, self._options = service, style, live, options
        self._etag = ""

    def run(self) -> None:
        """Submit the job, follow it, and download its result."""
        try:
            job_id = self._service.submit(self._scene, self._style, **self._options)
            for job in self._service.watch(job_id):
                if self.canceled.is_set():
                    self._service.cancel(job_id)
                    self.error = "The job was canceled."
                    return
                self.fraction, self.text = fraction(job), description(job)
                if self._live and job["status"] == "running":
                    self._fetch_colors(job_id)
            self._service.download(job_id, "stylized.ply", self.out)
        except (ServiceError, OSError) as error:
            self.error = str(error)

    def _fetch_colors(self, job_id: str) -> None:
        """Download the colors so far if there are newer ones."""
        try:
            path, known = f"/v1/jobs/{job_id}/artifacts/live/colors.f16", {"If-None-Match": self._etag}
            with self._service.request("GET", path, None, known if self._etag else None) as answer:
                self.colors, self._etag = answer.read(), answer.headers["ETag"]
        except (ServiceError, OSError, http.client.HTTPException):
            pass  # there are none yet, or none that are newer; the next call tries again


#: Properties of a splat's colors, and all that it must have besides its position.
COLORS = ("f_dc_0", "f_dc_1", "f_dc_2")
REQUIRED = (*COLORS, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")


def write_splat(path: Path, columns: Mapping[str, Any]) -> None:
    """Write a splat.

    Args:
        columns: Arrays of N numbers by property: `x`, `y`, `z`, `REQUIRED`, and `f_rest_*` if there are any.
    """
    import numpy as np

    rest = sorted((name for name in columns if name.startswith("f_rest_")), key=lambda name: int(name[7:]))
    names = ("x", "y", "z", *COLORS, *rest, *REQUIRED[3:])
    rows = np.stack([np.asarray(columns[name], "<f4") for name in names], axis=1)
    properties = "".join(f"property float {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + rows.tobytes())


def read_colors(path: Path) -> Any:
    """Return `COLORS` of a PLY whose properties are all float, [N, 3] float32."""
    import numpy as np

    header, _, content = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property float ")]
    rows = np.frombuffer(content, "<f4").reshape(-1, len(names))
    return np.ascontiguousarray(rows[:, [names.index(name) for name in COLORS]])
