"""Tests of hostile requests: the API responds with a problem document, and keeps no files or memory afterwards."""

import base64
import contextlib
import gzip
import json
import re
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx2
import pytest
from annotated_types import Ge

from api.cli.options import kind_of
from service.inputs import JobParameters
from service.problems import SHARE_ID, UPLOAD_ID
from service.store import Store
from service.store.jobs import NewJob
from service.store.tables import UploadRow
from sgsst_core.settings import declared
from tests.api.http.sending import (
    BOUNDARY,
    END,
    FILE,
    MB,
    NAMES,
    NO_DIGITS,
    OFFSET_STREAM,
    TUS,
    Files,
    begin,
    connect,
    count_jobs,
    exchange,
    form,
    lines,
    part,
    post,
    refused,
    send,
)
from tests.api.service import Service, wait_for

BODIES: list[tuple[str, bytes, int]] = [
    ("nothing", b"", 400),
    ("another boundary", b"--other\r\n\r\nx\r\n--other--\r\n", 400),
    ("the end alone", END, 422),
    ("no end", part(FILE.format("scene")), 400),
    ("no head", f"--{BOUNDARY}\r\n\r\nx\r\n".encode() + END, 422),
    ("no name", part('Content-Disposition: form-data; filename="x"') + END, 422),
    ("no disposition", part("Content-Type: text/plain") + END, 422),
    ("a head without colon", part("what is this") + END, 400),
    ("zero bytes in the head", part('Content-Disposition: form-data; name="sc\0ene"') + END, 422),
    ("another charset", part("Content-Disposition: form-data; name=\"scene\"; filename*=none''%ff%fe") + END, 422),
    (
        "endless continuations",
        part('Content-Disposition: form-data; name="scene"; ' + "; ".join(f'filename*{i}="x"' for i in range(5000)))
        + END,
        400,
    ),
    ("a boundary within", part(FILE.format("scene"), part(FILE.format("style"))) + END, 422),
    ("rubbish", bytes(range(256)) * 100, 400),
    ("bare line ends", part(FILE.format("scene")).replace(b"\r\n", b"\n") + END, 400),
    ("a head of a megabyte", part("Content-Disposition: form-data; name=" + "x" * MB) + END, 400),
    ("a head of 2,000 lines", part("\r\n".join(f"X-{i}: y" for i in range(2000))) + END, 400),
    ("an unknown field", part(FILE.format("scene/../../x")) + END, 422),
    ("a field of a megabyte", part('Content-Disposition: form-data; name="parameters"', b" " * MB) + END, 422),
    ("a field twice", 2 * part('Content-Disposition: form-data; name="parameters"', b"{}") + END, 422),
    ("no text", part('Content-Disposition: form-data; name="parameters"', b"\xff\xfe") + END, 422),
]


@pytest.mark.parametrize(("body", "status"), [case[1:] for case in BODIES], ids=[case[0] for case in BODIES])
def test_malformed_bodies_are_rejected(client: httpx2.Client, store: Store, body: bytes, status: int) -> None:
    before = count_jobs(store)
    codes = ("malformed-body",) if status == 400 else ("invalid-request", "unknown-upload", "invalid-scene")
    refused(post(client, body), status, *codes)
    assert count_jobs(store) == before


@pytest.mark.parametrize(
    ("kind", "status"),
    [
        ("application/x-www-form-urlencoded", 415),
        ("application/octet-stream", 415),
        ("multipart/mixed; boundary=x", 415),
        ("application/json-patch+json", 415),
        ("nonsense", 415),
        ("multipart/form-data", 400),
        ("multipart/form-data; boundary=", 400),
        ("multipart/form-data; boundary=" + "x" * 3000, 400),
        ("multipart/form-data; boundary=\xff\xfe", 400),
        ("multipart/form-data; boundary*=none''%ff", 400),
    ],
)
def test_malformed_content_types_are_rejected(client: httpx2.Client, kind: str, status: int) -> None:
    answer = client.post("/v1/jobs", content=b"x=y", headers=[(b"content-type", kind.encode("latin-1"))])
    refused(answer, status, "unsupported-media-type" if status == 415 else "malformed-body")


def test_encoded_body_is_rejected(client: httpx2.Client, files: Files) -> None:
    """Nothing decompresses bodies, so a body cannot be a decompression bomb."""
    request = client.build_request("POST", "/v1/jobs", files=form(files))
    answer = post(
        client, gzip.compress(request.read()), request.headers["content-type"], **{"content-encoding": "gzip"}
    )
    refused(answer, 415, "unsupported-media-type")
    answer = post(client, gzip.compress(b"{}"), "application/json", **{"content-encoding": "gzip"})
    refused(answer, 415, "unsupported-media-type")


def test_too_many_parts_are_rejected(client: httpx2.Client, files: Files) -> None:
    small = part(FILE.format("photos"), b"x")
    refused(post(client, small * 1000 + END), 422, "too-many-files")
    named = part('Content-Disposition: form-data; name="photos"', b"upl_00000000000")
    refused(post(client, named * 20_000 + END), 422, "too-many-files")
    empty = part('Content-Disposition: form-data; name="photos"', b"")
    refused(post(client, empty * 20_000 + END), 422, "too-many-files")
    for role in ("photos", "mask"):
        job = {"scene": UPLOAD_ID, "style": UPLOAD_ID, role: [UPLOAD_ID] * 1000}
        refused(client.post("/v1/jobs", json=job), 422, "too-many-files")


def test_endless_part_header_is_rejected(client: httpx2.Client) -> None:
    def body() -> Iterator[bytes]:
        yield f"--{BOUNDARY}\r\nContent-Disposition: ".encode()
        for _ in range(90):
            yield b"x" * MB

    refused(post(client, body()), 400, "malformed-body")


def test_too_long_bodies_are_rejected(client: httpx2.Client, files: Files) -> None:
    def chunked(size: int) -> Iterator[bytes]:
        yield part(FILE.format("style"))[:-3]
        for _ in range(size):
            yield bytes(MB)
        yield b"\r\n" + END

    refused(post(client, chunked(85)), 413, "too-large")  # a file
    refused(post(client, chunked(120)), 413, "too-large")  # a request of undeclared length
    refused(post(client, b'{"scene": "' + b"x" * 2 * MB + b'"}', "application/json"), 413, "too-large")


NUMBERS = ["NaN", "Infinity", "-Infinity", "1e999", "-1e999", "1" + "0" * 400, "-1", "1.5e-400", "9" * 5000]


OPTIONS = declared(JobParameters)


FIELDS = [name for name, option in OPTIONS.items() if kind_of(option) in (int, float)]


#: Fields that accept one of these numbers.
MAY_BE_0 = {name for name in FIELDS if Ge(0) in OPTIONS[name].limits}


MAY_BE_NEGATIVE = {"elevation", "style_rotation"}  # angles


def submit_text(client: httpx2.Client, parameters: str) -> httpx2.Response:
    """Submit a job with these parameters and files that do not exist, because parameters are validated first."""
    body = f'{{"scene": "upl_00000000000", "style": "upl_00000000000", "parameters": {parameters}}}'
    return post(client, body.encode(), "application/json")


@pytest.mark.parametrize("field", FIELDS)
def test_malformed_numbers_are_rejected(client: httpx2.Client, field: str) -> None:
    refused(submit_text(client, "{}"), 422, "unknown-upload")
    for number in NUMBERS:
        if field in MAY_BE_0 | MAY_BE_NEGATIVE and number == "1.5e-400":
            continue  # rounds to 0
        if field in MAY_BE_NEGATIVE and number == "-1":
            continue
        refused(submit_text(client, f'{{"{field}": {number}}}'), 422, "invalid-request", "invalid-settings")


TEXTS = [
    '{"background": [NaN, 0, 0]}',
    '{"background": [1e999, 0, 0]}',
    '{"background": [2, 0, 0]}',
    '{"background": [0, 0, 0, 0]}',
    '{"background": "no color"}',
    '{"name": "\\ud800"}',
    '{"name": "a\\u0000b"}',
    '{"name": {"$ne": null}}',
    '{"name": ["a"]}',
    '{"\\ud800": 1}',
    '{"' + "x" * 50_000 + '": 1}',
    '{"__proto__": {}}',
    '{"__class__": "x"}',
    "{" + ",".join(f'"a{i}": 1' for i in range(3000)) + "}",
    '{"drop_invalid": "maybe"}',
    '{"preset": "../../preview"}',
    '{"backbone": "/etc/passwd"}',
    '{"up": null}',
    "null",
    "1",
    '"x"',
    "[]",
    '{"a":' * 10_000,
    "[" * 60_000 + "]" * 5_000,
    "{'seed': 1}",
    '{"seed": 1} {"seed": 2}',
]


@pytest.mark.parametrize("text", TEXTS, ids=[text[:25] for text in TEXTS])
def test_malformed_parameters_are_rejected(client: httpx2.Client, files: Files, text: str) -> None:
    refused(submit_text(client, text), 422, "invalid-request", "invalid-settings")
    answer = post(client, part('Content-Disposition: form-data; name="parameters"', text.encode()) + END)
    refused(answer, 422, "invalid-request", "invalid-settings")


JSON_BODIES = [
    b"",
    b"{",
    b"null",
    b"[]",
    b"{}",
    b'{"scene": 1, "style": 2}',
    b"\xff",
    b"[" * 900_000,
    b'{"scene": "\\ud800", "style": "x"}',
    b'{"scene": "upl_00000000000", "style": "upl_00000000000", "webhook": "\\ud800"}',
    b'{"scene": "../../x", "style": "/etc/passwd"}',
    b'{"scene": "upl_00000000000\\u0000", "style": "x"}',
    b'{"scene": "x", "style": "x", "photos": [' + b'"x",' * 20_000 + b'"x"]}',
    b'{"scene": "x", "style": "x", "cameras": [' + b'"x",' * 9 + b'"x"]}',
    b'{"scene": "x", "style": "x", "parameters": [1]}',
    b'{"scene": "x", "style": "x", "webhook": "file:///etc/passwd"}',
    b'{"scene": "job_00000000000", "style": "key_00000000000"}',
]


@pytest.mark.parametrize("body", JSON_BODIES, ids=[body[:30].decode("latin-1") for body in JSON_BODIES])
def test_json_with_unknown_uploads_is_rejected(client: httpx2.Client, body: bytes) -> None:
    answer = post(client, body, "application/json")
    refused(answer, 400 if body == b"\xff" else 422, "malformed-body", "invalid-request", "unknown-upload")


def test_webhooks_are_rejected_while_switched_off(client: httpx2.Client, files: Files) -> None:
    for url in ("http://169.254.169.254/latest", "file:///etc/passwd", "http://[::1", "x" * 60_000):
        refused(client.post("/v1/jobs", files=form(files), data={"webhook": url}), 422, "webhooks-off")


def test_numbers_must_be_digits(client: httpx2.Client, service: Service, done: str) -> None:
    """Queries and headers accept digits only; malformed body lengths are refused below the app."""
    for number in ("1_0", "+10", " 10", "10 ", "\u0661\u0660", "10.0"):
        refused(client.get("/v1/jobs", params={"limit": number}), 422, "invalid-request")
    for number in NO_DIGITS:
        answer = client.get(f"/v1/jobs/{done}/events", headers={"Last-Event-ID": number})
        refused(answer, 422, "invalid-request")
    for length in ("1_0", "+10", "1 0", "10.0", "0x10", "\xb2"):
        head, body = exchange(service, f"POST /v1/jobs HTTP/1.1\nContent-Length: {length}")
        assert head.startswith(b"HTTP/1.1 400 ")
        assert json.loads(body)["code"] == "malformed-request"


def test_uploads_require_protocol_version(client: httpx2.Client) -> None:
    """tus 1.0 requires the version in all requests except OPTIONS. `GET` is not part of tus."""
    where = begin(client, 5)
    data = {"Upload-Length": "5", "Upload-Offset": "0", "Content-Type": OFFSET_STREAM}
    for version in ({}, {"Tus-Resumable": ""}, {"Tus-Resumable": "0.2.2"}):
        for method, path in (("POST", "/v1/uploads"), ("PATCH", where), ("DELETE", where)):
            answer = client.request(method, path, headers={**data, **version}, content=b"12345")
            refused(answer, 412, "unsupported-tus-version")
            assert answer.headers["tus-version"] == "1.0.0"
        assert client.head(where, headers=version).status_code == 412
    assert client.options("/v1/uploads").status_code == 204
    assert client.get(where).json()["offset"] == 0
    assert client.delete(where, headers=TUS).status_code == 204


def test_malformed_upload_creation_is_rejected(client: httpx2.Client) -> None:
    for length in ("-1", "x", "1.5", "1e3", "0x10", "", str(2**60), "9" * 5000, "NaN", *NO_DIGITS):
        refused(client.post("/v1/uploads", headers={**TUS, "Upload-Length": length}), 422, "invalid-request")
    empty = {**TUS, "Upload-Length": "0", "Upload-Metadata": "filename c2NlbmUucGx5"}
    assert refused(client.post("/v1/uploads", headers=empty), 400, "malformed-body")["detail"].startswith(
        "scene.ply: is"
    )
    refused(client.post("/v1/uploads", headers={**TUS, "Upload-Length": str(81 * MB)}), 413, "too-large")
    refused(
        client.post("/v1/uploads", headers={"Tus-Resumable": "9", "Upload-Length": "5"}), 412, "unsupported-tus-version"
    )
    for metadata in (
        b"filename !!!",
        b"filename \xff\xfe",
        b"filename /////w==",
        b"filename YQ",
        b"name =" + b"=" * 100,
    ):
        headers = {b"Tus-Resumable": b"1.0.0", b"Upload-Length": b"5", b"Upload-Metadata": metadata}
        refused(client.post("/v1/uploads", headers=headers), 400, "malformed-body")
    refused(
        client.post("/v1/uploads", headers={**TUS, "Upload-Length": "5", "Upload-Metadata": "x" * 5000}),
        422,
        "invalid-request",
    )


@pytest.mark.slow
def test_lists_of_many_photos_take_little_memory(client: httpx2.Client, service: Service, store: Store) -> None:
    """Six lists at once of jobs with 2,000 photos each, and lists that are not read; pages have every name once."""
    sha256 = store.jobs.inputs(store.jobs.page(None, limit=1)[0].row.id)[0]["sha256"]
    entry = {"name": "scene.ply", "sha256": sha256, "size": 1}
    photos = [{**entry, "role": "photos", "name": f"images/left/IMG_2026_{number:06d}.jpg"} for number in range(2000)]
    inputs = [*photos, {**entry, "role": "scene"}]
    ids = [store.jobs.create(NewJob("local", "", 0, {}, inputs), limit=10**6)[0].id for _ in range(20)]
    with ThreadPoolExecutor(6) as threads:
        answers = list(threads.map(lambda _: client.get("/v1/jobs?limit=200"), range(6)))
    for answer in answers:
        jobs = answer.json()["jobs"][:20]
        assert [job["id"] for job in jobs] == ids[::-1]
        assert jobs[0]["input_counts"] == {"photos": 2000, "scene": 1}
        assert [each["role"] for each in jobs[0]["inputs"]] == ["scene"]
        assert len(answer.content) < MB
    with contextlib.ExitStack() as stack:
        for path in ("/v1/jobs?limit=200", f"/v1/jobs/{ids[0]}/inputs") * 20:
            stack.enter_context(connect(service)).sendall(lines(f"GET {path} HTTP/1.1"))
        assert client.get("/v1/jobs?limit=1").json()["next_cursor"] == ids[-1]
    names, cursor = [], "0"
    while cursor is not None:
        page = client.get(f"/v1/jobs/{ids[0]}/inputs?limit=700&cursor={cursor}").json()
        names += [each["name"] for each in page["inputs"]]
        cursor = page["next_cursor"]
    assert names == [each["name"] for each in inputs]
    assert page["inputs"][-2]["url"] == f"/v1/jobs/{ids[0]}/inputs/photos:1999"
    large = {"scene": UPLOAD_ID, "style": UPLOAD_ID, "parameters": {"name": "x", "background": [0.0] * 40_000}}
    assert client.post("/v1/jobs", json=large).status_code == 422
    for job_id in ids:
        store.jobs.cancel(job_id, None)
        store.jobs.delete(job_id, None)


def test_upload_names_cannot_escape_folder(client: httpx2.Client, service: Service) -> None:
    for name in NAMES:
        metadata = f"filename {base64.b64encode(name.encode()[:2900]).decode()}".strip()
        answer = client.post("/v1/uploads", headers={**TUS, "Upload-Length": "5", "Upload-Metadata": metadata})
        if answer.status_code == 400:  # cut within a character
            continue
        assert answer.status_code == 201, answer.text
        shown = answer.json()["filename"]
        assert not shown.startswith(("/", "."))
        assert ".." not in shown.split("/")
        assert client.delete(answer.headers["location"], headers=TUS).status_code == 204
    assert not list((service.data / "uploads").iterdir())


def test_malformed_upload_parts_are_rejected(client: httpx2.Client, service: Service) -> None:
    where = begin(client, 1000)
    file = service.data / "uploads" / (where.rsplit("/", 1)[1] + ".part")
    assert send(client, where, 0, bytes(100)).status_code == 204
    for offset in (0, 99, 101, 1000, 2**59):
        assert refused(send(client, where, offset, bytes(10)), 409, "conflict")["offset"] == 100
    for value in ("-1", "x", "1.5", str(2**60), "9" * 5000, "", *NO_DIGITS):
        refused(send(client, where, value, bytes(10)), 422, "invalid-request")
    wrong = base64.b64encode(bytes(32)).decode()
    refused(send(client, where, 100, bytes(10), **{"Upload-Checksum": f"sha256 {wrong}"}), 460, "checksum-mismatch")
    refused(send(client, where, 100, bytes(10), **{"Upload-Checksum": "sha256"}), 460, "checksum-mismatch")
    for checksum in (b"sha256 \xff\xfe", b"sha256 !", b"sha512 x", b"__class__ x", b"x" * 5000):
        refused(send(client, where, 100, bytes(10), **{"Upload-Checksum": checksum}), 400, "malformed-body")
    refused(
        send(client, where, 100, bytes(10), **{"Content-Type": "application/octet-stream"}),
        415,
        "unsupported-media-type",
    )
    refused(send(client, where, 100, bytes(10), **{"Tus-Resumable": "0.2.2"}), 412, "unsupported-tus-version")
    refused(send(client, where, 100, bytes(10), **{"Content-Encoding": "gzip"}), 415, "unsupported-media-type")
    assert client.head(where, headers=TUS).headers["upload-offset"] == "100"

    sized = {"Upload-Checksum": f"sha256 {wrong}"}
    refused(send(client, where, 100, bytes(901), **sized), 413, "too-large")
    refused(send(client, where, 100, iter([bytes(MB)] * 70), **sized), 413, "too-large")
    assert client.head(where, headers=TUS).headers["upload-offset"] == "100"
    assert file.stat().st_size <= 1000, "more is on the disk than was announced"
    refused(send(client, where, 100, bytes(901)), 413, "too-large")
    offset = int(client.head(where, headers=TUS).headers["upload-offset"])
    assert send(client, where, offset, bytes(1000 - offset)).status_code == 204
    refused(send(client, where, 5, b"x"), 409, "conflict")
    refused(send(client, where, 1000, b"x"), 413, "too-large")
    assert client.get(where).json()["complete"]
    assert not file.exists()
    assert client.delete(where, headers=TUS).status_code == 204


def test_ended_uploads_reject_parts(client: httpx2.Client, store: Store, files: Files) -> None:
    where = begin(client, 1000)
    upload_id = where.rsplit("/", 1)[1]
    with store.database.writing() as session:
        session.get_one(UploadRow, upload_id).expires_at = time.time() - 1
    refused(send(client, where, 0, bytes(10)), 404, "not-found")
    refused(client.get(where), 404, "not-found")
    assert client.head(where, headers=TUS).status_code == 404
    refused(client.delete(where, headers=TUS), 404, "not-found")
    refused(
        post(client, json.dumps({"scene": upload_id, "style": upload_id}).encode(), "application/json"),
        422,
        "unknown-upload",
    )
    deleted = begin(client, 1000)
    assert client.delete(deleted, headers=TUS).status_code == 204
    refused(send(client, deleted, 0, bytes(10)), 404, "not-found")
    for name in ("upl_' OR 1=1", "..", "upl_" + "0" * 5000, "%00", "job_00000000000"):
        assert client.get(f"/v1/uploads/{name}").status_code in (404, 405)


def test_second_writer_of_upload_is_locked_out(client: httpx2.Client, service: Service) -> None:
    where = begin(client, 1000)
    head = f"PATCH {where} HTTP/1.1\nTus-Resumable: 1.0.0\nUpload-Offset: 0\n"
    head += f"Content-Type: {OFFSET_STREAM}\nContent-Length: 1000"
    with connect(service) as first:
        first.sendall(lines(head + "\nExpect: 100-continue"))
        assert b" 100 " in first.recv(100)  # this request has the turn
        first.sendall(bytes(10))
        refused(send(client, where, 0, bytes(10)), 423, "upload-locked")
    wait_for(lambda: client.head(where, headers=TUS).headers["upload-offset"] == "10", "what has come to be saved")
    assert send(client, where, 10, bytes(990)).status_code == 204


def test_other_keys_ids_are_not_found(client: httpx2.Client, service: Service, store: Store, files: Files) -> None:
    _, mine = store.keys.create("hostile-mine")
    _, other = store.keys.create("hostile-other")
    with service.client(mine) as me, service.client(other) as you:
        job_id = me.post("/v1/jobs", files=form(files)).json()["id"]
        where = begin(me, 5)
        nothing = refused(you.get("/v1/jobs/job_0000000000000000000000000000000"), 404, "not-found")
        for method, path, body in (
            ("GET", "", None), ("POST", "/finish", None), ("POST", "/cancel", None), ("POST", "/retry", None),
            ("DELETE", "", None), ("PATCH", "", {"name": "x"}), ("GET", "/events", None), ("GET", "/progress", None),
            ("GET", "/inputs", None), ("GET", "/inputs/scene", None), ("GET", "/artifacts", None),
            ("GET", "/artifacts/stylized.ply", None), ("GET", "/artifacts/stylized.ply?format=spz", None),
            ("GET", "/artifacts/live/colors.f16", None), ("POST", "/blends", {"weight": 0.5}), ("POST", "/video", {}),
            ("GET", "/shares", None), ("POST", "/shares", {}), ("DELETE", f"/shares/{SHARE_ID}", None),
        ):  # fmt: skip
            problem = refused(you.request(method, f"/v1/jobs/{job_id}{path}", json=body), 404, "not-found")
            assert problem["detail"].replace(job_id, "") == nothing["detail"].replace("job_" + "0" * 31, "")
        reference = {"scene": f"/v1/jobs/{job_id}/inputs/scene", "style": f"/v1/jobs/{job_id}/inputs/style"}
        refused(you.post("/v1/jobs", json=reference), 422, "unknown-input")
        for method in ("GET", "DELETE"):
            refused(you.request(method, where, headers=TUS), 404, "not-found")
        assert you.head(where, headers=TUS).status_code == 404
        refused(send(you, where, 0, b"12345"), 404, "not-found")
        assert you.get("/v1/jobs", params={"cursor": job_id}).json()["jobs"] == []
        assert me.get(f"/v1/jobs/{job_id}").json()["status"] == "queued"
        assert me.get(where).json()["offset"] == 0


@pytest.mark.parametrize(
    "header",
    [
        b"Bearer",
        b"Bearer x y",
        b"Basic eDp5",
        b"bearer \xff\xfe",
        b"Bearer " + b"x" * 50_000,
        b"",
        b"Bearer ' OR 1=1 --",
    ],
)
def test_malformed_keys_are_rejected(client: httpx2.Client, header: bytes) -> None:
    answer = client.get("/v1/jobs", headers=[(b"authorization", header)])
    refused(answer, 401, "unauthorized")
    assert answer.headers["www-authenticate"] == "Bearer"


RANGES: list[tuple[str, int]] = [
    ("bytes=0-0", 206),
    ("bytes=-1", 206),
    ("bytes=-999999999999", 206),
    ("bytes=0-999999999999999", 206),
    ("bytes=-0", 416),
    ("bytes=99999999-", 416),
    ("bytes=99999999-999999999", 416),
    ("bytes=999999999999999999-", 416),
    ("bytes=0-0,1-1", 200),
    ("bytes=" + ",".join(f"{i}-" for i in range(1000)), 200),
    ("bytes=5-2", 200),
    ("bytes=-", 200),
    ("bytes=", 200),
    ("bytes=a-b", 200),
    ("bytes=0x0-0x5", 200),
    ("bytes=--5", 200),
    ("bytes=1-2-3", 200),
    ("bytes=" + "9" * 5000 + "-", 200),
    ("pages=1-2", 200),
    ("bytes 0-5", 200),
    ("", 200),
    ("bytes=\xb2-\xb3", 200),
]


@pytest.mark.parametrize(("text", "status"), RANGES, ids=[text[:25] or "empty" for text, _ in RANGES])
def test_ranges_follow_rfc_9110(client: httpx2.Client, files: Files, done: str, text: str, status: int) -> None:
    where = f"/v1/jobs/{done}/artifacts/stylized.ply"
    answer = client.get(where, headers=[(b"range", text.encode("latin-1"))])
    if status == 416:
        refused(answer, 416, "range-not-satisfiable")
        assert answer.headers["content-range"] == f"bytes */{len(files['scene'])}"
        return
    assert answer.status_code == status
    assert answer.content in files["scene"]
    assert len(answer.content) == int(answer.headers["content-length"])
    assert (answer.content == files["scene"]) or status == 206
    refused(
        client.get(f"/v1/jobs/{done}/artifacts/log.txt", headers={"Range": "bytes=0-0"}), 416, "range-not-satisfiable"
    )


def test_results_have_safe_headers(client: httpx2.Client, done: str) -> None:
    answer = client.get(f"/v1/jobs/{done}/artifacts/report.html")
    assert re.fullmatch(
        r"""inline; filename="[A-Za-z0-9._-]+"; filename\*=UTF-8''[A-Za-z0-9._%-]+""",
        answer.headers["content-disposition"],
    )
    assert "set-cookie" not in answer.headers
    assert answer.headers["x-content-type-options"] == "nosniff"
    policy = answer.headers["content-security-policy"]
    assert "sandbox" in policy
    assert "allow-same-origin" not in policy


PATHS = [
    "../../../sgsst.db",
    "..%2f..%2f..%2fsgsst.db",
    "%2e%2e/%2e%2e/sgsst.db",
    "..%5c..%5csgsst.db",
    "/etc/passwd",
    "%2fetc%2fpasswd",
    ".checkpoint",
    "%2echeckpoint",
    "./.checkpoint",
    "x/../.checkpoint",
    "previews/../stylized.ply",
    "stylized.ply/",
    "stylized.ply%00",
    "%00",
    "stylized.ply%0d%0aSet-Cookie:%20a=b",
    "%ff%fe",
    "%ed%a0%80",
    "x" * 5000,
    "%",
    "%%",
    "",
    "STYLIZED.PLY",
    "stylized.ply;x",
]


def test_result_paths_cannot_escape_job(service: Service, done: str) -> None:
    for path in PATHS:
        head, _ = exchange(
            service, f"GET /v1/jobs/{done}/artifacts/{path} HTTP/1.1\nHost: 127.0.0.1\nConnection: close"
        )
        assert head.split()[1] in (b"404", b"307", b"400"), (path, head)
        assert b"set-cookie" not in head.lower()
