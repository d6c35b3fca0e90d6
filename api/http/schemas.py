"""Models of the API's requests and responses, and the addresses in them.

Addresses are below the subpath at which a reverse proxy offers the service. The subpath is that of the current request:
a setting, or what a trusted proxy has sent.
"""

from collections.abc import Sequence
from contextvars import ContextVar
from datetime import UTC, date, datetime
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from starlette.types import Scope

from service.files.objects import media_type
from service.inputs import JobName, JobParameters
from service.problems import JOB_ID, SHA256, SHARE_ID, SHARE_TOKEN, UPLOAD_ID
from service.states import UNFINISHED, AttemptOutcome, JobStatus
from service.store.jobs import ShownJob
from service.store.tables import ArtifactRow, AttemptRow, Base, JobRow, UploadRow
from sgsst_core.files.formats import ResultName
from sgsst_core.files.formats.ply import PLY
from sgsst_core.progress import Progress
from worker.options import Viewpoints

if TYPE_CHECKING:
    StatusName = str
    OutcomeName = str
else:  # inlined in the OpenAPI document; enumerations would get schemas of their own
    StatusName = Literal[tuple(map(str, JobStatus))]
    OutcomeName = Literal[tuple(map(str, AttemptOutcome))]

Model = TypeVar("Model", bound=BaseModel)

#: Maximum number of points of a loss history.
MOST_POINTS = 512
#: Maximum absolute weight of a result in a blend.
MAX_WEIGHT = 10
#: Times in the examples.
_CREATED, _STARTED, _NOW = "2026-11-21T14:06:02.057842Z", "2026-11-21T14:06:05.536727Z", "2026-11-21T14:09:30.532514Z"


#: Subpath of the current request, such as "/sgsst"; empty at the root of a host.
subpath: ContextVar[str] = ContextVar("subpath", default="")


def address(path: str) -> str:
    """Return the address, as clients see it, of a path of the API."""
    return subpath.get() + path


def path_of(scope: Scope) -> str:
    """Return the path of a request without the subpath."""
    path: str = scope["path"]
    return path.removeprefix(scope.get("root_path", ""))


def utc(seconds: object) -> object:
    """Return a time in seconds since the epoch as a UTC datetime; return anything else unchanged."""
    return datetime.fromtimestamp(seconds, UTC) if isinstance(seconds, int | float) else seconds


#: Time in responses; rows of the database store seconds since the epoch.
Time = Annotated[datetime, BeforeValidator(utc)]


#: Weight of a result in a blend.
BlendWeight = Annotated[
    float, Field(ge=-MAX_WEIGHT, le=MAX_WEIGHT), AfterValidator(lambda weight: round(weight, 3) or 0.0)
]


def _with_example(**example: Any) -> ConfigDict:
    """Return the configuration of a response with an example for the OpenAPI document."""
    return ConfigDict(json_schema_extra={"examples": [example]})


def _strict(**example: Any) -> ConfigDict:
    """Return the configuration of a request, which may have no unknown fields."""
    return ConfigDict(extra="forbid", json_schema_extra={"examples": [example]})


def example_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return the example of a model, for use in another example."""
    extra = model.model_config["json_schema_extra"]
    assert isinstance(extra, dict)
    return extra["examples"][0]  # type: ignore[index, return-value]


class ErrorView(BaseModel):
    """Reason why a job or an attempt failed."""

    model_config = ConfigDict(extra="allow") | _with_example(
        code="diverged", message="Step 41: the loss is not finite. Lower the learning rate."
    )

    code: str
    message: str


class ProgressView(Progress):
    """Progress of a job."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{**example_of(Progress), "attempt": 1, "updated_at": _NOW}],
            "required": ["stage", "step", "total", "fraction", "eta_s", "loss", "seconds", "attempt", "updated_at"],
        }
    )

    attempt: int
    updated_at: Time


class ProgressPoint(BaseModel):
    """Progress of a job at one moment."""

    model_config = _with_example(
        **{name: value for name, value in example_of(ProgressView).items() if name not in ("fraction", "eta_s")}
    )

    attempt: int
    stage: str = Field(description="Same as in a job's progress.")
    step: int = Field(description="Completed steps; an attempt that resumes from a checkpoint starts behind it.")
    total: int
    seconds: float = Field(description="Seconds of all steps so far.")
    loss: float
    scales: list[float | None] | None = Field(description="Same as in a job's progress.")
    mean_loss: float | None = Field(None, description="Same as in a job's progress.")
    mean_scales: list[float | None] | None = Field(None, description="Same as in a job's progress.")
    updated_at: Time


class ProgressHistory(BaseModel):
    """Loss history of a job, oldest point first."""

    model_config = _with_example(points=[example_of(ProgressPoint)])

    points: list[ProgressPoint] = Field(
        max_length=MOST_POINTS,
        description="Points evenly spaced in the logarithm of seconds, including the job's first and last.",
    )


class InputView(BaseModel):
    """A file that a job was created from."""

    model_config = _with_example(role="scene", name="scene.ply", size=42301, sha256=SHA256)

    role: Literal["scene", "style", "cameras", "photos", "mask", "painted"]
    name: str
    size: int
    sha256: str


class AttemptView(BaseModel):
    """One attempt at a job."""

    model_config = _with_example(number=1, started_at=_STARTED, finished_at=None, outcome=None, error=None)

    number: int
    started_at: Time
    finished_at: Time | None
    outcome: OutcomeName | None = Field(
        description="`lost`: its dispatcher stopped responding; `released`: it shut down and returned the job."
    )
    error: ErrorView | None


class Links(BaseModel):
    """Addresses of a job's resources."""

    model_config = _with_example(
        self=f"/v1/jobs/{JOB_ID}",
        events=f"/v1/jobs/{JOB_ID}/events",
        artifacts=f"/v1/jobs/{JOB_ID}/artifacts",
        result=None,
    )

    self: str
    events: str
    artifacts: str
    result: str | None = Field(description="Address of the stylized PLY once it exists.")


class JobView(BaseModel):
    """A job."""

    model_config = _with_example(
        id=JOB_ID,
        name="plush",
        status="running",
        created_at=_CREATED,
        started_at=_STARTED,
        finished_at=None,
        expires_at=None,
        attempt=1,
        queue_position=None,
        preview="previews/step_0000100.jpg",
        progress=example_of(ProgressView),
        result=None,
        error=None,
        viewpoints={"start": None, "named": []},
        parameters={"name": "plush", "preset": "standard"},
        inputs=[example_of(InputView), {"role": "style", "name": "style.jpg", "size": 10421, "sha256": SHA256[::-1]}],
        input_counts={"scene": 1, "style": 1},
        links=example_of(Links),
    )

    id: str
    name: str
    status: StatusName
    created_at: Time
    started_at: Time | None
    finished_at: Time | None
    expires_at: Time | None = Field(
        description="Time at which the results are deleted, or the record of an expired job."
    )
    attempt: int = Field(description="Number of the latest attempt; 0 before the first.")
    queue_position: int | None = Field(description="1 is next; null if the job is not queued.")
    preview: str | None = Field(description="Artifact with the newest preview image; null if there is none yet.")
    progress: ProgressView | None
    result: dict[str, Any] | None = Field(
        description="Why the job stopped (`stopped`), its `steps` of `total`, and before and after: its loss, or with "
        "painted views their PSNR in dB on painted pixels."
    )
    error: ErrorView | None
    viewpoints: Viewpoints
    parameters: dict[str, Any] = Field(
        description="As `JobParameters`, with defaults for omitted fields; fields of an earlier version are shown as "
        "they were stored."
    )
    inputs: list[InputView] = Field(
        description="Scene, style images, cameras and painted files. `GET /v1/jobs/{job_id}/inputs` lists photos and "
        "masks too."
    )
    input_counts: dict[str, int] = Field(description="Number of files by role, photos and masks included.")
    links: Links


class JobDetail(JobView):
    """A job with its attempts."""

    model_config = _with_example(**example_of(JobView), attempts=[example_of(AttemptView)])

    attempts: list[AttemptView]


class JobPage(BaseModel):
    """A page of jobs, newest first."""

    model_config = _with_example(jobs=[example_of(JobView)], next_cursor=JOB_ID)

    jobs: list[JobView]
    next_cursor: str | None = Field(description="`cursor` of the next page; null on the last one.")


class ArtifactView(BaseModel):
    """A file that a job has made."""

    model_config = _with_example(
        name="stylized.ply",
        size=42301,
        sha256=SHA256,
        media_type="application/octet-stream",
        created_at=_NOW,
        url=f"/v1/jobs/{JOB_ID}/artifacts/stylized.ply",
    )

    name: str
    size: int
    sha256: str
    media_type: str
    created_at: Time
    url: str


class ArtifactList(BaseModel):
    """A page of the files that a job has made so far, by name."""

    model_config = _with_example(artifacts=[example_of(ArtifactView)], next_cursor=None)

    artifacts: list[ArtifactView]
    next_cursor: str | None = Field(description="`cursor` of the next page; null on the last one.")


class BlendPart(BaseModel):
    """Result of another job in a blend."""

    model_config = _strict(job_id=JOB_ID, weight=0.2)

    job_id: str = Field(pattern="^job_[0-9a-f]{31}$", description="Finished job of the same scene.")
    weight: BlendWeight


class BlendRequest(BaseModel):
    """Blend of a job's scene with its result, and with results of other jobs of the same scene."""

    model_config = _strict(weight=0.7, others=[], format="ply")

    weight: BlendWeight = Field(
        description="Weight of the job's result, rounded to thousandths. The scene has the remaining weight up to 1; "
        "1.5 exaggerates the style by half."
    )
    others: list[BlendPart] = Field(default_factory=list, max_length=2, description="Results of other jobs.")
    format: ResultName = Field(PLY.name, description="Format of the blend.")


class InputFileView(InputView):
    """A file that a job was created from, and the address of its content."""

    model_config = _with_example(**example_of(InputView), url=f"/v1/jobs/{JOB_ID}/inputs/scene")

    url: str


class InputList(BaseModel):
    """A page of the files that a job was created from, in the order in which they were sent."""

    model_config = _with_example(inputs=[example_of(InputFileView)], next_cursor="1")

    inputs: list[InputFileView]
    next_cursor: str | None = Field(description="`cursor` of the next page; null on the last one.")


class UploadView(BaseModel):
    """A file that is uploaded in parts."""

    model_config = _with_example(
        id=UPLOAD_ID,
        filename="scene.ply",
        length=42301,
        offset=16384,
        complete=False,
        sha256=None,
        expires_at="2026-11-22T14:02:11.332514Z",
    )

    id: str
    filename: str
    length: int
    offset: int
    complete: bool
    sha256: str | None
    expires_at: Time


class UpView(BaseModel):
    """Up direction of an orbit."""

    model_config = _with_example(
        direction="-y", sure=False, candidates=["-y", "z"], reason="neither a ground nor one side to rest on was found"
    )

    direction: str = Field(description="Axis, such as `-y`, or three components.")
    sure: bool = Field(description="Whether the scene determines it, or the parameter `up` gives it.")
    candidates: list[str] = Field(
        description="Values of the parameter `up` to choose from, the likeliest first; two if it is not sure."
    )
    reason: str


class PlanView(BaseModel):
    """Plan of a job that was not queued."""

    model_config = _with_example(
        gaussians=616,
        dropped=0,
        sh_degree=0,
        views=3,
        pixels=9216,
        style=[80, 96],
        photos=0,
        workers=1,
        estimated_seconds=12.4,
        total_seconds=21.9,
        up=None,
        warnings=["region left: ignored, because it has no Gaussians: half-space=1,0,0,9"],
        memory_bytes=946495488,
        device_memory_bytes=None,
        plan={
            "version": 1,
            "decisions": [
                {
                    "item": "partition",
                    "decision": "none: the network takes each view as a whole",
                    "reason": "tiles are as large as fit in the 1.6 GB for activations",
                    "seconds": None,
                    "bytes": None,
                    "error": "none",
                }
            ],
        },
    )

    gaussians: int
    dropped: int
    sh_degree: int
    views: int
    pixels: int
    style: list[int] = Field(description="Width and height; empty with painted files.")
    photos: int
    workers: int | None = Field(description="Requested workers; null if the service decides when the job starts.")
    estimated_seconds: float | None = Field(description="Estimated seconds of all steps; null if unknown.")
    total_seconds: float | None = Field(
        None,
        description="Estimated seconds of the whole job after it leaves the queue: start, reading, planning, steps, "
        "measurements and files; null if unknown. A job that stops early takes less.",
    )
    up: UpView | None = Field(None, description="Up direction of an orbit; null with cameras.")
    warnings: list[str] = Field(
        default_factory=list, description="Decisions that need attention, such as views that see nothing."
    )
    memory_bytes: int | None = Field(description="Estimated peak memory; null if unknown.")
    device_memory_bytes: int | None = Field(
        None, description="Estimated peak memory of the GPU; null if no GPU is used."
    )
    plan: dict[str, Any] = Field(description="Plan in the format of `plan.json`.")


class SignIn(BaseModel):
    """An API key that a browser sends to sign in."""

    model_config = _strict(key="sgsst_ThisIsNoKeyButAnExampleOfOne") | ConfigDict(hide_input_in_errors=True)

    key: str = Field(
        min_length=1, max_length=200, description="Key created by `sgsst keys create NAME` on the service's machine."
    )


class JobChange(BaseModel):
    """Changes to a job; at least one."""

    model_config = _strict(name="plush, at night")

    name: JobName | None = Field(
        None, description="New display name; an empty one restores the names of scene and style."
    )
    viewpoints: Viewpoints | None = Field(
        None,
        description="Viewpoints of the page that shows the result, in place of all former ones: on this service, "
        "behind its shared links, and as a file. Rendering an image of a new `start` takes seconds.",
    )

    @model_validator(mode="after")
    def _check_given(self) -> Self:
        if self.name is None and self.viewpoints is None:
            raise ValueError("nothing would change: give a name or viewpoints")
        return self


class NewShare(BaseModel):
    """Share link to create for the result of a job."""

    model_config = _strict(days=7, poster=False)

    days: float = Field(
        7.0,
        ge=1 / (24 * 60),
        le=90,
        strict=True,
        allow_inf_nan=False,
        description="Lifetime of the link in days, at least a minute.",
    )
    poster: bool = Field(
        False,
        strict=True,
        description="Whether the token is in the path of the link, so that sites and messengers where it is posted can "
        "show an image of the result.",
    )


class ShareView(BaseModel):
    """A link to the result of a job."""

    model_config = _with_example(id=SHARE_ID, created_at=_CREATED, expires_at=_NOW)

    id: str
    created_at: Time
    expires_at: Time


class ShareCreated(ShareView):
    """A new link to the result of a job, with its token."""

    model_config = _with_example(
        **example_of(ShareView), url=f"/shared#{SHARE_TOKEN}", embed_url=f"/shared?embed=1#{SHARE_TOKEN}"
    )

    url: str = Field(
        description="Address of the page, on this service. The part after # is the token, which is not stored: "
        "browsers send it to this service only, in the path of `/v1/shared/{token}`. With `poster`, the token is the "
        "last part of the path."
    )
    embed_url: str | None = Field(
        description="Address for a frame in another page: the viewer alone. Null unless the operator allows it "
        "(`SGSST_EMBED_ORIGINS`)."
    )


class ShareList(BaseModel):
    """Links to the result of a job."""

    model_config = _with_example(shares=[example_of(ShareView)])

    shares: list[ShareView]


class SharedView(BaseModel):
    """A shared result, as its viewer needs it."""

    model_config = _with_example(
        name="plush",
        expires_at=_NOW,
        parameters={"background": [0.0, 0.0, 0.0], "near": 0.2},
        viewpoints={"start": None, "named": []},
        cameras=["cameras.json"],
        files=["colors.f16", "stylized.ply"],
    )

    name: str
    expires_at: Time
    parameters: dict[str, Any] = Field(description="Parameters of the job that matter for rendering.")
    viewpoints: Viewpoints
    cameras: list[str] = Field(description="Names of the camera files `cameras:0` and so on.")
    files: list[str] = Field(description="Files of the result.")


class UsageView(BaseModel):
    """Usage of a key on one day (UTC)."""

    model_config = _with_example(
        day="2026-11-21",
        key="key_1a1fe701a104f943e9d4d8cce5b818c",
        name="alice",
        jobs=12,
        gpu_seconds=840.5,
        cpu_seconds=0.0,
        bytes=734003200,
    )

    day: date
    key: str = Field(description="ID of the key; `local` without keys.")
    name: str = Field(description="Name of the key; empty without keys.")
    jobs: int = Field(description="Accepted jobs and retries.")
    gpu_seconds: float = Field(
        description="Seconds of attempts times their GPUs, counted at the end of an attempt. Attempts that were lost "
        "with their machine do not count."
    )
    cpu_seconds: float = Field(description="Seconds of attempts without a GPU, counted in the same way.")
    bytes: int = Field(description="Bytes of the inputs and results of jobs, including those that were deleted since.")


class UsageList(BaseModel):
    """Usage by day and key; days without usage are left out."""

    model_config = _with_example(usage=[example_of(UsageView)])

    usage: list[UsageView]


class SessionView(BaseModel):
    """Session state for the browser."""

    model_config = _with_example(keys_needed=True, signed_in=True, within=600)

    keys_needed: bool = Field(description="Whether an API key is required.")
    signed_in: bool = Field(description="Whether the cookie belongs to a valid session.")
    within: int = Field(description="Time budget in seconds that suits this machine: 60 with a GPU, 600 without.")


class Health(BaseModel):
    """Health of the service."""

    model_config = _with_example(
        status="ok", checks={"database": "ok", "artifacts": "ok", "disk": "ok", "dispatchers": "1"}
    )

    status: Literal["ok", "waiting", "unavailable"] = Field(
        description="`waiting`: jobs are accepted, but no dispatcher is running."
    )
    checks: dict[str, str]


#: Models of responses that routes send as encoded text.
ANSWERS: tuple[type[BaseModel], ...] = (JobPage, JobDetail, ArtifactList, UploadView, PlanView, Health)


def view_of(model: type[Model], row: Base, **given: Any) -> Model:
    """Return a model whose fields are columns of a database row, apart from the given ones."""
    return model(**{name: getattr(row, name) for name in model.model_fields if name not in given}, **given)


def job_view(shown: ShownJob) -> JobView:
    """Return a job as the API shows it."""
    job = shown.row
    base = address(f"/v1/jobs/{job.id}")
    result = f"{base}/artifacts/stylized.ply" if job.status == JobStatus.SUCCEEDED else None
    return view_of(
        JobView,
        job,
        queue_position=shown.position,
        preview=shown.preview,
        # The remaining time is that of the last report, and a job that has ended has none.
        progress={**job.progress, **({} if job.status in UNFINISHED else {"eta_s": None})} if job.progress else None,
        error=job.error or None,
        viewpoints=job.viewpoints or {},
        parameters=JobParameters().model_dump(mode="json") | job.parameters,
        inputs=shown.inputs,
        input_counts=shown.input_counts,
        links=Links(self=base, events=f"{base}/events", artifacts=f"{base}/artifacts", result=result),
    )


def job_detail(shown: ShownJob, attempts: Sequence[AttemptRow]) -> JobDetail:
    """Return a job with its attempts."""
    return JobDetail(**vars(job_view(shown)), attempts=[view_of(AttemptView, row) for row in attempts])


def input_view(job_id: str, index: int, entry: dict[str, Any]) -> InputFileView:
    """Return a file that a job was created from, given its index among those of its role."""
    path = f"/v1/jobs/{job_id}/inputs/{entry['role']}" + (f":{index}" if index else "")
    return InputFileView(**entry, url=address(path))


def poll_seconds(job: JobRow) -> int | None:
    """Return the seconds after which to poll a job again; None if it has ended."""
    if job.status not in UNFINISHED:
        return None
    left = (job.progress or {}).get("eta_s")
    return 2 if left is None else max(1, min(10, round(left / 10)))


def artifact_view(row: ArtifactRow) -> ArtifactView:
    """Return a result as the API shows it."""
    url = address(f"/v1/jobs/{row.job_id}/artifacts/{row.name}")
    return view_of(ArtifactView, row, media_type=media_type(row.name), url=url)


def upload_view(row: UploadRow) -> UploadView:
    """Return an upload as the API shows it."""
    return view_of(UploadView, row, complete=row.sha256 is not None)
