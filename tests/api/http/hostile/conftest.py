"""Service for tests of hostile requests, which checks after each test that it is unharmed."""

import json
import re
import struct
from collections.abc import Iterator
from pathlib import Path

import httpx2
import psutil
import pytest
import torch

from service.store import Store
from sgsst_core.files.formats import EXTRA_FORMATS
from sgsst_core.files.scene_file import write_scene
from tests.api.conftest import Services
from tests.api.http.sending import MB, Files, form
from tests.api.service import Service, wait_for
from tests.sgsst_core.files.formats.samples import archived, ksplat, streamed
from tests.small_scenes import wall

#: Maximum growth in bytes of the API process during one test, at its peak.
GROWTH = 48 * MB
#: Seconds after which the service under test gives up on a stalled body or head.
STILL = 2.0
#: Size in bytes of the largest result of the finished job.
LARGE = 16 * MB


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """Return the test scene as files in compressed formats."""
    folder, scene = tmp_path_factory.mktemp("packed"), wall()
    files: Files = {}
    for format in EXTRA_FORMATS:
        write_scene(folder / format.name, scene, format)
        files[format.name] = (folder / format.name).read_bytes()
    files["ksplat"] = ksplat(scene, level=1)
    levels = streamed([[scene], [scene.subset(torch.arange(20))]])
    files["zip"] = archived(folder / "zip", levels, "scene/").read_bytes()
    color = bytes([200, 100, 50, 255, 255, 128, 128, 128])
    rows = [struct.pack("<6f", *mean, 0.16, 0.16, 0.01) + color for mean in scene.means.tolist()]
    return {**files, "splat": b"".join(rows)}


@pytest.fixture(scope="module")
def service(services: Services, files: Files) -> Service:
    limits = {
        "SGSST_MAX_REQUEST_BYTES": str(100 * MB),
        "SGSST_MAX_UPLOAD_BYTES": str(80 * MB),
        "SGSST_MAX_GAUSSIANS": "5000",
        "SGSST_MAX_IMAGE_PIXELS": str(20 * MB),
        "SGSST_MAX_PIXELS": str(100 * MB),
        "SGSST_MAX_VIEWS": "100",
        "SGSST_MAX_PHOTOS": "50",
        "SGSST_RECEIVE_SECONDS": str(STILL),
        "SGSST_INSPECTION_SECONDS": "10",
        "SGSST_INSPECTION_BYTES": str(2000 * MB),
        "SGSST_MAX_JOBS_PER_KEY": "10000",
    }
    running = services(**limits)
    with running.client() as client:  # One-time allocations do not count as growth.
        assert client.post("/v1/jobs", files=form(files)).status_code == 202
        client.get("/openapi.json")
    return running


@pytest.fixture(autouse=True)
def unharmed(service: Service) -> Iterator[None]:
    """Check after each test that the API has not crashed, failed or grown, and has left no partial file."""
    before = api_of(service)
    logged = service.log.stat().st_size
    Path(f"/proc/{before.pid}/clear_refs").write_text("5")  # reset the peak memory
    start = memory_of(before, "VmRSS")
    yield
    assert api_of(service).pid == before.pid
    peak = memory_of(before, "VmHWM")
    assert peak - start < GROWTH, f"grew by {(peak - start) / MB:.0f} MB"
    folders = [service.data / name for name in ("incoming", "inspections")]
    wait_for(lambda: not any(any(folder.iterdir()) for folder in folders), "half files to be removed")
    with service.log.open(errors="replace") as log:
        log.seek(logged)
        said = log.read()
    assert "Traceback" not in said, said[-3000:]


def api_of(service: Service) -> psutil.Process:
    process = service.process("api.http.server")
    assert process is not None
    return process


def memory_of(process: psutil.Process, field: str) -> int:
    status = Path(f"/proc/{process.pid}/status").read_text()
    match = re.search(rf"{field}:\s+(\d+) kB", status)
    assert match
    return 1024 * int(match[1])


@pytest.fixture(scope="module")
def done(service: Service, files: Files) -> str:
    """Create a finished job with results, whose name attempts header injection."""
    with service.client() as client:
        name = 'x"; Set-Cookie: a=b <script>/../../é'
        data = {"parameters": json.dumps({"name": name})}
        job_id = str(client.post("/v1/jobs", files=form(files), data=data).json()["id"])
        for queued in client.get("/v1/jobs", params={"status": "queued", "limit": 200}).json()["jobs"]:
            if queued["id"] != job_id:
                client.post(f"/v1/jobs/{queued['id']}/cancel")
    contents = {"stylized.ply": files["scene"], "log.txt": b"", "colors.f16": bytes(LARGE), ".checkpoint": b""}
    service.finish(job_id, {**contents, "report.html": b"<script>alert(1)</script>"})
    return job_id


@pytest.fixture(scope="module", autouse=True)
def tidy(service: Service, client: httpx2.Client, store: Store) -> Iterator[None]:
    """Check after each module that the service is ready, and that a database row refers to each stored file."""
    yield
    assert client.get("/readyz").status_code == 200
    metrics = client.get("/metrics").text
    assert not re.findall(r'sgsst_requests_total\{[^}]*status="(?!503)5\d\d"\} [1-9]', metrics)
    known = {name for name in store.inputs.file_names() if name.startswith("blobs/")}
    files = {path.relative_to(service.data).as_posix() for path in (service.data / "blobs").glob("*/*")}
    assert files == known
