"""Tests of `Client` and `AsyncClient` against the API in a real process, with the same scenarios for both."""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import inspect
import json
import math
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import pytest
import stamina
import torch

from api.client import AsyncClient, Client
from api.client.client import camera_files, image_files
from api.client.transport import TRIES, ApiError, Event, Job, RequestError
from sgsst_core.files.atomic import temporary_path
from tests.api.service import Service
from tests.http_servers import LocalServer, send
from tests.nginx import Nginx
from tests.sgsst_core.files.formats.samples import archived, streamed, unpacked
from tests.small_scenes import wall


@pytest.fixture(autouse=True)
def no_waits(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Remove the waits between retries; the number of retries stays the same."""
    monkeypatch.setattr("api.client.client.FIRST_WAIT", 0.0)
    with stamina.set_testing(True, attempts=TRIES):
        yield


class Awaited:
    """Adapter that lets tests call an `AsyncClient` like a `Client`, in a separate event loop."""

    def __init__(self, url: str) -> None:
        self._runner = asyncio.Runner()
        self._client = self._runner.run(self._open(url))

    @staticmethod
    async def _open(url: str) -> AsyncClient:
        return await AsyncClient(url).__aenter__()

    def __enter__(self) -> Awaited:
        return self

    def __exit__(self, *ignored: object) -> None:
        self._runner.run(self._client.close())
        self._runner.close()

    def __getattr__(self, name: str) -> Callable[..., Any]:
        member = getattr(self._client, name)
        if inspect.isasyncgenfunction(getattr(AsyncClient, name)):

            async def gather(*args: Any, **options: Any) -> list[Any]:
                return [item async for item in member(*args, **options)]

            return lambda *args, **options: iter(self._runner.run(gather(*args, **options)))
        return lambda *args, **options: self._runner.run(member(*args, **options))


both = pytest.mark.parametrize("connect", [Client, Awaited], ids=["Client", "AsyncClient"])


# --- one interface ----------------------------------------------------------------------------------------------------


def public(kind: type) -> dict[str, Any]:
    names = {name for name in dir(kind) if not name.startswith("_")}
    return {name: getattr(kind, name) for name in names if callable(getattr(kind, name))}


def test_clients_have_same_methods() -> None:
    blocking, awaiting = public(Client), public(AsyncClient)
    assert blocking.keys() == awaiting.keys()
    for name, method in blocking.items():
        assert method.__doc__, name
        assert method.__doc__ == awaiting[name].__doc__
        assert inspect.signature(method) == inspect.signature(awaiting[name])
        assert inspect.isgeneratorfunction(method) == inspect.isasyncgenfunction(awaiting[name])


def test_iteration_may_stop_early(service: Service, paths: dict[str, Path]) -> None:
    with Client(service.url) as client:
        created = [client.submit(paths["scene"], paths["style"], orbit=2).id for _ in range(2)]
        for job in client.jobs():
            assert job.id == created[-1]
            break
        assert next(iter(client.watch(created[0]))).kind == "status"
        assert client.job(created[0]).id == created[0]


def test_interrupted_call_is_canceled(service: Service, paths: dict[str, Path]) -> None:
    """Ctrl-C ends a wait for a job that does not end, and the client can be used further."""
    with Client(service.url) as client:
        job_id = client.submit(paths["scene"], paths["style"], orbit=2).id
        main = threading.main_thread().ident or 0

        def wait() -> None:
            threading.Timer(1.0, signal.pthread_kill, (main, signal.SIGINT)).start()
            client.wait(job_id)

        with pytest.raises(KeyboardInterrupt):  # also if the signal arrives before the request
            wait()
        assert client.cancel(job_id).finished


# --- the same scenario through both --------------------------------------------------------------------------------


@both
def test_unpacked_streamed_sog_is_sent_as_an_archive(
    connect: Any, service: Service, paths: dict[str, Path], tmp_path: Path
) -> None:
    folder = unpacked(tmp_path / "robot", streamed([[wall()], [wall().subset(torch.arange(10))]]))
    with connect(service.url) as client:
        for scene in (folder, folder / "lod-meta.json"):
            data = client.job(client.submit(scene, paths["style"], orbit=2).id).data
            assert data["name"] == "robot · style"
            assert "robot.zip" in json.dumps(data["inputs"])
        with pytest.raises(RequestError, match=r"without 0_0/meta\.json"):
            client.submit(
                archived(tmp_path / "a.zip", {"lod-meta.json": (folder / "lod-meta.json").read_bytes()}),
                paths["style"],
                orbit=2,
            )


@both
def test_job_from_upload_to_removal(
    connect: Any,
    service: Service,
    paths: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("api.client.client.PART_BYTES", 10_000)
    reported: list[tuple[int, int]] = []
    with connect(service.url) as client:
        submitted: Job = client.submit(
            paths["scene"],
            paths["style"],
            cameras=paths["cameras"],
            name="mine",
            steps_sos=7,
            background=None,
            progress=lambda done, total: reported.append((done, total)),
        )
        large = [path.stat().st_size for path in paths.values() if path.stat().st_size > 10_000]
        assert reported[-1] == (sum(large), sum(large))
        assert [done for done, _ in reported] == sorted({done for done, _ in reported})
        assert len(reported) == sum(-(-size // 10_000) for size in large)
        shown: Job = client.job(submitted.id)
        assert (shown.status, shown.data["name"]) == ("queued", "mine")
        assert shown.data["parameters"] == {**shown.data["parameters"], "steps_sos": 7}
        digests = {entry["role"]: entry["sha256"] for entry in shown.data["inputs"]}
        assert digests == {role: hashlib.sha256(path.read_bytes()).hexdigest() for role, path in paths.items()}

        assert client.cancel(submitted.id).status == "canceled"
        assert client.retry(submitted.id).status == "queued"
        result = bytes(range(256)) * 9000
        service.finish(submitted.id, {"stylized.ply": result})
        events: list[Event] = list(client.watch(submitted.id))
        statuses = [event.data["status"] for event in events if event.kind == "status"]
        assert statuses == ["queued", "canceled", "queued", "starting", "running", "succeeded"]
        assert list(client.watch(submitted.id, after=events[3].id)) == events[4:]
        assert list(client.watch(submitted.id, after=events[-1].id)) == []
        assert client.wait(submitted.id).finished

        assert [entry["name"] for entry in client.artifacts(submitted.id)] == ["stylized.ply"]
        reported.clear()
        target = tmp_path / "mine.ply"
        assert (
            client.download(submitted.id, target, progress=lambda done, total: reported.append((done, total))) == target
        )
        assert target.read_bytes() == result
        assert reported[-1] == (len(result), len(result))
        assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.ply"]

        client.delete(submitted.id)
        with pytest.raises(RequestError, match="no job") as caught:
            client.job(submitted.id)
        assert (caught.value.status, caught.value.problem["code"]) == (404, "not-found")


@both
def test_numbers_that_are_not_finite_are_not_sent(connect: Any, paths: dict[str, Path]) -> None:
    """The port of a closed socket refuses connections, which is another error."""
    with connect("http://127.0.0.1:9") as client:
        for call in (
            lambda: client.blend("job_1", math.nan),
            lambda: client.blend("job_1", 0.5, {"job_2": -math.inf}),
            lambda: client.video("job_1", seconds=math.inf),
            lambda: client.submit(paths["scene"], paths["style"], orbit=2, content_weight=math.nan),
        ):
            with pytest.raises(RequestError, match=r"contains a number that is not finite\. Give finite numbers\."):
                call()


@both
def test_jobs_are_listed_page_by_page(
    connect: Any, service: Service, paths: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("api.client.client._PAGE", 2)
    with connect(service.url) as client:
        ids = [client.submit(paths["scene"], paths["style"], orbit=2, seed=number).id for number in range(5)]
        assert [job.id for job in client.jobs()][:5] == ids[::-1]
        assert [job.id for job in client.jobs(limit=3)] == ids[:1:-1]
        client.cancel(ids[0])
        assert ids[0] not in [job.id for job in client.jobs(status=["queued", "running"])]
        assert next(iter(client.jobs(status=["canceled"]))).id == ids[0]


@both
def test_bad_files_are_rejected(connect: Any, service: Service, paths: dict[str, Path], tmp_path: Path) -> None:
    with connect(service.url) as client:
        with pytest.raises(RequestError, match="is not a scene file") as caught:
            client.plan(paths["style"], paths["style"], orbit=2)
        assert (caught.value.status, caught.value.problem["input"]) == (422, "scene")
        with pytest.raises(RequestError, match="not a file"):
            client.submit(tmp_path / "none.ply", paths["style"], orbit=2)
        with pytest.raises(RequestError, match="contains no images"):
            client.submit(paths["scene"], paths["style"], cameras=paths["cameras"], photos=tmp_path)


@pytest.mark.parametrize(
    ("present", "given", "sent"),
    [
        (["sparse/1/cameras.bin", "sparse/1/images.bin"], "", ["sparse/1/cameras.bin", "sparse/1/images.bin"]),
        (["sparse/10/cameras.txt", "sparse/2/cameras.txt"], "", ["sparse/2/cameras.txt"]),
        (["transforms_train.json", "transforms_test.json"], "", ["transforms_train.json"]),
        (["cameras.json", "colmap/sparse/0/cameras.bin"], "", ["cameras.json"]),
        (["colmap/sparse/0/cameras.bin"], "", ["colmap/sparse/0/cameras.bin"]),
        (["cameras.bin", "images.bin"], "images.bin", ["cameras.bin", "images.bin"]),
        (["views.JSON", "sparse/0/cameras.bin"], "views.JSON", ["views.JSON"]),
        (["a.json", "dataparser_transforms.json"], "a.json", ["a.json", "dataparser_transforms.json"]),
        (["transform_train.json", "notes.txt"], "", ["transform_train.json"]),
    ],
)
def test_cameras_are_found_as_on_the_command_line(
    tmp_path: Path, present: list[str], given: str, sent: list[str]
) -> None:
    for name in present:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert camera_files(tmp_path / given) == [tmp_path / name for name in sent]


def test_photos_of_all_formats_are_sent_except_hidden_files(tmp_path: Path) -> None:
    for name in ("a.HEIC", "b.avif", "c.jpg", "._c.jpg", "notes.txt"):
        (tmp_path / name).touch()
    assert [name for _, name in image_files(tmp_path)] == ["a.HEIC", "b.avif", "c.jpg"]
    (tmp_path / os.fsdecode("\uac00.png".encode("cp949"))).touch()  # sent as the cameras that name it are read
    assert image_files(tmp_path)[-1][1] == "\xb0\xa1.png"


@pytest.mark.parametrize(
    "connect", [Client, pytest.param(Awaited, marks=pytest.mark.slow)], ids=["Client", "AsyncClient"]
)
def test_plan_reports_progress(connect: Any, service: Service, paths: dict[str, Path]) -> None:
    options = {"preset": "preview", "backbone": "vgg16", "resolution": 64, "cameras": paths["cameras"]}
    reported: list[tuple[int, int]] = []
    with connect(service.url) as client:
        plan = client.plan(
            paths["scene"],
            paths["style"],
            planning=lambda done, total: reported.append((done, total)),
            learning_rate=0.1 if connect is Client else 0.3,  # a plan that is cached sends no progress
            **options,
        )
        assert (plan["gaussians"], plan["views"]) == (616, 3)
        assert (3, 3) in reported
        frozen = {"name": "middle", "select": "sphere=0,0,3,2.5", "freeze": True}
        with pytest.raises(RequestError, match="that a view sees is frozen") as caught:
            client.plan(paths["scene"], paths["style"], regions=[frozen], **options)
        assert (caught.value.status, caught.value.problem["code"]) == (422, "invalid-settings")


# --- connections that break ----------------------------------------------------------------------------------------


class Relay:
    """Proxy that forwards connections to a server, and cuts each one off after a number of bytes of its response.

    Args:
        port: Port of the server on this machine.
        limits: Number of bytes after which each connection is cut off, in order; later connections are not cut off.
    """

    def __init__(self, port: int, limits: list[int]) -> None:
        self._port, self._limits = port, list(limits)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self.cuts = 0
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self) -> Relay:
        return self

    def __exit__(self, *ignored: object) -> None:
        self._listener.close()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            limit = self._limits.pop(0) if self._limits else None
            threading.Thread(target=self._serve, args=(near, limit), daemon=True).start()

    def _serve(self, near: socket.socket, limit: int | None) -> None:
        with near, socket.create_connection(("127.0.0.1", self._port)) as far:
            threading.Thread(target=self._pass_on, args=(near, far, None), daemon=True).start()
            self._pass_on(far, near, limit)

    def _pass_on(self, source: socket.socket, target: socket.socket, left: int | None) -> None:
        try:
            while data := source.recv(1 << 16):
                target.sendall(data if left is None else data[:left])
                left = None if left is None else left - len(data)
                if left is not None and left <= 0:
                    self.cuts += 1
                    break
            target.shutdown(socket.SHUT_RDWR)
        except OSError:
            return


@both
def test_download_resumes_after_lost_connection(
    connect: Any, service: Service, paths: dict[str, Path], tmp_path: Path
) -> None:
    with connect(service.url) as client:
        job_id = client.submit(paths["scene"], paths["style"], orbit=2).id
    content = hashlib.sha256(job_id.encode()).digest() * 100_000
    service.finish(job_id, {"stylized.ply": content})
    reported: list[tuple[int, int]] = []
    # A block is written once it is complete: the first connection leaves one, the second none, the third another one.
    with (
        Relay(int(service.environment["SGSST_PORT"]), [1_500_000, 700, 1_500_000]) as relay,
        connect(relay.url) as client,
    ):
        target = client.download(
            job_id, tmp_path / "mine.ply", progress=lambda done, size: reported.append((done, size))
        )
        assert target.read_bytes() == content
        assert relay.cuts == 3
    assert {size for _, size in reported} == {len(content)}
    assert [done for done, _ in reported] == sorted({done for done, _ in reported}), "nothing was sent twice"


@both
def test_download_through_compressing_proxies(
    connect: Any, service: Service, paths: dict[str, Path], tmp_path: Path
) -> None:
    """nginx makes ETags weak when it compresses; another proxy compresses although it is asked not to."""
    with connect(service.url) as client:
        job_id = client.submit(paths["scene"], paths["style"], orbit=2).id
    content = b"content" * 10_000
    service.finish(job_id, {"stylized.ply": content})

    def compress(handler: BaseHTTPRequestHandler) -> None:
        body = gzip.compress(content)
        tag = f'W/"{hashlib.sha256(content).hexdigest()}-gzip"'
        send(handler, body, ETag=tag, Content_Encoding="gzip", Content_Length=str(len(body)))

    upstream = int(service.environment["SGSST_PORT"])
    with (
        Nginx(tmp_path / "nginx", upstream, directives=["gzip_types *;"]) as nginx,
        LocalServer(compress) as other,
    ):
        for url in (nginx.url, other.origin):
            with connect(url) as client:
                assert client.download(job_id, tmp_path / "out.ply").read_bytes() == content


@both
def test_partial_file_is_resumed_or_discarded_and_no_other_touched(
    connect: Any, service: Service, paths: dict[str, Path], tmp_path: Path
) -> None:
    with connect(service.url) as client:
        job_id = client.submit(paths["scene"], paths["style"], orbit=2).id
        content = job_id.encode() * 1000
        service.finish(job_id, {"stylized.ply": content})
        tag = hashlib.sha256(content).hexdigest()
        for number, (left, stamp) in enumerate(
            [
                (b"mine", None),
                (b"of an older result", "0" * 64),
                (b"damaged on this disk", tag),
                (content[:1000], tag),
                (content, tag),
            ]
        ):
            target = tmp_path / f"{number}.ply"
            foreign = target.with_name(f"{number}.ply.part")
            part = foreign if stamp is None else temporary_path(target, stamp)
            part.write_bytes(left)
            assert client.download(job_id, target).read_bytes() == content
        assert [path.read_bytes() for path in tmp_path.glob("*.part*")] == [b"mine"]


@both
def test_events_resume_after_lost_connection(connect: Any, service: Service, paths: dict[str, Path]) -> None:
    with connect(service.url) as client:
        job_id = client.submit(paths["scene"], paths["style"], orbit=2).id
        for _ in range(5):
            client.cancel(job_id)
            client.retry(job_id)
        service.finish(job_id, {"stylized.ply": b"ply"})
        whole = list(client.watch(job_id))
    with Relay(int(service.environment["SGSST_PORT"]), [600, 650, 700]) as relay, connect(relay.url) as client:
        assert list(client.watch(job_id)) == whole
        assert relay.cuts == 3


@both
def test_events_resume_after_errors_of_a_proxy(connect: Any) -> None:
    """A reverse proxy answers in place of a service that is being restarted."""
    errors = [502, 503]

    def answer(handler: BaseHTTPRequestHandler) -> None:
        if not handler.path.endswith("/events"):
            job = json.dumps({"id": "job_1", "status": "succeeded"})
            send(handler, job.encode(), Content_Type="application/json")
        elif errors:
            send(handler, b"<html>", errors.pop(), Content_Type="text/html")
        else:
            event = b'id: 7\nevent: status\ndata: {"status": "succeeded"}\n\n'
            send(handler, event, Content_Type="text/event-stream")

    with LocalServer(answer) as server, connect(server.origin) as client:
        assert [event.id for event in client.watch("job_1")] == [7]
    assert errors == []


@both
def test_work_whose_stream_ends_without_a_result_is_requested_again(connect: Any) -> None:
    streams = [
        b'event: video\ndata: {"name": "video.mp4"}\n\n',
        b'event: rendering\ndata: {"step": 1, "total": 2}\n\n',
    ]

    def answer(handler: BaseHTTPRequestHandler) -> None:
        handler.rfile.read(int(handler.headers["Content-Length"]))
        send(handler, streams.pop(), Content_Type="text/event-stream")

    with LocalServer(answer) as server, connect(server.origin) as client:
        assert client.video("job_1") == "video.mp4"
    assert streams == []


@both
def test_upload_resumes_after_lost_connection(
    connect: Any, service: Service, paths: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The response to a part is lost. The client sends the part again; the service refuses it as already received."""
    monkeypatch.setattr("api.client.client.PART_BYTES", 20_000)
    # Connections stay open: the first one of each relay passes the answer to the creation, not that to the first part.
    with Relay(int(service.environment["SGSST_PORT"]), [900]) as relay, connect(relay.url) as client:
        uploaded = client.upload(paths["scene"])
        assert relay.cuts == 1
    with service.client() as plain:
        shown = plain.get(f"/v1/uploads/{uploaded}").json()
    assert shown["sha256"] == hashlib.sha256(paths["scene"].read_bytes()).hexdigest()


@both
def test_silent_service_is_retried_a_limited_number_of_times(connect: Any, service: Service, tmp_path: Path) -> None:
    with Relay(int(service.environment["SGSST_PORT"]), [1] * 100) as relay, connect(relay.url) as client:
        for count, ask in enumerate(
            (
                lambda: client.job("job_1"),
                lambda: client.download("job_1", tmp_path / "x"),
                lambda: list(client.watch("job_1")),
            ),
            start=1,
        ):
            with pytest.raises(ApiError, match="cannot be reached"):
                ask()
            assert relay.cuts == count * TRIES
