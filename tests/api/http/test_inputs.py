"""Tests of downloaded files: a job's inputs, images and loss history, also with hostile names."""

import hashlib
import re
from email.message import Message
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import unquote

import httpx2
import pytest
from sqlalchemy import event

from api.http.sending import disposition
from api.http.submission import _referred_input
from service.files.objects import Artifacts
from service.settings import ServiceSettings
from service.store import Store, open_store
from service.store.jobs import NewJob
from sgsst_core.progress import Progress
from tests.api.http.sending import refused
from tests.api.service import Service
from tests.service.store.helpers import SHA
from tests.stores import new_store

#: Names of uploaded files.
HOSTILE = [
    "../../etc/passwd",
    'a"; filename="evil.html',
    "a\r\nSet-Cookie: x=y",
    "\u202egpj.exe",
    "caf\u00e9 \u65e5\u672c.png",
    "<script>alert(1)</script>.png",
    "a;b=c,d.png",
    "%0d%0aX: y.png",
    "..",
    "." * 300,
    "x" * 1000 + ".png",
    "C:\\Windows\\win.ini",
    "\x00\x1f\x7f.png",
    "con*:?|.png",
    "\U0001f3a8.png",
    "",
    " ",
    "'quoted' \\",
    "\ud800.png",
]


def submit(client: httpx2.Client, paths: dict[str, Path], styles: list[str]) -> str:
    parts = [(role, (paths[role].name, paths[role].read_bytes())) for role in ("scene", "cameras")]
    # Bytes after the end of the image make it a different file.
    parts += [("style", (name, paths["style"].read_bytes() + bytes(place))) for place, name in enumerate(styles)]
    answer = client.post("/v1/jobs", files=parts)
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


@pytest.fixture(scope="module")
def job_id(client: httpx2.Client, paths: dict[str, Path]) -> str:
    return submit(client, paths, ["first.png", "second.PNG"])


def test_inputs_are_returned_unchanged(client: httpx2.Client, paths: dict[str, Path], job_id: str) -> None:
    listed = client.get(f"/v1/jobs/{job_id}/inputs").json()["inputs"]
    style = paths["style"].read_bytes()
    sent = [
        ("scene", "scene", paths["scene"].read_bytes(), "application/octet-stream"),
        ("cameras", "cameras", paths["cameras"].read_bytes(), "application/json"),
        ("style", "style", style, "image/png"),
        ("style", "style:1", style + b"\0", "image/png"),
    ]
    for entry, (role, address, content, kind) in zip(listed, sent, strict=True):
        assert (entry["role"], entry["size"]) == (role, len(content))
        assert entry["url"] == f"/v1/jobs/{job_id}/inputs/{address}"
        answer = client.get(entry["url"])
        assert answer.content == content
        assert entry["sha256"] == hashlib.sha256(content).hexdigest()
        wanted = {"etag": f'"{entry["sha256"]}"', "content-type": kind, "x-content-type-options": "nosniff"}
        wanted["content-security-policy"] = "sandbox; default-src 'none'"
        assert wanted.items() <= dict(answer.headers).items()
        assert answer.headers["content-disposition"].startswith("attachment; filename=")
        assert "private" in answer.headers["cache-control"]
    assert client.get(f"/v1/jobs/{job_id}/inputs/style:0").content == style


def test_inputs_are_sent_in_ranges(client: httpx2.Client, paths: dict[str, Path], job_id: str) -> None:
    url, whole = f"/v1/jobs/{job_id}/inputs/scene", paths["scene"].read_bytes()
    size = len(whole)
    for asked, start, stop in (("0-99", 0, 100), ("100-", 100, size), ("-7", size - 7, size), ("5-999999999", 5, size)):
        answer = client.get(url, headers={"Range": f"bytes={asked}"})
        assert (answer.status_code, answer.content) == (206, whole[start:stop])
        assert answer.headers["content-range"] == f"bytes {start}-{stop - 1}/{size}"
    tag = client.head(url).headers["etag"]
    assert client.head(url).headers["content-length"] == str(size)
    assert client.get(url, headers={"If-None-Match": tag}).status_code == 304
    assert client.get(url, headers={"Range": "bytes=0-4", "If-Range": '"other"'}).content == whole
    assert client.get(url, headers={"Range": "bytes=0-4", "If-Range": tag}).content == whole[:5]
    assert client.get(url, headers={"Range": "bytes=0-4", "If-Range": f"W/{tag}"}).content == whole
    refused(client.get(url, headers={"Range": f"bytes={size}-"}), 416, "range-not-satisfiable")
    assert client.get(url, headers={"If-None-Match": f'"a", W/{tag}'}).status_code == 304
    for matching in (tag, f'"a", {tag}', "*"):
        assert client.get(url, headers={"If-Match": matching}).content == whole
    for other in (f"W/{tag}", '"a"', "", tag[:-2] + '"'):
        refused(client.get(url, headers={"If-Match": other, "If-None-Match": tag}), 412, "precondition-failed")
        assert client.head(url, headers={"If-Match": other}).status_code == 412


@pytest.mark.parametrize(
    "role",
    [
        "photos",
        "style:2",
        "style:-1",
        "style:x",
        "style:",
        "scene.ply",
        "style:1e0",
        "%2e%2e",
        "\u0663",
        "style:\u0661",
    ],
)
def test_missing_inputs_are_not_found(client: httpx2.Client, job_id: str, role: str) -> None:
    refused(client.get(f"/v1/jobs/{job_id}/inputs/{role}"), 404, "not-found")


def test_inputs_of_deleted_job_are_not_found(client: httpx2.Client, paths: dict[str, Path], store: Store) -> None:
    job_id = submit(client, paths, ["style.png"])
    client.post(f"/v1/jobs/{job_id}/cancel")
    assert client.get(f"/v1/jobs/{job_id}/inputs/scene").status_code == 200
    later = open_store(ServiceSettings(data=Path(store.database.url.database or "").parent), lambda: 1e11)
    later.jobs.expire()
    later.close()
    assert client.get(f"/v1/jobs/{job_id}").json()["status"] == "expired"
    assert len(client.get(f"/v1/jobs/{job_id}/inputs").json()["inputs"]) == 3, "what they were is still known"
    refused(client.get(f"/v1/jobs/{job_id}/inputs/scene"), 404, "not-found")
    client.delete(f"/v1/jobs/{job_id}")
    refused(client.get(f"/v1/jobs/{job_id}/inputs"), 404, "not-found")


@pytest.mark.parametrize("name", HOSTILE, ids=ascii)
def test_suggested_file_names_are_safe(name: str) -> None:
    for inline in (True, False):
        header = disposition(name, inline=inline)
        assert header.isascii()
        assert header.isprintable()
        match = re.fullmatch(
            r"(inline|attachment); filename=\"([A-Za-z0-9._-]+)\"(?:; filename\*=UTF-8''([A-Za-z0-9._~%-]+))?", header
        )
        assert match, header
        assert (match[1] == "inline") is inline
        for suggested in (match[2], unquote(match[3] or "x")):
            assert suggested not in (".", "..")
            assert not set(suggested) & set('/\\\r\n\0"\u202e')
            assert len(suggested) <= 120
        # As another program parses it.
        message = Message()
        message["Content-Disposition"] = header
        assert message.get_content_disposition() == match[1]


def test_safe_file_names_are_unchanged() -> None:
    assert disposition("a/b/scene 1.ply", inline=False) == 'attachment; filename="scene_1.ply"'
    assert disposition("caf\u00e9.png", inline=True) == "inline; filename=\"caf_.png\"; filename*=UTF-8''caf%C3%A9.png"


def test_hostile_file_names_are_sanitized(client: httpx2.Client, paths: dict[str, Path]) -> None:
    names = [name for name in HOSTILE if name.strip() and "\ud800" not in name][:14]
    job_id = submit(client, paths, names)
    for entry in client.get(f"/v1/jobs/{job_id}/inputs").json()["inputs"]:
        answer = client.get(entry["url"])
        assert answer.status_code == 200
        assert "set-cookie" not in answer.headers
        assert "x" not in answer.headers
        assert re.match(r'attachment; filename="[A-Za-z0-9._-]+"(;|$)', answer.headers["content-disposition"])
        assert answer.headers["content-type"].partition(";")[0] in (
            "image/png",
            "application/octet-stream",
            "application/json",
        )


def test_previews_and_loss_history(client: httpx2.Client, paths: dict[str, Path], store: Store, tmp_path: Path) -> None:
    job_id = submit(client, paths, ["style.png"])
    assert client.get(f"/v1/jobs/{job_id}/progress").json() == {"points": []}
    image_path = tmp_path / "p.jpg"
    image_path.write_bytes(b"\xff\xd8\xff")
    while (held := store.leases.take("test")) is not None and held.job_id != job_id:
        store.leases.succeed(held, [], {})
    assert held is not None
    artifacts = Artifacts(ServiceSettings(data=Path(store.database.url.database or "").parent).artifacts_url)
    names = ["previews/step_0000000.jpg", "previews/step_0000020.jpg"]
    others = ["previewsx.jpg", "views.jpg"]  # which are no previews
    store.leases.publish(held, [artifacts.put(job_id, held.epoch, name, image_path) for name in names + others])
    for step in range(1, 31):
        losses: dict[str, Any] = {"loss": 100.0 / step, "scales": [None, 100.0 / step]}
        now = Progress(stage="sos", step=step, total=600, seconds=float(step), **losses)
        store.leases.report_progress(held, now)

    (listed,) = [job for job in client.get("/v1/jobs").json()["jobs"] if job["id"] == job_id]
    shown = client.get(f"/v1/jobs/{job_id}").json()
    assert listed["preview"] == shown["preview"] == names[1]
    assert client.get(f"/v1/jobs/{job_id}/artifacts/{listed['preview']}").content == image_path.read_bytes()
    assert shown["progress"]["scales"] == [None, 100.0 / 30]
    assert client.patch(f"/v1/jobs/{job_id}", json={"name": "caf\u00e9 \u00b7 1"}).status_code == 200
    suggested = client.head(f"/v1/jobs/{job_id}/artifacts/{names[1]}").headers["content-disposition"]
    assert suggested.endswith("filename*=UTF-8''caf%C3%A9_1-step_0000020.jpg")
    points = client.get(f"/v1/jobs/{job_id}/progress").json()["points"]
    last = points[-1]
    assert last["updated_at"] == shown["progress"]["updated_at"]
    assert (last["attempt"], last["stage"], last["total"], last["seconds"]) == (1, "sos", 600, 30.0)
    assert (last["loss"], last["scales"]) == (100.0 / 30, [None, 100.0 / 30])


# --- references ----------------------------------------------------------------------------------------------------


def test_reference_reads_no_other_entry(tmp_path: Path) -> None:
    """A request may refer to hundreds of jobs, each with thousands of photos."""
    store = new_store(ServiceSettings(data=tmp_path))
    store.inputs.add_blob(SHA, "aa/blob", 3)
    entries = [{"role": "style", "name": f"{number}.png", "sha256": SHA, "size": 3} for number in range(3)]
    job, _ = store.jobs.create(NewJob("local", "", 0, {}, entries), limit=10)
    read: list[str] = []
    event.listen(store.database.engine, "before_cursor_execute", lambda *each: read.append(each[2]))
    context: Any = SimpleNamespace(store=store)
    assert _referred_input(context, job.id, "style:1", "style", lambda _: False) == entries[1]
    assert not [statement for statement in read if statement.startswith("SELECT jobs.inputs")]
    assert len([statement for statement in read if "json_each" in statement and "LIMIT 1" in statement]) == 1
    store.close()


def test_new_job_uses_inputs_of_an_earlier_one(
    service: Service, store: Store, client: httpx2.Client, paths: dict[str, Path]
) -> None:
    first = submit(client, paths, ["one.png", "two.png"])
    used, blobs = client.get(f"/v1/jobs/{first}").json()["inputs"], store.inputs.file_names()
    at = f"/v1/jobs/{first}/inputs"
    body = {"scene": f"{at}/scene", "cameras": [f"{at}/cameras:0"], "style": [f"{at}/style:1", f"{at}/style"]}
    answer = client.post("/v1/jobs", json=body | {"parameters": {"style_weights": [3, 1]}})
    assert answer.status_code == 202, answer.text
    again = answer.json()
    assert again["name"] == "scene \u00b7 two + one"
    assert sorted(map(str, again["inputs"])) == sorted(map(str, used))
    assert [each["name"] for each in again["inputs"] if each["role"] == "style"] == ["two.png", "one.png"]
    form = [("scene", (None, f"{at}/scene")), ("cameras", (None, f"{at}/cameras"))]
    style = ("style", (paths["style"].name, paths["style"].read_bytes()))
    mixed = client.post("/v1/jobs", files=[*form, style])
    assert mixed.status_code == 202, mixed.text
    assert store.inputs.file_names() >= blobs
    assert [each["sha256"] for each in mixed.json()["inputs"] if each["role"] == "scene"] == [used[0]["sha256"]]
    store.jobs.cancel(first, None)
    client.delete(f"/v1/jobs/{first}")
    assert client.get(f"/v1/jobs/{again['id']}/inputs/scene").content == paths["scene"].read_bytes()
    problem = refused(client.post("/v1/jobs", json=body), 422, "unknown-input")
    assert problem["input"] == "scene"
    assert "Upload the file again." in problem["detail"]


@pytest.mark.parametrize("name", ["scene:1", "style:2", "photos", "style:-1", "style:1/..", "stylized.ply", "scene:x"])
def test_reference_to_an_input_that_a_job_has_not_is_refused(
    client: httpx2.Client, paths: dict[str, Path], name: str
) -> None:
    at = f"/v1/jobs/{submit(client, paths, ['one.png', 'two.png'])}/inputs"
    answer = client.post("/v1/jobs", json={"scene": f"{at}/{name}", "style": f"{at}/style", "cameras": [at]})
    assert answer.status_code == 422
    assert answer.json()["code"] in ("unknown-input", "unknown-upload")
    assert answer.json()["input"] == "scene"
