"""Test of the running service with a reader process that is compromised by a malicious scene."""

import inspect
import json
import socket
import sys
from pathlib import Path

import pytest

from service.inspection import sandbox
from tests.api.service import ROOT, Service
from tests.service.inspection import attack
from tests.small_scenes import wall, write_files

SECRET = "what nobody may see"


@pytest.mark.slow
@pytest.mark.skipif(bool(sandbox.missing()), reason=f"the kernel lacks {sandbox.missing()}")
def test_compromised_reader_does_not_affect_service(tmp_path: Path) -> None:
    ply, cameras, style = write_files(tmp_path, wall())
    (tmp_path / "there").write_text("there")
    service = Service(tmp_path / "data", alone=True, AWS_SECRET_ACCESS_KEY=SECRET)
    service._command = [sys.executable, str(ROOT / "tests/service/inspection/compromised_api.py")]
    with service, service.client() as client, socket.create_server(("127.0.0.1", 0)) as listener:
        assert service._process is not None
        files = {"scene": ("a.ply", ply.read_bytes()), "cameras": ("c.json", cameras.read_bytes())}
        files["style"] = ("s.png", style.read_bytes())
        assert client.post("/v1/jobs", files=files).status_code == 202
        blob = max((service.data / "blobs").rglob("*"), key=lambda path: path.is_file() and path.stat().st_size)
        before = blob.read_bytes()
        target: dict[str, object] = {
            "data": str(service.data),
            "blob": str(blob),
            "outside": str(tmp_path),
            "own": "scene/a.ply",
        }
        target |= {"port": listener.getsockname()[1], "api": service._process.pid}
        code = ply.read_bytes() + f"# attack\n{inspect.getsource(attack)}\nreached = attack({target!r})\n".encode()
        answer = client.post("/v1/jobs", files={**files, "scene": ("a.ply", code)})
        assert (answer.status_code, answer.json()["code"]) == (422, "invalid-scene")
        detail = answer.json()["detail"]
        assert detail.startswith("{"), detail
        content = json.loads(detail)
        outcomes = {**content["files"], **content["calls"]}
        assert {name for name, outcome in outcomes.items() if outcome == "done"} == {"read own scene"}, outcomes
        assert SECRET not in str(content["environment"])
        assert client.post("/v1/jobs", files={**files, "style": ("t.png", style.read_bytes())}).status_code == 202
        assert service._process.poll() is None
        assert blob.read_bytes() == before
