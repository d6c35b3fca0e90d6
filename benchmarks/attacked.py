"""Jobs of a service that is attacked while they run: submission, their ends, and what was published."""

from __future__ import annotations

import contextlib
import json
import secrets
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx2

from sgsst_core.files.scene_file import read_scene

FINISHED = ("succeeded", "failed", "canceled", "expired")
#: Seconds until a request that nothing answers, or a job that does not end, counts as lost.
PATIENCE = 900.0


@dataclass
class Attacked:
    """Service under attack, and the jobs that it has accepted.

    Attributes:
        urls: Addresses of its API processes.
        files: Input files of all jobs by role.
        parameters: Parameters of all jobs.
        accepted: Parameters in which each accepted job differs from the others, by job id.
        resent: Number of requests that were sent again.
    """

    urls: list[str]
    files: dict[str, Path]
    parameters: dict[str, Any]
    accepted: dict[str, dict[str, Any]] = field(default_factory=dict)
    resent: int = 0

    def call(self, method: str, path: str, **options: Any) -> httpx2.Response:
        """Send a request to any API process that responds; retry while none does.

        Raises:
            RuntimeError: If none responds in time.
        """
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            for url in self.urls:
                with contextlib.suppress(httpx2.TransportError):
                    answer = httpx2.request(method, f"{url}{path}", timeout=15, trust_env=False, **options)
                    if answer.status_code < 500:
                        return answer
                self.resent += 1
            time.sleep(0.05)
        raise RuntimeError(f"{method} {path} was never answered")

    def jobs(self) -> list[dict[str, Any]]:
        """Return all jobs that the service lists."""
        submitted: list[dict[str, Any]] = []
        query: dict[str, Any] = {"limit": 100}
        while True:
            answer = self.call("GET", "/v1/jobs", params=query).json()
            submitted += answer["jobs"]
            if not answer["next_cursor"]:
                return submitted
            query["cursor"] = answer["next_cursor"]

    def waiting(self) -> int:
        """Return the number of jobs that have not ended."""
        return sum(job["status"] not in FINISHED for job in self.jobs())

    def submit(self, **parameters: Any) -> str:
        """Submit a job and return its id."""
        body = {role: (path.name, path.read_bytes()) for role, path in self.files.items()}
        data = {"parameters": json.dumps(self.parameters | parameters)}
        headers = {"Idempotency-Key": secrets.token_hex(8)}
        answer = self.call("POST", "/v1/jobs", files=body, data=data, headers=headers)
        if answer.status_code != 202:
            raise RuntimeError(f"a good job was refused: {answer.text}")
        job_id = str(answer.json()["id"])
        self.accepted[job_id] = parameters
        return job_id

    def wait_for_all(self) -> dict[str, dict[str, Any]]:
        """Wait until all accepted jobs have ended or time is up, and return the last status of each existing job."""
        deadline = time.monotonic() + PATIENCE
        finished: dict[str, dict[str, Any]] = {}
        while time.monotonic() < deadline:
            for job_id in self.accepted:
                if finished.get(job_id, {}).get("status") not in FINISHED:
                    answer = self.call("GET", f"/v1/jobs/{job_id}")
                    if answer.status_code == 200:
                        finished[job_id] = answer.json()
            if all(finished.get(job_id, {}).get("status") in FINISHED for job_id in self.accepted):
                break
            time.sleep(0.5)
        return finished

    def published(self, job_id: str) -> int:
        """Return the number of events that announce a job's result."""
        text = self.call("GET", f"/v1/jobs/{job_id}/events").text
        return max(text.count('"name": "stylized.ply"'), text.count('"status": "succeeded"'))

    def result(self, job_id: str) -> bytes:
        """Download a job's PLY."""
        return self.call("GET", f"/v1/jobs/{job_id}/artifacts/stylized.ply").content

    def distance(self, job_id: str, expected: Path, folder: Path) -> float:
        """Return the distance of a job's colors from the expected ones, relative to the change by the job."""
        (folder / "result.ply").write_bytes(self.result(job_id))
        paths = (folder / "result.ply", expected, self.files["scene"])
        result, wanted, before = (read_scene(path).scene.sh_dc for path in paths)
        return float((result - wanted).norm() / (wanted - before).norm())
