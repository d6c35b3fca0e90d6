"""Test of a client that is generated from the OpenAPI document, in an environment of its own."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from api.http.app import create_app
from service.settings import ServiceSettings
from tests.api.service import ROOT, Service
from tests.small_scenes import wall, write_files

pytestmark = pytest.mark.slow

#: Generator, at the version that the test ran with. It needs older versions of other packages than the project, so it
#: is installed into an environment of its own.
GENERATOR = "openapi-python-client==0.29.1"
#: Commands in the documentation that write the configuration of the generator.
CONFIG = re.compile(r"^    (echo '.*' >>? config\.yaml)$", re.MULTILINE)
#: Program that uploads its files in parts, plans a job with them, and queues it: `PROGRAM URL SCENE CAMERAS STYLE`.
PROGRAM = """
import base64, io, sys
from pathlib import Path
from generated import Client
from generated.api.jobs import create_job, get_job
from generated.api.uploads import append_upload, create_upload
from generated.models import JobFromUploads, JobParameters, JobView, PlanView, Problem404, UploadView
from generated.types import File

client = Client(base_url=sys.argv[1], raise_on_unexpected_status=True)
ids = []
for path in map(Path, sys.argv[2:]):
    name = "filename " + base64.b64encode(path.name.encode()).decode()
    tus, size = "1.0.0", path.stat().st_size
    upload = create_upload.sync(client=client, upload_length=size, upload_metadata=name, tus_resumable=tus)
    assert isinstance(upload, UploadView), upload
    part = File(io.BytesIO(path.read_bytes()))
    sent = append_upload.sync_detailed(upload.id, client=client, body=part, upload_offset=0, tus_resumable=tus)
    assert sent.status_code == 204, sent
    ids.append(upload.id)
scene, cameras, style = ids
parameters = JobParameters.from_dict({"preset": "preview"})
job = JobFromUploads(scene=scene, style=style, cameras=[cameras], parameters=parameters)
plan = create_job.sync(client=client, body=job, dry_run=True)
assert isinstance(plan, PlanView), plan
assert plan.gaussians == 616
created = create_job.sync(client=client, body=job)
assert isinstance(created, JobView), created
assert get_job.sync(created.id, client=client).status == "queued"
missing = get_job.sync("job_1a1fe701a104f943e9d4d8cce5b818c", client=client)
assert isinstance(missing, Problem404), missing
print(created.name)
"""


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the commands of an environment with the generator."""
    folder = tmp_path_factory.mktemp("generator")
    venv.create(folder, with_pip=False)
    pip = [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python"), "--disable-pip-version-check"]
    installed = subprocess.run([*pip, "install", "--quiet", GENERATOR], check=False, capture_output=True, text=True)
    if installed.returncode:
        pytest.skip(f"{GENERATOR} cannot be installed: {installed.stderr[-200:]}")
    return folder / "bin"


def test_generated_client_uploads_plans_and_submits(commands: Path, tmp_path: Path) -> None:
    """Generation has no warnings, and the client's operations work against a real service."""
    (tmp_path / "openapi.json").write_text(json.dumps(create_app(ServiceSettings()).openapi()))
    config = "\n".join(CONFIG.findall((ROOT / "docs" / "service.md").read_text()))
    subprocess.run(config, shell=True, cwd=tmp_path, check=True)
    options = ["--path", "openapi.json", "--config", "config.yaml", "--output-path", "generated", "--meta", "none"]
    generate = [str(commands / "openapi-python-client"), "generate", *options, "--fail-on-warning"]
    environment = os.environ | {"PATH": "/usr/bin:/bin"}  # without ruff
    process = subprocess.run(generate, cwd=tmp_path, env=environment, check=False, capture_output=True, text=True)
    assert process.returncode == 0, process.stdout + process.stderr
    assert "warning" not in (process.stdout + process.stderr).lower()

    ply, cameras, style = write_files(tmp_path, wall())
    with Service(tmp_path / "data", alone=True) as service:
        arguments = [service.url, str(ply), str(cameras), str(style)]
        program = [str(commands / "python"), "-c", PROGRAM, *arguments]
        ran = subprocess.run(program, cwd=tmp_path, check=False, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip() == "scene · style"
