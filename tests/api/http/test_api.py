"""Tests of the API in a real process: refusals, uploads, keys and memory."""

import base64
import hashlib
import io
import json
import re
import socket
import time
import unicodedata
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import httpx2
import numpy as np
import pytest
from annotated_types import Ge, Gt
from PIL import Image

from api.cli.machine_commands import run_service
from api.cli.main import main
from api.cli.options import kind_of
from service.files.blobs import BlobFolder
from service.files.objects import Artifacts
from service.inputs import JobParameters
from service.scheduling.housekeeping import remove_orphans
from service.settings import ServiceSettings
from service.store import Store, open_store
from service.store.jobs import NewJob
from sgsst_core.errors import SettingsError
from sgsst_core.progress import Progress
from sgsst_core.settings import Declared, declared
from tests.api.http.sending import (
    END,
    FILE,
    MB,
    OFFSET_STREAM,
    TUS,
    answer_on,
    begin,
    closed,
    connect,
    exchange,
    form,
    lines,
    part,
    post,
    refused,
    send,
)
from tests.api.service import Service, Unready, wait_for
from tests.pngs import chunk, png
from tests.service.store.helpers import lease
from tests.small_scenes import ball, write_files


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, tiny_installed: Path) -> Iterator[Service]:
    limits = {
        "SGSST_MAX_REQUEST_BYTES": str(500 * MB),
        "SGSST_MAX_UPLOAD_BYTES": str(400 * MB),
        "SGSST_MAX_GAUSSIANS": "5000",
        "SGSST_MAX_IMAGE_PIXELS": str(20 * MB),
        "SGSST_RECEIVE_SECONDS": "2",
        "SGSST_INSPECTION_SECONDS": "20",
        "SGSST_MAX_JOBS_PER_KEY": "1000",
    }
    data = tmp_path_factory.mktemp("api") / "data"
    with Service(data, alone=True, **limits) as running:
        yield running


def jobs_of(client: httpx2.Client) -> list[str]:
    return [entry["id"] for entry in client.get("/v1/jobs", params={"limit": 200}).json()["jobs"]]


# --- inputs that cannot be used ------------------------------------------------------------------------------------


def moved(cameras: bytes) -> bytes:
    """Move the cameras a million units away."""
    return cameras.replace(b'"position": [', b'"position": [1e6, 1e6, 1e6], "before": [')


@pytest.mark.parametrize(
    ("values", "at", "message"),
    [
        (
            {"orbit": "many"},
            "orbit",
            "Input should be a valid integer, unable to parse string as an integer, or 'auto'",
        ),
        ({"refine": "autp"}, "refine", "Input should be a valid number, unable to parse string as a number, or 'auto'"),
        ({"orbit": 0}, "orbit", "Input should be greater than or equal to 1"),
        (
            {"regions": [{"name": "a", "style": 3}]},
            "regions.0.style",
            "Input should be a valid string, or a valid list",
        ),
        ({"background": "red"}, "background", "'red' is not a color. Give black, white or three numbers from 0 to 255"),
        ({"list[x]": 1}, "list[x]", "is not a parameter."),
        ({"resolutoin": 1}, "resolutoin", "is not a parameter. Did you mean 'resolution'?"),
    ],
)
def test_value_of_several_types_gets_one_message(
    client: httpx2.Client, files: dict[str, bytes], values: dict[str, Any], at: str, message: str
) -> None:
    """The message lists the types, and names the parameter rather than one of its types."""
    answer = client.post("/v1/jobs", files=form(files), data={"parameters": json.dumps(values)})
    problem = refused(answer, 422, "invalid-request")
    assert [error["at"] for error in problem["errors"]] == [at]
    assert problem["detail"].startswith(f"{at}: {message}")


def test_results_are_kept_at_most_as_long_as_the_service_does(client: httpx2.Client, files: dict[str, bytes]) -> None:
    for days, detail in ((30.5, "must be at most 30, as long as this service"), (0, "greater than 0")):
        answer = client.post("/v1/jobs", files=form(files), data={"parameters": json.dumps({"retention_days": days})})
        problem = refused(answer, 422, "invalid-request")
        assert problem["detail"].startswith("retention_days: ")
        assert detail in problem["detail"]


def test_missing_and_surplus_files_are_rejected(client: httpx2.Client, files: dict[str, bytes]) -> None:
    assert refused(client.post("/v1/jobs", files=form(files, style=None)), 422, "invalid-request")["input"] == "style"
    photo = ("photos", ("a.png", files["style"]))
    refused(client.post("/v1/jobs", files=[*form(files, cameras=None), photo]), 422, "invalid-cameras")
    refused(client.post("/v1/jobs", files=[*form(files), ("scene", ("b.ply", files["scene"]))]), 422, "invalid-request")
    refused(client.post("/v1/jobs", files=form(files, weights=b"x")), 422, "invalid-request")
    refused(client.post("/v1/jobs", files=form(files, cameras=("a.exe", b"x"))), 422, "invalid-cameras")


WHOLE = np.packbits(np.ones(616, bool)).tobytes()


#: Names that a plain form would change, two of which would then be the same, each as a camera and as a file has it.
PHOTOS = {
    "v#3.png": "v#3.png",
    "v%3.png": "v%3.png",
    "100%25 a b.jpg": "100%25 a b.png",
    "cam;0/v&1.png": "images/cam;0/v&1.png",
    "cam;1/v&1.png": "images/cam;1/v&1.png",
    "caf\u00e9.png": "cafe\u0301.png",
}


@pytest.mark.slow
def test_photos_and_masks_keep_the_names_of_cameras(client: httpx2.Client, files: dict[str, bytes]) -> None:
    """A dry run uses every photo and mask. One that belongs to no camera is refused, however it is sent."""
    views = json.loads(files["cameras"])
    named = [{**views[index % len(views)], "id": index, "img_name": name} for index, name in enumerate(PHOTOS)]
    image = io.BytesIO()
    Image.new("L", (64, 48), 255).save(image, "PNG")
    parts = form({**files, "cameras": json.dumps(named).encode()})
    photos = [("photos", (name, image.getvalue())) for name in PHOTOS.values()]
    masks = [("mask", (f"m#1/{name}", image.getvalue())) for name in PHOTOS.values()]
    regions = {"regions": [{"name": "a", "select": "masks=m#1", "weight": 2}], "preset": "preview"}
    data = {"parameters": json.dumps(regions)}
    good = client.post("/v1/jobs?dry_run=true", files=[*parts, *photos, *masks], data=data)
    assert good.status_code == 200, good.text
    assert good.json()["photos"] == len(PHOTOS)
    assert "616 of 616 Gaussians" in good.text
    job = client.post("/v1/jobs", files=[*parts, *photos, *masks], data=data).json()
    listed = client.get(f"/v1/jobs/{job['id']}/inputs").json()["inputs"]
    names = [unicodedata.normalize("NFC", name) for name in PHOTOS.values()]
    assert [entry["name"] for entry in listed if entry["role"] == "photos"] == names

    uploads = [upload(client, image.getvalue(), name) for name in PHOTOS.values()]
    stored = {role: f"/v1/jobs/{job['id']}/inputs/{role}" for role in ("scene", "style", "cameras")}
    body = {**stored, "cameras": [stored["cameras"]], "photos": uploads}
    assert client.post("/v1/jobs", json=body).status_code == 202
    stray = upload(client, image.getvalue(), "v_3.png")
    problem = refused(client.post("/v1/jobs", json={**body, "photos": [*uploads, stray]}), 422, "invalid-image")
    assert "v_3.png: 1 of the photos" in problem["detail"]
    stray_mask = ("mask", ("m#1/v_3.png", image.getvalue()))
    problem = refused(client.post("/v1/jobs", files=[*parts, *masks, stray_mask], data=data), 422, "invalid-image")
    assert "v_3.png: 1 of the masks" in problem["detail"]
    for name in ("a\x01.png", ".hidden.png", "a" * 300 + ".png", "d/" * 9 + "a.png"):
        sent = client.post("/v1/jobs", json={**body, "photos": [upload(client, image.getvalue(), name)]})
        assert "Rename the file" in refused(sent, 422, "invalid-request")["detail"]


@pytest.mark.parametrize(
    ("select", "name", "content", "code", "detail"),
    [
        ("mask=m.bin", "m.bin", bytes(76), "invalid-mask", "m.bin: has 76 bytes, but scene.ply has 616 Gaussians."),
        ("mask=m.bin", "m.bin", bytes(1 << 20), "invalid-mask", "m.bin: has 1,048,576 bytes"),
        ("mask=m.bin", "m.bin", b"", "invalid-mask", "m.bin: is empty"),
        ("mask=m.npy", "m.npy", b"PK\x03\x04", "invalid-mask", "m.npy: cannot be read as .npy"),
        ("mask=m.npy", "m.npy", b"\x93NUMPY\x01\x00\x29\x23" + b"[" * 9001, "invalid-mask", "cannot be read as .npy"),
        ("mask=other.bin", "m.bin", WHOLE, "invalid-request", "no file 'mask' has that name"),
        ("masks=m.bin", "m.bin", WHOLE, "invalid-request", "no file 'mask' has that folder"),
        ("sphere=0,0,0,1", "m.bin", WHOLE, "invalid-request", "'m.bin' belongs to no region"),
        ("masks=m", "m/view_0.png", b"no image", "invalid-image", "m/view_0.png: is not an image"),
        ("masks=m", "m/view_0.png", png(2**31 - 1, 2**31 - 1, chunk(b"IDAT", b"")), "invalid-image", "m/view_0.png"),
        (
            "masks=m",
            "m/nowhere.png",
            png(4, 3, chunk(b"IDAT", zlib.compress(bytes(3 * 13)))),
            "invalid-image",
            "none of 3 cameras",
        ),
        (
            "masks=m",
            "m/view_0.png",
            png(4, 9, chunk(b"IDAT", zlib.compress(bytes(9 * 13)))),
            "invalid-image",
            "another aspect ratio",
        ),
        ("mask=m.bin", "m.bin", WHOLE, "invalid-settings", "Every Gaussian is frozen (a)"),
    ],
)
def test_unusable_masks_are_refused(
    client: httpx2.Client, files: dict[str, bytes], select: str, name: str, content: bytes, code: str, detail: str
) -> None:
    regions = [{"name": "a", "select": select, "freeze": True}]
    parts = [*form(files), ("mask", (name, content))]
    answer = client.post("/v1/jobs", files=parts, data={"parameters": json.dumps({"regions": regions})})
    problem = refused(answer, 422, code)
    assert detail in problem["detail"]
    assert problem["input"] in ("mask", "regions")
    assert "mask/" not in problem["detail"]


def test_stored_jobs_are_shown_as_they_were_stored(
    store: Store, client: httpx2.Client, files: dict[str, bytes]
) -> None:
    """Parameter names that this version lacks are shown as stored. Such a job can be renamed, but not retried."""
    created = client.post("/v1/jobs", files=form(files)).json()
    stored_parameters = {"preset": "preview", "sharpness": 3, "steps_sos": -5, "workers": "many"}
    job, _ = store.jobs.create(NewJob("local", "old", 0, stored_parameters, created["inputs"]), limit=1000)
    (listed,) = [entry for entry in client.get("/v1/jobs").json()["jobs"] if entry["id"] == job.id]
    answer = client.get(f"/v1/jobs/{job.id}")
    assert answer.status_code == 200
    assert listed["parameters"] == answer.json()["parameters"] == created["parameters"] | stored_parameters
    assert client.patch(f"/v1/jobs/{job.id}", json={"name": "older"}).json()["name"] == "older"
    assert client.post(f"/v1/jobs/{job.id}/cancel").json()["status"] == "canceled"
    problem = refused(client.post(f"/v1/jobs/{job.id}/retry"), 422, "invalid-settings")
    assert "stored by an earlier version" in problem["detail"]
    assert client.get(f"/v1/jobs/{job.id}").json()["status"] == "canceled"
    assert client.delete(f"/v1/jobs/{job.id}").status_code == 204


def value_of(option: Declared) -> object:
    """Return a valid value of an option."""
    kind = kind_of(option)
    if kind is bool:
        return True
    if get_origin(kind) is Literal:
        return get_args(kind)[-1]
    bounds: list[Any] = [
        item.ge if isinstance(item, Ge) else item.gt for item in option.limits if isinstance(item, Ge | Gt)
    ]
    return kind(bounds[0] + (1 if kind is int else 0.5))


def test_submit_sends_every_parameter(
    service: Service, client: httpx2.Client, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parameters: dict[str, Any] = {"name": "all", "resolution": 64, "background": [1.0, 1.0, 1.0]}
    parameters["style_weights"] = [1.0, 2.5]
    parameters["style_background"] = [0.0, 0.0, 0.0]
    parameters["regions"] = [
        {"name": "left", "select": "half-space=-1,0,0,0", "style": ["3_style.png:0.5"], "weight": 2.0},
        {"name": "rest", "weight": 3.0},
    ]
    parameters["scales"] = [1.0, 0.0, 0.5]
    texts = {"background": "white", "style_background": "black", "scales": "1,0,0.5"}
    ply, _, style = write_files(tmp_path, ball())
    command = ["submit", str(ply), "--style", str(style), "--style", f"{style}:2.5", "--url", service.url, "--json"]
    command += ["--region", "left:half-space=-1,0,0,0", "--region-style", f"left={style}:0.5"]
    command += ["--region-weight", "left=2", "--region-weight", "rest=3"]
    for name, option in declared(JobParameters).items():
        parameters[name] = parameters.get(name) or value_of(option)
        command += [f"--{name.replace('_', '-')}"]
        command += [] if parameters[name] is True else [texts.get(name, str(parameters[name]))]
    parameters["painted"] = None  # a job with a style has none
    assert main(command) == 0
    assert json.loads(capsys.readouterr().out)["parameters"] == parameters
    assert client.get("/v1/jobs", params={"limit": 1}).json()["jobs"][0]["parameters"] == parameters
    assert parameters.keys() == JobParameters.model_fields.keys()


# --- bodies --------------------------------------------------------------------------------------------------------


def test_truncated_body_is_rejected(service: Service, client: httpx2.Client, files: dict[str, bytes]) -> None:
    request = client.build_request("POST", "/v1/jobs", files=form(files))
    body = request.read()
    before = jobs_of(client)
    headers = {"content-type": request.headers["content-type"]}
    for end in (0, 10, 200, len(body) // 2, len(body) - 3):
        refused(client.post("/v1/jobs", content=body[:end], headers=headers), 400, "malformed-body")
    head = f"POST /v1/jobs HTTP/1.1\nContent-Length: {len(body)}\nContent-Type: {headers['content-type']}"
    cut_off(service, lines(head) + body[: len(body) // 2])
    assert jobs_of(client) == before
    wait_for(lambda: not list((service.data / "incoming").iterdir()), "half files to be removed")


def test_idle_connection_stays_open_between_requests(service: Service) -> None:
    with connect(service) as connection:
        connection.sendall(lines("POST /v1/jobs HTTP/1.1\nContent-Type: application/json\nContent-Length: 2") + b"{}")
        assert b" 422 " in answer_on(connection)[0].splitlines()[0]
        time.sleep(2.5)  # longer than a request may stall
        connection.sendall(lines("GET /livez HTTP/1.1\nConnection: close"))
        assert closed(connection).startswith(b"HTTP/1.1 200 OK")


def test_memory_is_constant_while_receiving_files(
    service: Service, client: httpx2.Client, files: dict[str, bytes]
) -> None:
    client.get("/readyz")
    api = service.process("api.http.server")
    assert api is not None
    before = api.memory_info().rss
    used = [before]

    def body() -> Iterator[bytes]:
        yield part(FILE.format("style"), b"")[:-2]
        for _ in range(150):
            yield bytes(MB)
            used.append(api.memory_info().rss)
        yield b"\r\n" + END

    refused(post(client, body()), 422, "invalid-request")  # the scene is missing
    assert max(used) - before < 64 * MB


# --- uploads -------------------------------------------------------------------------------------------------------


def cut_off(service: Service, data: bytes) -> None:
    """Send half a request, and end the connection."""
    with connect(service) as connection:
        connection.sendall(data)
        connection.shutdown(socket.SHUT_WR)
        closed(connection)


def upload(client: httpx2.Client, data: bytes, name: str) -> str:
    where = begin(client, len(data), name)
    assert send(client, where, 0, data).status_code == 204
    return where.rsplit("/", 1)[1]


def test_upload_in_parts_becomes_job(service: Service, client: httpx2.Client, files: dict[str, bytes]) -> None:
    scene = files["scene"]
    where = begin(client, len(scene))
    assert client.head(where, headers=TUS).headers["upload-offset"] == "0"
    assert send(client, where, 0, scene[:1000]).headers["upload-offset"] == "1000"
    assert client.head(where, headers=TUS).headers["upload-offset"] == "1000"
    right = "sha1 " + base64.b64encode(hashlib.sha1(scene[1000:2000]).digest()).decode()
    assert send(client, where, 1000, scene[1000:2000], **{"Upload-Checksum": right}).status_code == 204
    unfinished = {
        "scene": where.rsplit("/", 1)[1],
        "style": upload(client, files["style"], "style.png"),
        "parameters": {"orbit": 2},
    }
    refused(client.post("/v1/jobs", json=unfinished), 422, "unfinished-upload")
    assert send(client, where, 2000, scene[2000:]).status_code == 204
    shown = client.get(where).json()
    assert (shown["complete"], shown["sha256"]) == (True, hashlib.sha256(scene).hexdigest())
    assert client.head(where, headers=TUS).headers["upload-offset"] == str(len(scene))
    answer = client.post("/v1/jobs", json=unfinished)
    assert answer.status_code == 202, answer.text
    mixed = client.post("/v1/jobs", files=form(files, scene=None), data={"scene": unfinished["scene"]})
    assert mixed.status_code == 202, mixed.text


def test_method_of_an_upload_can_be_sent_as_a_header(client: httpx2.Client) -> None:
    where = begin(client, 10)
    part = {**TUS, "Upload-Offset": "0", "Content-Type": OFFSET_STREAM, "X-HTTP-Method-Override": "PATCH"}
    answer = client.post(where, content=b"01234", headers=part)
    assert (answer.status_code, answer.headers["upload-offset"]) == (204, "5")
    head = client.post(where, headers={**TUS, "X-HTTP-Method-Override": "HEAD"})
    assert (head.status_code, head.headers["upload-offset"]) == (200, "5")
    assert client.get(where, headers={"X-HTTP-Method-Override": "BREW"}).json()["code"] == "method-not-allowed"
    assert client.post(where, headers={**TUS, "X-HTTP-Method-Override": "DELETE"}).status_code == 204
    assert client.head(where, headers=TUS).status_code == 404
    assert client.post("/v1/uploads/x", headers={**TUS, "X-HTTP-Method-Override": "DELETE"}).status_code == 404


@pytest.mark.parametrize(
    "headers",
    [
        {"Upload-Concat": "partial"},
        {"Upload-Concat": "final;/v1/uploads/a /v1/uploads/b"},
        {"Upload-Defer-Length": "1"},
        {"Trailer": "X, Upload-Checksum"},
        {"Content-Type": OFFSET_STREAM},
    ],
)
def test_extensions_that_are_not_offered_are_refused(client: httpx2.Client, headers: dict[str, str]) -> None:
    answer = client.post("/v1/uploads", content=b"01234", headers={**TUS, "Upload-Length": "5", **headers})
    problem = refused(answer, 400, "unsupported-tus-extension")
    assert problem["detail"].startswith(next(iter(headers)))
    assert problem["detail"].endswith("creation,expiration,checksum,termination.")
    where = begin(client, 5)
    if "Trailer" in headers:
        refused(send(client, where, 0, b"01234", **headers), 400, "unsupported-tus-extension")
    assert client.head(where, headers=TUS).headers["upload-offset"] == "0"


def test_links_among_unfinished_uploads_are_not_followed(
    service: Service, client: httpx2.Client, tmp_path: Path
) -> None:
    target = tmp_path / "target"
    target.write_bytes(b"untouched!")
    for offset, target_now in ((0, target), (0, tmp_path / "missing")):
        where = begin(client, 10)
        part = service.data / "uploads" / f"{where.rpartition('/')[2]}.part"
        part.symlink_to(target_now)
        refused(send(client, where, offset, b"0123456789"), 404, "not-found")
    assert (target.read_bytes(), target.stat().st_mode & 0o200) == (b"untouched!", 0o200)
    assert not (tmp_path / "missing").exists()
    with pytest.raises(FileNotFoundError, match="symbolic link"):
        BlobFolder(tmp_path, None, 0).add(part)  # type: ignore[arg-type]  # the database is not reached
    assert target.read_bytes() == b"untouched!"


def test_broken_connection_preserves_received_bytes(service: Service, client: httpx2.Client) -> None:
    where = begin(client, 5 * MB)
    head = f"PATCH {where} HTTP/1.1\nHost: 127.0.0.1\nTus-Resumable: 1.0.0\nUpload-Offset: 0\n"
    head += f"Content-Type: {OFFSET_STREAM}\nContent-Length: {5 * MB}"
    cut_off(service, lines(head) + bytes(2 * MB))
    offset = int(
        wait_for(lambda: int(client.head(where, headers=TUS).headers["upload-offset"]), "the part to be saved")
    )
    assert 0 < offset <= 2 * MB
    assert send(client, where, offset, bytes(5 * MB - offset)).status_code == 204
    assert client.get(where).json()["sha256"] == hashlib.sha256(bytes(5 * MB)).hexdigest()


def test_idempotency_keys_prevent_duplicates(client: httpx2.Client, files: dict[str, bytes]) -> None:
    headers = {"Idempotency-Key": "the-same"}
    first = client.post("/v1/jobs", files=form(files), headers=headers)
    again = client.post("/v1/jobs", files=form(files), headers=headers)
    assert first.json()["id"] == again.json()["id"]
    assert again.headers["idempotency-replayed"] == "true"
    other = client.post("/v1/jobs", files=form(files), data={"parameters": '{"seed": 1}'}, headers=headers)
    refused(other, 422, "idempotency-key-reused")
    ids = [client.post("/v1/uploads", headers={**TUS, **headers, "Upload-Length": "5"}).json()["id"] for _ in range(2)]
    assert ids[0] == ids[1]


# --- who is asking -------------------------------------------------------------------------------------------------


def test_web_pages_cannot_use_a_service_without_keys(client: httpx2.Client) -> None:
    refused(client.get("/v1/jobs", headers={"Host": "evil.example"}), 403, "foreign-site")
    refused(client.get("/v1/jobs", headers={"Origin": "https://evil.example"}), 403, "foreign-site")
    refused(client.get("/v1/jobs", headers={"Origin": "null"}), 403, "foreign-site")
    assert client.get("/v1/jobs", headers={"Origin": str(client.base_url).rstrip("/")}).status_code == 200


def test_reachable_service_without_keys_does_not_start(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="there is no API key"):
        run_service(ServiceSettings(data=tmp_path / "data", host="0.0.0.0"), print)


def test_partial_files_of_dead_process_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = open_store(ServiceSettings(data=tmp_path))
    blobs, artifacts = BlobFolder(tmp_path, store.inputs, 0), Artifacts(f"file://{tmp_path / 'artifacts'}")
    half = blobs.incoming / "half.part"
    half.write_bytes(b"x")
    remove_orphans(store, artifacts, blobs)
    assert half.exists(), "it may still be written to"
    # no file's age can be made up: it is that of its name
    monkeypatch.setattr("service.files.objects.ORPHAN_SECONDS", -1.0)
    remove_orphans(store, artifacts, blobs)
    assert not half.exists()
    store.close()


@pytest.mark.slow
def test_full_disk_rejects_requests(tmp_path: Path, files: dict[str, bytes]) -> None:
    full = Unready(tmp_path / "data", alone=True, SGSST_MIN_FREE_BYTES=str(10**18))
    with full, full.client() as client:
        refused(client.post("/v1/jobs", files=form(files)), 507, "insufficient-storage")
        refused(client.post("/v1/uploads", headers={**TUS, "Upload-Length": "5"}), 507, "insufficient-storage")
        health = client.get("/readyz")
        assert (health.status_code, health.json()["checks"]["disk"]) == (503, "NoSpaceError")
        assert health.json()["checks"]["dispatchers"] == "none"


def test_job_is_named_by_its_files_and_renamed(client: httpx2.Client, files: dict[str, bytes]) -> None:
    named = form(files, scene=("plush.compressed.ply", files["scene"]), style=("starry_night.jpg", files["style"]))
    job = client.post("/v1/jobs", files=named).json()
    here = f"/v1/jobs/{job['id']}"
    assert job["name"] == "plush · starry_night"
    renamed = client.patch(here, json={"name": "at night"})
    assert renamed.status_code == 200
    assert renamed.json()["name"] == client.get(here).json()["name"] == "at night"
    assert client.patch(here, json={"name": ""}).json()["name"] == "plush · starry_night"
    refused(client.patch(here, json={"name": "a" * 201}), 422, "invalid-request")
    refused(client.patch(here, json={"name": "a\tb"}), 422, "invalid-request")
    refused(client.patch(here, json={"status": "queued"}), 422, "invalid-request")
    refused(client.patch(here, content=b"name"), 415, "unsupported-media-type")
    refused(client.patch("/v1/jobs/job_1", json={"name": "a"}), 404, "not-found")


def test_stream_after_last_event_is_empty(client: httpx2.Client, files: dict[str, bytes]) -> None:
    """A stream would never end after the last event of an ended job, or after an event that does not exist."""
    job_id = client.post("/v1/jobs", files=form(files)).json()["id"]
    client.post(f"/v1/jobs/{job_id}/cancel")
    stream = client.get(f"/v1/jobs/{job_id}/events").text
    last = max(int(line.removeprefix("id: ")) for line in stream.splitlines() if line.startswith("id: "))
    for number in (last, last + 1, 10**15):
        answer = client.get(f"/v1/jobs/{job_id}/events", headers={"Last-Event-ID": str(number)})
        assert answer.status_code == 204
    assert client.get(f"/v1/jobs/{job_id}/events", headers={"Last-Event-ID": str(last - 1)}).status_code == 200


def test_stream_after_unknown_event_starts_again(client: httpx2.Client, files: dict[str, bytes]) -> None:
    where = f"/v1/jobs/{client.post('/v1/jobs', files=form(files)).json()['id']}"
    first = ""
    for headers in ({}, {"Last-Event-ID": "100000"}, {"Last-Event-ID": str(2**61)}):
        with client.stream("GET", f"{where}/events", headers=headers) as stream:
            event = next(line for line in stream.iter_lines() if line.startswith("id: "))
            first = first or event
            assert event == first
    client.post(f"{where}/cancel")


def test_head_is_get_without_body(service: Service, client: httpx2.Client, files: dict[str, bytes]) -> None:
    job = client.post("/v1/jobs", files=form(files)).json()["id"]
    where = f"/v1/jobs/{job}"
    paths = ["/", "/docs", "/openapi.json", "/livez", "/readyz", "/v1/jobs", "/v1/session", "/v1/jobs/job_1"]
    paths += [where + each for each in ("", "/inputs", "/inputs/scene", "/artifacts", "/artifacts/none.ply", "/shares")]
    changing = {"date", "x-request-id"}
    for path in paths:
        head, response = client.head(path), client.get(path)
        assert head.status_code == response.status_code, path
        assert head.headers.keys() - changing == response.headers.keys() - changing, path
        assert all(head.headers[name] == response.headers[name] for name in head.headers.keys() - changing), path
        assert not head.content
        first, body = exchange(service, f"HEAD {path} HTTP/1.1\nConnection: close")
        assert first.startswith(f"HTTP/1.1 {response.status_code} ".encode())
        assert not body
    assert client.head(f"{where}/events").headers["content-type"].startswith("text/event-stream")
    assert client.head("/metrics").status_code == 200
    assert all(method in client.put(where).headers["allow"] for method in ("GET", "HEAD", "PATCH", "DELETE"))
    client.post(f"{where}/cancel")


@pytest.mark.parametrize("path", ["/events", "/inputs/scene", "", "/none"])
def test_responses_to_http_1_0_are_not_chunked(
    service: Service, client: httpx2.Client, files: dict[str, bytes], path: str
) -> None:
    where = f"/v1/jobs/{client.post('/v1/jobs', files=form(files)).json()['id']}"
    client.post(f"{where}/cancel")  # the stream ends
    wanted = client.get(where + path).content
    head, body = exchange(service, f"GET {where}{path} HTTP/1.0")
    assert b"transfer-encoding" not in head.lower()
    assert b"connection: close" in head.lower()
    assert body == wanted


def test_unknown_paths_and_methods(client: httpx2.Client) -> None:
    answer = client.get("/v1/nothing")
    refused(answer, 404, "not-found")
    assert answer.json()["detail"] == "There is nothing at '/v1/nothing'. /docs lists all paths."
    answer = client.put("/v1/jobs")
    refused(answer, 405, "method-not-allowed")
    assert answer.json()["detail"] == "'/v1/jobs' does not support PUT. Use one of GET, HEAD, POST."
    assert answer.headers["allow"] == "GET, HEAD, POST"
    assert client.head("/v1/nothing").status_code == 404
    assert client.head("/v1/jobs/job_1/cancel").status_code == 405
    for job_id in ("job_00000000000", "../x", "job_' OR 1=1", "a" * 5000):
        assert client.get(f"/v1/jobs/{job_id}").status_code == 404
    problem = refused(client.get("/v1/jobs", params={"limit": "many"}), 422, "invalid-request")
    assert problem["errors"][0]["at"] == "limit"
    refused(client.get("/v1/jobs", params={"cursor": "x"}), 422, "invalid-request")
    refused(client.get("/v1/jobs", params={"status": "x"}), 422, "invalid-request")


def test_readiness_reports_dispatchers(store: Store, client: httpx2.Client) -> None:
    answer = client.get("/readyz")
    assert (answer.status_code, answer.json()["status"]) == (200, "waiting")
    parts = dict.fromkeys(("database", "artifacts", "disk", "weights"), "ok")
    assert answer.json()["checks"] == {**parts, "dispatchers": "none"}
    store.operations.record_heartbeat("one", 8, 3)
    answer = client.get("/readyz")
    assert (answer.json()["status"], answer.json()["checks"]["dispatchers"]) == ("ok", "1")
    metrics = client.get("/metrics").text.splitlines()
    assert {"sgsst_dispatchers 1.0", "sgsst_slots 8.0", "sgsst_slots_free 3.0"} <= set(metrics)
    store.operations.remove_dispatcher("one")
    assert client.get("/readyz").json()["status"] == "waiting"
    assert "sgsst_dispatchers 0.0" in client.get("/metrics").text


def test_metrics_count_attempts_by_outcome(tmp_path: Path, files: dict[str, bytes]) -> None:
    with Service(tmp_path / "data", alone=True) as service, service.client() as client:
        for _ in range(3):
            client.post("/v1/jobs", files=form(files))
        now = time.time()
        store = open_store(ServiceSettings(data=service.data), lambda: now)
        lease(store, "lost")
        now += 1000
        store.leases.fail(lease(store), {"code": "x", "message": "x"}, permanent=True)
        for step, seconds in ((30, 10.0), (8, 4.0)):
            held = lease(store)
            store.leases.start(held)
            store.leases.report_progress(held, Progress(stage="sos", step=step, total=100, seconds=seconds))
        text = client.get("/metrics").text
        samples = dict(line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))
        expected = {
            "sgsst_lease_expirations_total": "1.0",
            "sgsst_attempts_total": "4.0",
            'sgsst_attempts_ended_total{outcome="lost"}': "1.0",
            'sgsst_attempts_ended_total{outcome="failed"}': "1.0",
            'sgsst_jobs_finished_total{status="failed"}': "1.0",
            'sgsst_jobs{status="running"}': "2.0",
            "sgsst_queue_wait_seconds_count": "4.0",
            "sgsst_job_seconds_count": "0.0",
            'sgsst_outages_total{cause="disk"}': "0.0",
            "sgsst_iterations_per_second": "5.0",
        }
        assert expected.items() <= samples.items()
        assert float(samples["sgsst_queue_wait_seconds_sum"]) >= 2000
        waits = {
            float(name.split('"')[1]): float(number)
            for name, number in samples.items()
            if name.startswith("sgsst_queue_wait_seconds_bucket")
        }
        # The first waited briefly, the other three (one of them twice) a thousand seconds.
        assert (waits[900.0], waits[1800.0], waits[float("inf")]) == (1, 4, 4)
        assert not re.search(r"job_[0-9a-f]{11}", text), "metrics name no job"
        store.close()
