"""One large scene in the whole service: uploaded in three ways, validated, planned, stylized, downloaded.

    python -m benchmarks.large_upload [--millions 4] [--scene FILE] [--stages tus dry_run ...]

The server is `sgsst serve`; clients are curl, `sgsst submit` and plain tus requests. The connection is cut in the
middle of the tus upload and of a download, and both resume. Each stage reports its duration, the time in which files
were validated or planned (`inspecting_seconds`), the API's initial and peak memory, and the peak memory of the
processes that read the scene, with and without (`own`) mapped pages of the file. Clients run on the same machine and
use some of its capacity.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import hashlib
import json
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import psutil

from benchmarks.large_scene import multiplied, small_scene
from benchmarks.machine import write_result
from tests.api.service import ROOT, Service, wait_for
from tests.small_scenes import write_files

STAGES = ("tus", "dry_run", "submit", "curl", "download")
#: Settings for `tests.api.service`, with the intervals and threads of a real service.
SETTINGS: dict[str, Any] = {
    "SGSST_MIN_FREE_BYTES": "1000000000",
    "SGSST_CHECKPOINT_SECONDS": "60",
    "SGSST_PREVIEW_SECONDS": "20",
    "SGSST_POLL_SECONDS": "0.5",
    "OMP_NUM_THREADS": "",
    "NUMBA_NUM_THREADS": "",
}
_TUS = {"Tus-Resumable": "1.0.0"}
_PROCESSES = {
    "api": "api.http.server",
    "inspection": "service.inspection.process",
    "job": "service.scheduling.attempt_process",
}
_LOOK_SECONDS = 0.2
_PIECE = 1 << 20


class Memory:
    """Monitor of the memory of the service's processes, and of the time that they spend on inspecting files."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._peaks: dict[str, int] = {}
        self._inspecting = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Reset the peaks."""
        self._peaks, self._inspecting = {}, 0.0

    def figures(self) -> dict[str, float]:
        """Return memory peaks in MB since `begin`, and the seconds in which files were inspected."""
        peaks = {f"{name}_mb": round(size / 1e6, 1) for name, size in self._peaks.items()}
        return {"inspecting_seconds": round(self._inspecting, 1), **peaks}

    def close(self) -> None:
        """Stop monitoring."""
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        folder = self._service.data / "inspections"
        before = time.perf_counter()
        while not self._over.wait(_LOOK_SECONDS):
            for name, module in _PROCESSES.items():
                for process in self._service.processes(module):
                    for field, size in memory_of(process).items():
                        self._peaks[name + field] = max(self._peaks.get(name + field, 0), size)
            now = time.perf_counter()
            if folder.is_dir() and any(folder.iterdir()):
                self._inspecting += now - before
            before = now


def memory_of(process: psutil.Process) -> dict[str, int]:
    """Return a process's resident bytes with and without mapped files (`_peak`, `_own_peak`); empty if it is gone."""
    try:
        status = Path(f"/proc/{process.pid}/status").read_text()
    except OSError:
        return {}
    fields = dict(re.findall(r"(VmRSS|RssAnon):\s+(\d+) kB", status))
    names = {"_peak": "VmRSS", "_own_peak": "RssAnon"}
    return {field: 1024 * int(fields[name]) for field, name in names.items() if name in fields}


class Trial:
    """Stages of the benchmark. Each stage uses the results of the previous ones."""

    def __init__(self, service: Service, folder: Path, files: dict[str, Path], parameters: dict[str, Any]) -> None:
        self._service, self._folder, self._files, self._parameters = service, folder, files, parameters
        self._client = httpx2.Client(base_url=service.url, timeout=3600)
        self._upload = self._job = ""

    def tus(self) -> dict[str, Any]:
        """Upload half of the scene in a PATCH request that is cut off, and resume at the offset the service reports."""
        path = self._files["scene"]
        size = path.stat().st_size
        name = base64.b64encode(path.name.encode()).decode()
        begun = self._client.post(
            "/v1/uploads", headers=_TUS | {"Upload-Length": str(size), "Upload-Metadata": f"filename {name}"}
        )
        where = begun.raise_for_status().headers["location"]
        self._upload = begun.json()["id"]
        with contextlib.suppress(httpx2.TransportError):
            self._patch(where, 0, size // 2)
        offset = int(wait_for(lambda: self._offset(where), "the first part's end"))
        self._patch(where, offset, None)
        assert self._client.get(where).json()["complete"]
        return {"went_on_at_mb": round(offset / 1e6, 1)}

    def _offset(self, where: str) -> int:
        """Return the offset of an upload, once no request writes to it anymore."""
        answer = self._client.patch(where, content=b"", headers=self._patch_headers(0))
        return 0 if answer.status_code == 423 else int(answer.json()["offset"])

    def _patch(self, where: str, offset: int, cut_at: int | None) -> None:
        def pieces() -> Iterator[bytes]:
            with self._files["scene"].open("rb") as file:
                file.seek(offset)
                while piece := file.read(_PIECE):
                    if cut_at is not None and file.tell() > cut_at:
                        raise httpx2.WriteError("cut off")
                    yield piece

        answer = self._client.patch(where, content=pieces(), headers=self._patch_headers(offset))
        answer.raise_for_status()

    def _patch_headers(self, offset: int) -> dict[str, str]:
        return {**_TUS, "Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream"}

    def dry_run(self) -> dict[str, Any]:
        """Request a dry run that refers to the upload."""
        body = {"scene": self._upload, "parameters": json.dumps(self._parameters)}
        with self._files["style"].open("rb") as style, self._files["cameras"].open("rb") as cameras:
            files = {"style": ("style.png", style), "cameras": ("cameras.json", cameras)}
            answer = self._client.post("/v1/jobs", params={"dry_run": True}, data=body, files=files)
        answer.raise_for_status()
        plan = answer.json()
        return {name: plan[name] for name in ("gaussians", "views", "estimated_seconds", "memory_bytes")}

    def submit(self) -> dict[str, Any]:
        """Run `sgsst submit --out`: upload in parts, wait for the job, download and verify the result."""
        out = self._folder / "submitted.ply"
        command = [sys.executable, "-m", "api.cli", "submit", str(self._files["scene"]), "--json"]
        command += ["--style", str(self._files["style"]), "--cameras", str(self._files["cameras"])]
        command += ["--parameters", json.dumps(self._parameters), "--out", str(out), "--url", self._service.url]
        output = _run(command)
        self._job = json.loads(output.splitlines()[-1])["job"]
        return {**self._job_seconds(), "result_mb": round(out.stat().st_size / 1e6, 1)}

    def curl(self) -> dict[str, Any]:
        """Submit a job with curl in one multipart request, and wait for its end."""
        command = ["curl", "--silent", "--show-error", "--fail-with-body", f"{self._service.url}/v1/jobs"]
        command += [part for role, path in self._files.items() for part in ("-F", f"{role}=@{path}")]
        started = time.perf_counter()
        answer = _run([*command, "-F", f"parameters={json.dumps(self._parameters)}"])
        accepted = time.perf_counter() - started
        self._job = json.loads(answer)["id"]
        while not self._ended():
            time.sleep(0.5)
        return {"accepted_seconds": round(accepted, 1), **self._job_seconds()}

    def download(self) -> dict[str, Any]:
        """Download the result with curl, interrupt the download, and resume it with `curl -C -`."""
        url = f"{self._service.url}/v1/jobs/{self._job}/artifacts/stylized.ply"
        size = int(self._client.head(url).headers["content-length"])
        out = self._folder / "downloaded.ply"
        process = subprocess.Popen(["curl", "--silent", "--limit-rate", "200M", "-o", str(out), url])
        wait_for(lambda: out.exists() and out.stat().st_size > size // 3, "a third of the result", every=0.05)
        process.kill()
        process.wait()
        cut_at = out.stat().st_size
        started = time.perf_counter()
        _run(["curl", "--silent", "--show-error", "--fail", "-C", "-", "-o", str(out), url])
        seconds = time.perf_counter() - started
        digest = _sha256(out)
        assert self._client.head(url).headers["etag"] == f'"{digest}"', "what arrived is not what was made"
        return {"went_on_at_mb": round(cut_at / 1e6, 1), "rest_mb_per_second": round((size - cut_at) / seconds / 1e6)}

    def _ended(self) -> bool:
        return self._client.get(f"/v1/jobs/{self._job}").json()["status"] in ("succeeded", "failed")

    def _job_seconds(self) -> dict[str, Any]:
        """Return the record of the job's last attempt, and the job's seconds by part."""
        job = self._client.get(f"/v1/jobs/{self._job}").json()
        assert job["status"] == "succeeded", job["error"]
        report = self._client.get(f"/v1/jobs/{self._job}/artifacts/report.json").json()
        return {"job_attempt": job["attempts"][-1], "seconds_by_part": report.get("seconds_by_part")}


def _run(command: list[str]) -> str:
    """Run a command and return its output; raise CalledProcessError if it fails."""
    return subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.PIPE, text=True).stdout


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_inputs(folder: Path, millions: float, scene: Path | None) -> dict[str, Path]:
    """Write a job's input files: cameras, style, and a scene of the given size unless `scene` is an existing file."""
    small, cameras, _ = small_scene()
    written, camera_file, style = write_files(
        folder, multiplied(small, int(millions * 1e6)) if scene is None else small, cameras
    )
    return {"scene": scene or written, "cameras": camera_file, "style": style}


def run_stages(trial: Trial, memory: Memory, stages: list[str], api: Callable[[], int]) -> dict[str, Any]:
    """Run the stages and return their figures."""
    results: dict[str, Any] = {}
    for name in stages:
        before = api()
        memory.begin()
        started = time.perf_counter()
        result = getattr(trial, name)()
        seconds = round(time.perf_counter() - started, 1)
        results[name] = {"seconds": seconds, **result, "api_before_mb": round(before / 1e6, 1), **memory.figures()}
        print(name, json.dumps(results[name], indent=2), flush=True)
    return results


def main() -> None:
    """Run the stages, then print and store the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--millions", type=float, default=4.0)
    parser.add_argument("--scene", type=Path, help="instead of a generated scene")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--resolution", type=int, default=480)
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=list(STAGES))
    parser.add_argument("--folder", type=Path, help="for inputs and data; a temporary one is removed at the end")
    arguments = parser.parse_args()
    parameters = {"preset": "preview", "steps_coarse": 2, "steps_sos": 2, "backbone": "vgg16", "measure": 0.0}
    parameters |= {"views": arguments.views, "resolution": arguments.resolution}
    with tempfile.TemporaryDirectory(prefix="sgsst-large-", dir=arguments.folder) as name:
        folder = Path(name)
        files = write_inputs(folder, arguments.millions, arguments.scene)
        size = files["scene"].stat().st_size
        with Service(folder / "data", **SETTINGS) as service:
            api = service.process(_PROCESSES["api"])
            assert api is not None
            memory = Memory(service)
            trial = Trial(service, folder, files, parameters)
            stages = run_stages(trial, memory, arguments.stages, lambda: memory_of(api)["_peak"])
            memory.close()
    figures = {"bytes": size, "parameters": parameters, "stages": stages}
    print(write_result("large_upload", figures))


if __name__ == "__main__":
    main()
