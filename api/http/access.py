"""Access without an API key in each request: `/v1/session`, where a browser sends its key once and gets a cookie, and
links to a result, `/v1/jobs/{id}/shares`, which anyone who has one can read at `/v1/shared/{token}`.
"""

import asyncio
import contextlib
import html
import json
from dataclasses import replace
from typing import Annotated

from fastapi import APIRouter, Depends, Path, Request, Response
from fastapi.responses import StreamingResponse

from api.http import schemas
from api.http.context import SESSION_COOKIE, CallerDep, Context, ContextDep, check_origin, check_site, is_id
from api.http.jobs import INPUT_POLICY, JobId, artifact_file, find_input, input_file
from api.http.problems import headers, links, raises
from api.http.receiving import json_body
from api.http.sending import PAGE_HEADERS, ConditionsDep, SentFile, file_answers, send_file, shared_page, shared_policy
from service import problems
from service.files.objects import media_type
from service.inspection.derived import POSTER
from service.problems import SHARE_ID, SHARE_TOKEN, NotFoundError, ServiceError
from service.store.jobs import Shared
from service.store.keys import Quotas
from service.store.tables import ArtifactRow

# --- sessions --------------------------------------------------------------------------------------------------------

#: Number of failed attempts from one address until it has one in so many seconds. They are not stored in the database:
#: keys of 256 bits cannot be guessed anyway, and attackers could fill it with rows.
MOST_FAILURES, SECONDS_A_TRY = 10, 60.0

session_router = APIRouter(prefix="/v1/session", tags=["session"])


@raises(problems.CROSS_ORIGIN)
async def check_page(request: Request) -> None:
    """Raise an error if a request comes from a page of another origin."""
    check_origin(request, required=False)


@session_router.post(
    "",
    dependencies=[Depends(check_page)],
    status_code=204,
    response_class=Response,
    responses={
        204: {"description": "Signed in; the cookie is the session.", "headers": headers("Set-Cookie", "Cache-Control")}
    },
)
async def sign_in(
    request: Request, context: ContextDep, sign_in: Annotated[schemas.SignIn, Depends(json_body(schemas.SignIn))]
) -> Response:
    """Sign in: exchange an API key for a session cookie.

    The cookie is HttpOnly, and browsers send it only from pages of this site. A session ends after some days
    (`SGSST_SESSION_DAYS`), with `DELETE`, or when its key is revoked.
    """
    address = request.client.host if request.client else ""
    try:  # counted as failed until the outcome is known, so that parallel attempts cannot pass the limit
        context.sign_ins.take(address, 1 / SECONDS_A_TRY, MOST_FAILURES)
    except ServiceError as error:
        raise problems.TOO_MANY_TRIES(retry_after=error.retry_after) from None
    try:
        key = await asyncio.to_thread(context.store.keys.find, sign_in.key)
    except ServiceError:
        context.sign_ins.give_back(address)
        raise
    if key is None:
        raise problems.UNKNOWN_KEY()
    context.sign_ins.give_back(address)
    await _end(request, context)
    text = await asyncio.to_thread(context.store.sessions.create, key.id)
    return _cookie_answer(request, text, int(context.store.sessions.seconds))


@session_router.get("", response_model=schemas.SessionView)
async def get_session(request: Request, context: ContextDep, response: Response) -> schemas.SessionView:
    """Get whether a key is required, and whether this browser has a session."""
    response.headers["Cache-Control"] = "no-store"
    cookie = request.cookies.get(SESSION_COOKIE)
    key = await asyncio.to_thread(context.store.sessions.find, cookie) if cookie else None
    within = await asyncio.to_thread(lambda: context.usual_budget)
    if key is not None or not context.settings.keys_required:
        await context.inspector.processes.warm()  # whoever opens the page may create a job soon
    return schemas.SessionView(keys_needed=context.settings.keys_required, signed_in=key is not None, within=within)


@session_router.delete(
    "",
    status_code=204,
    response_class=Response,
    responses={204: {"description": "The session has ended.", "headers": headers("Set-Cookie", "Cache-Control")}},
)
async def sign_out(request: Request, context: ContextDep) -> Response:
    """End the session and delete its cookie. Without a session, nothing happens."""
    check_origin(request, required=SESSION_COOKIE in request.cookies)
    await _end(request, context)
    return _cookie_answer(request, "", 0)


async def _end(request: Request, context: Context) -> None:
    """End the session of the request's cookie, if there is one."""
    cookie = request.cookies.get(SESSION_COOKIE)
    if cookie:
        await asyncio.to_thread(context.store.sessions.end, cookie)


def _cookie_answer(request: Request, text: str, seconds: int) -> Response:
    """Return a response with status 204 that sets the session cookie.

    The scheme comes from `Origin`: behind a proxy that terminates TLS, the request itself arrives over plain HTTP.
    """
    secure = request.url.scheme == "https" or request.headers.get("origin", "").startswith("https://")
    response = Response(status_code=204, headers={"Cache-Control": "no-store"})
    path = schemas.subpath.get() or "/"
    response.set_cookie(
        SESSION_COOKIE, text, max_age=seconds, path=path, secure=secure, httponly=True, samesite="strict"
    )
    return response


# --- links to results ------------------------------------------------------------------------------------------------

router = APIRouter(tags=["shares"])

_DAY = 86_400.0
#: Results that a share shows, with the names of their artifacts, of which the first one that exists is shown.
_RESULTS = {
    "colors.f16": ("colors.f16",),
    "stylized.ply": ("stylized.ply",),
    "poster": (POSTER, "previews/thumbnail.jpg"),
}
#: Parameters of a job that matter for rendering.
_RENDERED = ("background", "near", "render_mode", "eps2d", "sh_attenuation")
#: Media type of shared files.
_KIND = "application/octet-stream"
#: Headers of answers to requests with a token in their path: neither pages nor caches may pass it on.
_SECRET = {"Referrer-Policy": "no-referrer", "Cache-Control": "no-store"}

ShareToken = Annotated[str, Path(description="Token of a share.", max_length=120, examples=[SHARE_TOKEN])]


@raises(problems.NO_SHARE, problems.RATE_LIMITED, problems.FOREIGN_SITE)
async def get_shared(request: Request, context: ContextDep, token: ShareToken) -> Shared:
    """Return the share that a request names by its token, instead of a caller.

    Raises:
        FOREIGN_SITE: If the service requires no keys, and the request does not come from this machine's pages.
        RATE_LIMITED: If requests of one share, or with wrong tokens from one address, arrive too fast.
        NO_SHARE: If the token is not valid.
    """
    if not context.settings.keys_required:
        check_site(request, context.settings)
    limit = Quotas.of_settings(context.settings).requests_a_second
    try:
        shared = await asyncio.to_thread(context.store.shares.find, token)
    except NotFoundError:
        context.rates.take(f"address {request.client.host if request.client else ''}", limit)
        raise
    context.rates.take(shared.share.id, limit)
    return shared


SharedDep = Annotated[Shared, Depends(get_shared)]


@router.post(
    "/v1/jobs/{job_id}/shares",
    status_code=201,
    response_model=schemas.ShareCreated,
    responses={
        201: {
            "description": "The link. Its token is not shown again.",
            "headers": headers("Cache-Control"),
            "links": links("revoke_share", job_id="$request.path.job_id", share_id="$response.body#/id"),
        }
    },
)
async def create_share(
    job_id: JobId,
    context: ContextDep,
    caller: CallerDep,
    new: Annotated[schemas.NewShare, Depends(json_body(schemas.NewShare))],
) -> Response:
    """Create a read-only link to the result of a job, for people without a key.

    Whoever has the link sees the scene before and after in 3D, and nothing else, until it expires or is revoked. The
    link also ends with the results of the job, and if the key that created the job is revoked.
    """
    job = await asyncio.to_thread(context.store.jobs.get, job_id, caller.owner)
    if new.poster and job.viewpoints and (start := job.viewpoints["start"]):
        await context.derived.poster(job, start, caller.quotas)  # a continued job has lost its own
    row, token = await asyncio.to_thread(context.store.shares.create, job_id, caller.owner, new.days * _DAY)
    place = f"/{token}" if new.poster else f"#{token}"
    view = schemas.ShareCreated(
        **schemas.view_of(schemas.ShareView, row).model_dump(), url=schemas.address(f"/shared{place}"), embed_url=None
    )
    if context.settings.embed_origins:
        view.embed_url = schemas.address(f"/shared{place}?embed=1" if new.poster else f"/shared?embed=1{place}")
    return Response(view.model_dump_json(), 201, {"Cache-Control": "no-store"}, media_type="application/json")


@router.get("/v1/jobs/{job_id}/shares", response_model=schemas.ShareList)
def list_shares(job_id: JobId, context: ContextDep, caller: CallerDep) -> schemas.ShareList:
    """List the links to the result of a job that have not expired. Their tokens are not stored."""
    context.store.jobs.get(job_id, caller.owner)
    return schemas.ShareList(
        shares=[schemas.view_of(schemas.ShareView, row) for row in context.store.shares.of_job(job_id)]
    )


@router.delete(
    "/v1/jobs/{job_id}/shares/{share_id}",
    status_code=204,
    responses={204: {"description": "The link no longer works."}},
)
def revoke_share(
    job_id: JobId,
    share_id: Annotated[str, Path(description="ID of a share.", examples=[SHARE_ID])],
    context: ContextDep,
    caller: CallerDep,
) -> None:
    """Revoke a link to the result of a job."""
    context.store.jobs.get(job_id, caller.owner)
    if not is_id(share_id):
        raise problems.NO_SHARE()
    context.store.shares.revoke(job_id, share_id)


@router.get(
    "/v1/shared/{token}",
    response_model=schemas.SharedView,
    responses={200: {"headers": headers("Cache-Control", "Referrer-Policy")}},
    operation_id="get_shared",
)
async def show_shared(shared: SharedDep, context: ContextDep) -> Response:
    """Get what the viewer of a shared result needs to know. The token of the link replaces a key."""
    view, plan = await asyncio.to_thread(_shared_view, context, shared)
    if plan is not None:
        view.parameters |= await context.threads.run(shared.job.owner, _up_direction, context, plan, size=plan.size)
    return Response(view.model_dump_json(), headers=_SECRET, media_type="application/json")


def _shared_view(context: Context, shared: Shared) -> tuple[schemas.SharedView, ArtifactRow | None]:
    """Return the public view of a shared job, only what the page needs to show it, and the row of the job's plan.

    Raises:
        NO_SHARE: If the job was deleted meanwhile.
    """
    jobs, job_id = context.store.jobs, shared.job.id
    try:
        job, _ = jobs.detail(job_id, None)
        files = [name for name in _RESULTS if _result(context, job_id, name)]
        plan = jobs.artifact(job_id, "plan.json")
    except NotFoundError:
        raise problems.NO_SHARE() from None
    view = schemas.SharedView(
        name=job.row.name,
        expires_at=shared.share.expires_at,
        parameters={name: job.row.parameters[name] for name in _RENDERED if name in job.row.parameters},
        viewpoints=job.row.viewpoints or {},
        cameras=[entry["name"] for entry in job.inputs if entry["role"] == "cameras"],
        files=files,
    )
    return view, plan


def _result(context: Context, job_id: str, name: str) -> ArtifactRow | None:
    """Return the row of a result that a share shows; None if there is none."""
    rows = (context.store.jobs.artifact(job_id, artifact) for artifact in _RESULTS.get(name, ()))
    return next(filter(None, rows), None)


def _up_direction(context: Context, row: ArtifactRow) -> dict[str, str]:
    """Return the parameter `up` as the plan of an orbit has requested or found it; nothing without an orbit."""
    with contextlib.suppress(FileNotFoundError):
        plan = json.loads(b"".join(context.artifacts.objects.read(row.location, 0, row.size)))
        return next(({"up": each["decision"]} for each in plan["decisions"] if each["item"] == "up"), {})
    return {}


@router.get("/shared/{token}", include_in_schema=False)
async def show_page(request: Request, context: ContextDep, token: ShareToken) -> Response:
    """Return the page of a link with its token in the path: its head names the image for those who preview links."""
    head, status = "", 200
    try:
        shared = await get_shared(request, context, token)
        head = await asyncio.to_thread(_preview_tags, request, context, shared, token)
    except ServiceError as problem:  # the page asks again, and shows the message
        status = problem.status
    answer_headers = {**PAGE_HEADERS, **_SECRET, "Content-Security-Policy": shared_policy(request, context.settings)}
    return Response(shared_page(head), status, answer_headers, media_type="text/html; charset=utf-8")


def _preview_tags(request: Request, context: Context, shared: Shared, token: str) -> str:
    """Return the tags of the Open Graph protocol, whose addresses are absolute."""
    tags = {"og:type": "website", "og:title": shared.job.name}
    if _result(context, shared.job.id, "poster"):
        poster = schemas.address(f"/v1/shared/{token}/poster")
        tags |= {
            "og:image": f"{request.url.scheme}://{request.url.netloc}{poster}",
            "twitter:card": "summary_large_image",
        }
    return "".join(f'<meta property="{name}" content="{html.escape(value)}">\n' for name, value in tags.items())


#: Files that a share gives access to: the scene and its cameras as they were sent, and the result.
_NAMES = r"^(scene|cameras:[0-7]|colors\.f16|stylized\.ply|poster)$"
_ANSWERS = file_answers(
    {"application/octet-stream": "ply\nformat binary_little_endian 1.0\n", "image/jpeg": "\xff\xd8\xff\xe0"},
    always_policy=True,
)


@router.head("/v1/shared/{token}/{name}", operation_id="head_shared_file", response_class=Response, responses=_ANSWERS)
@router.get(
    "/v1/shared/{token}/{name}", operation_id="get_shared_file", response_class=StreamingResponse, responses=_ANSWERS
)
async def get_shared_file(
    request: Request,
    name: Annotated[
        str,
        Path(
            description="`scene` and `cameras:0` as they were sent, `colors.f16` or `stylized.ply` as stylized, or "
            "`poster`, an image of the result.",
            pattern=_NAMES,
            examples=["scene"],
        ),
    ],
    shared: SharedDep,
    context: ContextDep,
    conditions: ConditionsDep,
) -> Response:
    """Download a file of a shared result, whole or in ranges. Only what the viewer shows can be read."""
    file = await asyncio.to_thread(_find_file, context, shared, name)
    response = await send_file(request, context.threads, file, conditions)
    response.headers["Referrer-Policy"] = _SECRET["Referrer-Policy"]
    return response


def _find_file(context: Context, shared: Shared, name: str) -> SentFile:
    """Return the shared file with this name.

    Raises:
        NO_SHARED_FILE: If the job has no such file, such as `colors.f16` after Gaussians were split.
    """
    if stored := find_input(context, shared.job, name):
        return input_file(context, shared.job.owner, stored[1], name, _KIND)
    if row := _result(context, shared.job.id, name):
        kind = media_type(row.name) if name == "poster" else _KIND
        return replace(artifact_file(context, shared.job.owner, row, name, kind), policy=INPUT_POLICY)
    raise problems.NO_SHARED_FILE(name=name)
