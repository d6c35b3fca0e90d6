"""`/livez`, `/readyz`, `/metrics`: health and metrics for operators."""

from __future__ import annotations

from fastapi import APIRouter, Response
from fastapi.responses import JSONResponse, PlainTextResponse

from api.http.context import ContextDep
from api.http.documentation import headers
from api.http.schemas import Health

router = APIRouter(tags=["operations"])


@router.get("/livez", response_model=Health)
async def livez() -> Health:
    """Check that the process answers. If it does not, restart it."""
    return Health(status="ok", checks={})


@router.get(
    "/readyz",
    response_model=Health,
    responses={
        503: {
            "description": "Something that jobs need is unavailable; `checks` names it.",
            "headers": headers("Retry-After"),
            "content": {
                "application/json": {
                    "schema": {"$ref": "#/components/schemas/Health"},
                    "example": {
                        "status": "unavailable",
                        "checks": {
                            "database": "ok",
                            "artifacts": "ok",
                            "disk": "NoSpaceError",
                            "weights": "ok",
                            "dispatchers": "1",
                        },
                    },
                }
            },
        }
    },
)
async def readyz(context: ContextDep) -> Response:
    """Check that jobs can be accepted.

    The database must answer, results must be storable, the disk must have free space, and the weights of the feature
    networks must be intact.

    Without a dispatcher, jobs are accepted and wait in the queue: the answer is 200 with status `waiting`, and its
    check `dispatchers` is "none". Otherwise that check is the number of dispatchers that are alive. The answer comes
    within a second; a check that has not returned by then has failed (`TimeoutError`).
    """
    outcomes = await context.readiness.run()
    checks = {
        name: type(outcome).__name__ if isinstance(outcome, BaseException) else "ok"
        for name, outcome in outcomes.items()
    }
    ready, alive = set(checks.values()) == {"ok"}, outcomes["database"]
    if not isinstance(alive, BaseException):
        checks["dispatchers"] = str(alive or "none")
    if not ready:
        return JSONResponse(Health(status="unavailable", checks=checks).model_dump(), 503, {"Retry-After": "5"})
    view = Health(status="ok" if alive else "waiting", checks=checks)
    return JSONResponse(view.model_dump())


@router.get(
    "/metrics",
    response_class=PlainTextResponse,
    responses={
        200: {
            "description": "Metrics in the Prometheus text format.",
            "content": {"text/plain": {"example": 'sgsst_jobs{status="queued"} 3.0\n'}},
        }
    },
)
async def metrics(context: ContextDep) -> Response:
    """Get Prometheus metrics."""
    text = await context.threads.run("", context.metrics.render)  # it looks at the disk, too
    return Response(text, media_type="text/plain; version=0.0.4; charset=utf-8")
