"""The API as an ASGI app. The process that serves it never imports Ray or PyTorch."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import anyio.to_thread
from fastapi import FastAPI
from starlette.types import ASGIApp

from api.http.context import Context
from api.http.documentation import complete
from api.http.event_hub import Hub
from api.http.fetching import Fetcher
from api.http.limits import Rates, SignIns
from api.http.middleware import Deadlines, Methods, Observed, Proxied
from api.http.monitoring import Metrics, Readiness
from api.http.problems import Problem, add_handlers
from api.http.receipts import Receipts
from api.http.routes import artifacts, events, inputs, jobs, operations, session, shares, submission, uploads
from api.http.routes.submission import JobFromUploads
from api.http.schemas import ANSWERS
from api.http.static import add_static
from service.deadlines import FileThreads, OwnerLimit
from service.files.blobs import open_blobs
from service.files.objects import Artifacts
from service.inspection.derived import DerivedFiles
from service.inspection.inspector import Inspector
from service.problems import DamagedWeightsError
from service.settings import ServiceSettings, check_weights
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
            sign_ins=SignIns(),
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
        context.hub.start()
        context.receipts.start()
        with suppress(DamagedWeightsError):  # the error is logged, and /readyz reports it
            await asyncio.to_thread(check_weights)
        yield
        context.receipts.close()
        await context.hub.close()
        await context.inspector.processes.close()
        context.readiness.close()
        threads.close()
        store.close()

    app = _App(
        title="sgsst",
        version=_version(),
        description=_DESCRIPTION,
        lifespan=lifespan,
        generate_unique_id_function=lambda route: route.name,
        docs_url=None,  # FastAPI's own page loads its script from a CDN
        redoc_url=None,
    )
    app.settings = settings
    modules = (submission, jobs, events, inputs, artifacts, shares, uploads, session, operations)
    for module in modules:
        app.include_router(module.router)
    add_static(app)
    add_handlers(app)
    app.add_middleware(Deadlines, seconds=settings.answer_seconds)

    plain = app.openapi

    def openapi() -> dict[str, Any]:
        if not app.openapi_schema:
            routes = [*app.routes, *(route for module in modules for route in module.router.routes)]
            complete(plain(), routes, (Problem, JobFromUploads, *ANSWERS))
        return app.openapi_schema or {}

    app.openapi = openapi  # type: ignore[method-assign]
    return app


class _App(FastAPI):
    """FastAPI with middleware around its own, which responds to unexpected errors."""

    settings: ServiceSettings

    def build_middleware_stack(self) -> ASGIApp:
        """Return the app with all middleware."""
        inner = Methods(super().build_middleware_stack())
        return Observed(Proxied(inner, self.settings), self.state)


def _version() -> str:
    try:
        return version("sgsst-service")
    except PackageNotFoundError:
        return "0"
