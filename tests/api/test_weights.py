"""Tests of a corrupted weight file of the feature network: effect of a flipped bit on the service's responses."""

import json
import os
import shutil
from pathlib import Path

import httpx2
import pytest

from tests.api.http.sending import refused
from tests.api.service import Service, Unready, wait_for
from tests.networks import flip_a_bit

PARAMETERS = {"preset": "standard", "steps_sos": 3, "backbone": "vgg16", "early_stop": False}


@pytest.fixture
def cache(tiny_cache: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tiny_cache, tmp_path / "cache"))


@pytest.mark.slow
def test_damaged_weights_block_jobs(cache: Path, paths: dict[str, Path], tmp_path: Path) -> None:
    """A job waits if the service starts with damaged weights. Once they are repaired, it runs without a restart."""
    files = {role: (path.name, path.read_bytes()) for role, path in paths.items()}
    data, weights = tmp_path / "data", cache / "vgg16.safetensors"
    sound = tmp_path / "sound"
    shutil.copy2(weights, sound)

    def submit(client: httpx2.Client) -> httpx2.Response:
        return client.post("/v1/jobs", files=files, data={"parameters": json.dumps(PARAMETERS)})

    with Service(data, alone=True, SGSST_CACHE=str(cache)) as service, service.client() as client:
        assert client.get("/readyz").json()["checks"]["weights"] == "ok"
        job = f"/v1/jobs/{submit(client).json()['id']}"
        canceled = f"/v1/jobs/{submit(client).json()['id']}"
        assert client.post(f"{canceled}/cancel").status_code == 200
    flip_a_bit(weights)
    with Unready(data, SGSST_CACHE=str(cache)) as service, service.client() as client:
        wait_for(lambda: service.said().count("no job is accepted or started") == 2, "both processes", service.said)
        assert "sgsst weights fetch vgg16" in service.said()
        answer = client.get("/readyz")
        assert answer.status_code == 503
        assert answer.json()["status"] == "unavailable"
        assert answer.json()["checks"]["weights"] == "DamagedWeightsError"
        for answer in (submit(client), client.post(f"{canceled}/retry")):
            refused(answer, 503, "weights-damaged")
            assert int(answer.headers["retry-after"]) > 0
        state = client.get(job).json()
        assert (state["status"], state["attempt"]) == ("queued", 0)
        os.replace(sound, weights)
        wait_for(lambda: client.get("/readyz").status_code == 200, "the service to be ready", service.said)
        wait_for(lambda: client.get(job).json()["status"] == "succeeded", "the job to succeed", service.said)
        assert submit(client).status_code == 202
