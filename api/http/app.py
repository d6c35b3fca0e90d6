"""The API as an ASGI app, and the middleware around it: access log, proxies, methods that stand for others, deadlines.

The process that serves it never imports Ray or PyTorch.
"""

import asyncio
import logging
import secrets
import time
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from typing import Any

import anyio.to_thread
from fastapi import FastAPI
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from api import installed_version
from api.http import access, jobs, monitoring, submission
from api.http.context import Context, Rates
from api.http.jobs import Hub
from api.http.monitoring import Metrics, Readiness
from api.http.problems import HANDLERS, METHODS, Problem, complete, from_service, logged_path, route_of, routed_methods
from api.http.receiving import Fetcher, Receipts
from api.http.schemas import ANSWERS, path_of, subpath
from api.http.sending import add_static
from api.http.submission import JobFromUploads
from service import problems
from service.deadlines import Deadline, FileThreads, OwnerLimit
from service.files.blobs import open_blobs
from service.files.objects import Artifacts
from service.inspection.derived import DerivedFiles
from service.inspection.inspector import Inspector
from service.problems import DamagedWeightsError
from service.settings import ServiceSettings, check_weights, is_subpath
from service.store import open_store

#: Number of threads for requests that read the database.
_THREADS = 40
#: Maximum number of these threads that read long lists of one owner at the same time.
_READERS_PER_OWNER = 2
#: Time limit of a piece of work on files, relative to the deadline of its request: the error then names what hangs.
_FILES_FRACTION = 0.9
#: Seconds that a request waits for a locked database, and for each response of the database server.
_ANSWER_SECONDS = 8.0

_DESCRIPTION = """
Style transfer for 3D Gaussian Splatting scenes. Send a scene, its cameras and a style image to `POST /v1/jobs`, watch
the job, and download `stylized.ply`. Errors are problem documents (RFC 9457) with a stable `code`.
"""


def create_app(settings: ServiceSettings) -> FastAPI:
    """Return the app, which uses the database and the folders of the settings."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        store = open_store(settings, patience=settings.start_seconds, answer_seconds=_ANSWER_SECONDS)
        results = Artifacts(settings.artifacts_url)
        blobs = open_blobs(settings, store.inputs, results)
        threads = FileThreads(_FILES_FRACTION * settings.answer_seconds)
        inspector = Inspector(settings, store, blobs, threads)
        context = Context(
            settings=settings,
            store=store,
            blobs=blobs,
            artifacts=results,
            inspector=inspector,
            derived=DerivedFiles(settings, store, blobs, results, threads, inspector.processes),
            hub=Hub(store),
            sign_ins=Rates(),
            rates=Rates(),
            receipts=Receipts(store.inputs, blobs, threads),
            threads=threads,
            readers=OwnerLimit(_READERS_PER_OWNER),
            fetcher=Fetcher(settings, blobs, threads),
            metrics=Metrics(store, settings.folder),
            readiness=Readiness(
                {
                    "database": store.operations.check,
                    "artifacts": results.objects.ping,
                    "disk": lambda: blobs.ensure_space(0),
                    "weights": check_weights,
                }
            ),
        )
        app.state.context = context
        anyio.to_thread.current_default_thread_limiter().total_tokens = _THREADS
        # Most of these threads wait; the default executor has few of them on machines with few processors.
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(_THREADS))
        with suppress(DamagedWeightsError):  # the error is logged, and /readyz reports it
            await asyncio.to_thread(check_weights)
        yield
        context.receipts.close()
        await context.hub.close()
        await context.inspector.processes.close()
        context.readiness.close()
        threads.close()
        store.close()

    app = FastAPI(
        title="sgsst",
        version=installed_version(),
        description=_DESCRIPTION,
        lifespan=lifespan,
        generate_unique_id_function=lambda route: route.name,
        docs_url=None,  # FastAPI's own page loads its script from a CDN
        redoc_url=None,
        exception_handlers=HANDLERS,
    )
    routers = [
        *(submission.router, jobs.router, jobs.inputs_router, jobs.artifacts_router, access.router),
        *(submission.uploads_router, access.session_router, monitoring.router),
    ]
    for router in routers:
        app.include_router(router)
    add_static(app)
    app.add_middleware(Deadlines, seconds=settings.answer_seconds)

    build, plain = app.build_middleware_stack, app.openapi

    def openapi() -> dict[str, Any]:
        if not app.openapi_schema:
            routes = [*app.routes, *(route for router in routers for route in router.routes)]
            complete(plain(), routes, (Problem, JobFromUploads, *ANSWERS))
        return app.openapi_schema or {}

    app.openapi = openapi  # type: ignore[method-assign]
    # around FastAPI's own middleware, which responds to unexpected errors
    app.build_middleware_stack = lambda: Observed(Adapted(build(), settings), app.state)  # type: ignore[method-assign]
    return app


#: Path of the uploads, whose protocol lets a header replace the method, for clients that can only send GET and POST.
_UPLOADS = "/v1/uploads"

_access = logging.getLogger("api.access")
_log = logging.getLogger(__name__)


class Observed:
    """Middleware that counts and logs requests by route instead of by path, and gives each an id.

    It is the outermost one, so that it sees every response, those to unexpected errors included. A response that breaks
    off is counted again with status 500.
    """

    def __init__(self, app: ASGIApp, state: Any) -> None:
        self._app, self._state = app, state

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request; record its status and the time until its response starts."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started, request_id = time.perf_counter(), secrets.token_hex(8)
        request: Scope = {**scope, "request_id": request_id}  # other middleware changes the copy, not the server's
        status = 0

        async def observed(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                self._note(scope["method"], request, status, time.perf_counter() - started)
                message = {**message, "headers": [*message["headers"], (b"x-request-id", request_id.encode())]}
            await send(message)

        try:
            await self._app(request, receive, observed)
        except asyncio.CancelledError:  # the server is stopping, and has waited for this request for long enough
            if not status:
                await from_service(problems.STOPPING())(request, receive, observed)
        except BaseException:
            if status < 500:
                self._note(scope["method"], request, 500, time.perf_counter() - started)
            raise

    def _note(self, method: str, request: Scope, status: int, seconds: float) -> None:
        known = method if method in METHODS else "(other)"
        self._state.context.metrics.observe(known, route_of(request), status, seconds)
        extra = {"method": method, "path": logged_path(request), "status": status, "seconds": round(seconds, 4)}
        _access.info("request", extra={**extra, "request_id": request["request_id"]})


class Adapted:
    """Middleware that takes the client's address, the scheme and the subpath of a request from a trusted proxy.

    The proxy may pass the subpath on or strip it. A subpath in the settings replaces the proxy's.

    It also chooses the method by which the routes answer. HEAD is answered wherever GET is: with the same headers, and
    without the body.
    """

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        self._subpath = settings.root_path
        self._app = ProxyHeadersMiddleware(app, settings.trusted_proxies)  # type: ignore[arg-type]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request."""
        if scope["type"] == "http":
            root = self._subpath or self._forwarded(scope)
            subpath.set(root)
            scope["root_path"] = root
            if not f"{scope['path']}/".startswith(f"{root}/"):
                scope["path"] = root + scope["path"]
            if f"{path_of(scope)}/".startswith(f"{_UPLOADS}/"):
                scope["method"] = Headers(scope=scope).get("x-http-method-override", "").strip() or scope["method"]
            if scope["method"] == "HEAD" and "GET" in (routed := routed_methods(scope)) and "HEAD" not in routed:
                scope["method"], send = "GET", _head_of(send)
        await self._app(scope, receive, send)  # type: ignore[arg-type]

    def _forwarded(self, scope: Scope) -> str:
        """Return the `X-Forwarded-Prefix` of a trusted proxy; an empty string for none."""
        client = scope.get("client")
        if not client or client[0] not in self._app.trusted_hosts:
            return ""
        prefix = Headers(scope=scope).get("x-forwarded-prefix", "").strip().rstrip("/")
        return prefix if is_subpath(prefix) else ""


class Deadlines:
    """Middleware that answers a request without progress with 503, and ends a response that stalls.

    Every block of a body that arrives, and every block of a response that the client has taken, is progress, so long
    transfers have no total limit. The deadline is suspended while the service waits for the client, whose time is
    limited by `api.http.server`.

    Args:
        seconds: Time without progress.
    """

    def __init__(self, app: ASGIApp, seconds: float) -> None:
        self._app, self._seconds = app, seconds

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request within its deadline."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        complete = started = over = False
        expired: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        deadline, cancel = Deadline(self._seconds, lambda: expired.set_result(None)), anyio.CancelScope()

        async def from_client() -> Message:
            nonlocal complete
            if complete:  # the app waits for the client to leave
                return await receive()
            with deadline.suspended():
                message = await receive()
            complete = not message.get("more_body", False)
            return message

        async def to_client(message: Message) -> None:
            nonlocal started
            if over:
                return
            started = True
            with deadline.suspended():
                await send(message)

        async def serve() -> None:
            with cancel:
                await self._app(scope, from_client, to_client)

        serving = asyncio.create_task(serve())
        try:
            await asyncio.wait((serving, expired), return_when=asyncio.FIRST_COMPLETED)
            if serving.done():
                await serving
                return
            over = True
            serving.add_done_callback(lambda task: task.cancelled() or task.exception())  # it ends without an audience
            _log.warning(
                "no progress for %g s, request given up: %s %s", self._seconds, scope["method"], logged_path(scope)
            )
            if not started:  # otherwise the server closes the connection
                await from_service(problems.DEADLINE_EXCEEDED(seconds=self._seconds))(scope, receive, send)
        finally:
            deadline.close()
            cancel.cancel()


def _head_of(send: Send) -> Send:
    """Return a function that sends the head of a response, and ends the response there."""

    async def send_head(message: Message) -> None:
        if message["type"] == "http.response.start":
            await send(message)
            await send({"type": "http.response.body"})

    return send_head
