"""Table of all problems that the service reports, from which its errors and the API's documentation derive.

Code raises an error by calling its problem: `raise problems.QUEUE_FULL(limit=10)`. Subclasses of `ServiceError` exist
for errors that some code catches.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from sgsst_core.errors import InfrastructureError, SgsstError


class ServiceError(SgsstError):
    """Error that the service raises on purpose, and answers with a problem document.

    Attributes:
        retry_after: Seconds after which the request may succeed (`Retry-After`); None if waiting does not help.
        extra: Additional members of the problem document.
    """

    def __init__(self, problem: "ProblemType", message: str, code: str, retry_after: int | None) -> None:
        super().__init__(message)
        self.problem, self.code, self.status, self.retry_after = problem, code, problem.status, retry_after
        self.headers: dict[str, str] = {}
        self.extra: dict[str, object] = {}

    def __reduce__(self) -> tuple[Any, ...]:  # ranks send errors to the dispatcher by pickle
        return type(self), (self.problem, str(self), self.code, self.retry_after), self.__dict__


class NotFoundError(ServiceError):
    """Object that does not exist or belongs to another owner."""


class ConflictError(ServiceError):
    """Operation that the state of the job or upload does not allow."""


class NoSpaceError(ServiceError, InfrastructureError):
    """Request that is rejected because the service's disk is too full."""


class StoreError(ServiceError, InfrastructureError):
    """File store that cannot be reached; the exception's cause has the details."""


class DamagedWeightsError(ServiceError, InfrastructureError):
    """Damaged feature network weights on this machine: no job is accepted until they are reinstalled."""


class LostFileError(ServiceError):
    """File that a database row refers to but that is missing from the file store, although the store is reachable."""


class DamagedFileError(ServiceError):
    """Stored file whose SHA-256 differs from the recorded one; it is neither sent nor used."""


class DatabaseUnavailableError(ServiceError, InfrastructureError):
    """Database that does not respond, stays locked for too long, or has no free connection."""


class LeaseLostError(ServiceError):
    """Lost lease: another dispatcher has taken over the job, and writes of the previous holder are rejected."""


@dataclass(frozen=True)
class ProblemType:
    """Kind of problem, from which errors, their responses and the API's documentation derive.

    Attributes:
        code: Stable identifier for programs.
        message: Usual message, with the names of values in braces.
        members: Names of the values that are additional members of the problem document.
        retry_after: Seconds after which the request may succeed; None if waiting does not help.
        headers: Further headers of the response, with the names of values in braces.
        example: Arguments of a call for the example in the API's documentation.
    """

    code: str
    status: int
    message: str = ""
    members: tuple[str, ...] = ()
    retry_after: int | None = None
    headers: Mapping[str, str] = field(default_factory=dict)
    error: type[ServiceError] = ServiceError
    example: Mapping[str, Any] = field(default_factory=dict)

    def __call__(
        self, message: str = "", *, code: str = "", retry_after: int | None = None, **values: object
    ) -> ServiceError:
        """Return an error of this kind.

        Args:
            message: Message in place of the usual one.
            code: Code in place of the usual one, such as that of an error of the core.
            retry_after: Seconds in place of the usual ones.
            values: Values in the message, and additional members; those that are None are left out.
        """
        text = message or self.message.format_map(values)
        error = self.error(self, text, code or self.code, self.retry_after if retry_after is None else retry_after)
        error.headers = {name: value.format_map(values) for name, value in self.headers.items()}
        error.extra = {name: values[name] for name in self.members if values.get(name) is not None}
        return error


#: Values in examples of the API's documentation, which all describe one job.
JOB_ID = "job_1a1fe701a104f943e9d4d8cce5b818c"
UPLOAD_ID = "upl_1a1fe701a104f943e9d4d8cce5b818c"
SHARE_ID = "shr_1a1fe701a104f943e9d4d8cce5b818c"
SHARE_TOKEN = f"{SHARE_ID}.Jx0o1qQz8m2kq3v4w5y6A7b8C9d0E1f2G3h4I5j6K7l"
SHA256 = "3158b524aebf9351a4de9039a6b9b799cfc0452d9cec424a9f867085d0a9a7b5"

_RECOVERY = "If you uploaded it, upload it again; if it is a result, run the job again."
_EXAMPLE_URL = "https://example.com/scene.ply"

_missing = partial(ProblemType, "not-found", 404, error=NotFoundError)
_conflict = partial(ProblemType, "conflict", 409, error=ConflictError)
_wrong_status = partial(_conflict, members=("job_status",))
_unusable = partial(ProblemType, status=422, members=("input",))

# --- requests -------------------------------------------------------------------------------------------------------

MALFORMED_REQUEST = ProblemType(
    "malformed-request",
    400,
    example={"message": "The request violates HTTP: its first line, a header or a chunk is malformed."},
)
HEAD_TOO_LARGE = ProblemType(
    "head-too-large", 431, example={"message": "The request's line and headers have more than 131,072 bytes."}
)
TOO_MANY_CONNECTIONS = ProblemType(
    "too-many-connections",
    503,
    retry_after=5,
    example={"message": "There are 10,000 connections already. Try again later."},
)
MALFORMED_BODY = ProblemType("malformed-body", 400, "The request was cut off. Send it again.")
UNSUPPORTED_TYPE = ProblemType(
    "unsupported-media-type", 415, "The body must be {supported}.", example={"supported": "application/json"}
)
TOO_SLOW = ProblemType(
    "too-slow",
    408,
    "No data arrived for {seconds:g} s, or fewer than {rate} bytes per second. Send the request again.",
    headers={"Connection": "close"},  # the rest of the body may never arrive
    example={"seconds": 60.0, "rate": 1000},
)
TOO_LARGE = ProblemType(
    "too-large",
    413,
    members=("limit",),
    example={
        "message": "The request has 5,000,000,000 bytes. At most 4,000,000,000 are allowed. Use uploads.",
        "limit": 4_000_000_000,
    },
)
METHOD_NOT_ALLOWED = ProblemType(
    "method-not-allowed",
    405,
    "{path!r} does not support {method}. Use one of {allowed}.",
    headers={"Allow": "{allowed}"},
)
INVALID_REQUEST = ProblemType("invalid-request", 422, members=("input", "errors"))
UNAUTHORIZED = ProblemType(
    "unauthorized",
    401,
    "An API key is required: send it as 'Authorization: Bearer KEY'.",
    headers={"WWW-Authenticate": "Bearer"},
)
UNKNOWN_KEY = ProblemType(
    "unauthorized",
    401,
    "The API key is unknown or was revoked. `sgsst keys create NAME` creates one.",
    headers={"WWW-Authenticate": "Bearer"},
)
FOREIGN_SITE = ProblemType(
    "foreign-site",
    403,
    example={"message": "Pages of 'https://example.com' may not use this service without an API key."},
)
CROSS_ORIGIN = ProblemType(
    "cross-origin", 403, example={"message": "Pages of 'https://example.com' may not use the sessions of this service."}
)
TOO_MANY_TRIES = ProblemType(
    "too-many-tries", 429, "Too many invalid keys came from this address. Try again later.", retry_after=30
)
RATE_LIMITED = ProblemType(
    "rate-limited",
    429,
    "This key may send {limit:g} requests a second on average. Wait, and watch jobs by their events instead of "
    "polling.",
    members=("limit",),
    example={"limit": 20, "retry_after": 1},
)
IDEMPOTENCY_KEY_REUSED = ProblemType(
    "idempotency-key-reused", 422, "This Idempotency-Key was used for another request. Give each request its own key."
)

# --- objects that do not exist --------------------------------------------------------------------------------------

NOT_FOUND = _missing()
FILE_REMOVED = _missing("The file has just been removed.")
NO_JOB = _missing("There is no job {job_id}.", example={"job_id": JOB_ID})
NO_ARTIFACT = _missing(
    "Job {job_id} has no file {name!r}, or not yet. Its list of artifacts has all files.",
    example={"job_id": JOB_ID, "name": "stylized.ply"},
)
NO_INPUT = _missing(
    "Job {job_id} has no input {name!r}, or no longer has it. Its list of inputs has all files.",
    example={"job_id": JOB_ID, "name": "style:1"},
)
NO_UPLOAD = _missing("There is no upload {upload_id}, or it has expired.", example={"upload_id": UPLOAD_ID})
LOST_UPLOAD = _missing("The bytes of upload {upload_id} are gone. Start a new one.", example={"upload_id": UPLOAD_ID})
NO_SHARE = _missing("This link does not work: it has expired or was revoked.")
NO_SHARED_FILE = ProblemType(
    "no-shared-file", 404, "This result has no file {name!r}.", error=NotFoundError, example={"name": "colors.f16"}
)

# --- inputs of jobs -------------------------------------------------------------------------------------------------

INVALID_INPUT = _unusable("invalid-input", example={"message": "The files cannot be read.", "input": "scene"})
TOO_MANY_GAUSSIANS = _unusable(
    "too-many-gaussians",
    message="The scene has {count:,} Gaussians{note}. At most {limit:,} are allowed.",
    example={"count": 30_000_000, "note": "", "limit": 20_000_000, "input": "scene"},
)
TOO_MANY_VIEWS = _unusable(
    "too-many-views",
    message="There are {count:,} views. At most {limit:,} are allowed.",
    example={"count": 3000, "limit": 2000, "input": "cameras"},
)
UNSURE_UP = ProblemType(
    "unsure-up",
    422,
    "The scene does not show which way is up: {reason}. Set `up`: {likely} is likely.",
    members=("input", "candidates"),
    example={
        "reason": "neither a ground nor one side to rest on was found, and most captures point this way",
        "likely": "-y or z",
        "candidates": ["-y", "z"],
        "input": "up",
    },
)
UNSURE_CAMERAS = ProblemType(
    "unsure-cameras",
    422,
    "The cameras hardly show this scene: {reason}.",
    members=("input",),
    example={
        "reason": "a typical view has 0.9% of the Gaussians in its frame and shows nothing in 40% of its pixels",
        "input": "cameras",
    },
)
TOO_MANY_PIXELS = _unusable(
    "too-many-pixels",
    message="All views have {count:,} pixels. At most {limit:,} are allowed.",
    example={"count": 30_000_000_000, "limit": 20_000_000_000, "input": "cameras"},
)
IMAGE_TOO_LARGE = _unusable(
    "image-too-large",
    message="{name}: has {width} x {height} pixels. At most {limit:,} are allowed.",
    example={"name": "style.jpg", "width": 20_000, "height": 20_000, "limit": 100_000_000, "input": "style"},
)
TOO_MANY_FILES = ProblemType(
    "too-many-files", 422, "There are more than {limit} {what}.", example={"limit": 2041, "what": "files"}
)
INSPECTION_LIMIT = _unusable(
    "inspection-limit",
    example={"message": "Reading the files takes more time or memory than allowed, or crashes the reader."},
)
UNKNOWN_UPLOAD = _unusable(
    "unknown-upload",
    message="{upload_id!r} is not the ID of a usable upload, and {input!r} has no file name. Send an upload's ID, or a "
    "file with its name.",
    example={"upload_id": UPLOAD_ID, "input": "scene"},
)
UNKNOWN_INPUT = _unusable(
    "unknown-input",
    message="Job {job_id} has no input {name!r}, or no longer has it. Upload the file again.",
    example={"job_id": JOB_ID, "name": "style:1", "input": "style"},
)
UNFINISHED_UPLOAD = _unusable(
    "unfinished-upload",
    message="Upload {upload_id} has {offset:,} of {length:,} bytes. Finish it first.",
    example={"upload_id": UPLOAD_ID, "offset": 16_384, "length": 42_301, "input": "scene"},
)
URLS_OFF = _unusable(
    "urls-off",
    message="Inputs by URL are switched off on this service. Upload the file instead.",
    example={"input": "scene"},
)
INVALID_URL = _unusable(
    "invalid-url",
    message="{url!r} cannot be fetched: {reason}. Name a file of an allowed host, or upload the file.",
    example={
        "url": _EXAMPLE_URL,
        "reason": "'example.com' is not among the hosts that its operator allows",
        "input": "scene",
    },
)
URL_NOT_FETCHED = _unusable(
    "url-not-fetched",
    message="{url!r} was not fetched: {reason}. Check the URL and try again, or upload the file.",
    example={"url": _EXAMPLE_URL, "reason": "the server answered 404", "input": "scene"},
)
WEBHOOKS_OFF = _unusable(
    "webhooks-off", message="Webhooks are switched off on this service.", example={"input": "webhook"}
)
INVALID_WEBHOOK = _unusable(
    "invalid-webhook",
    message="{url!r} cannot be called: {reason}. Give a URL such as 'https://example.com/hook'.",
    example={"url": "ftp://example.com", "reason": "its scheme is neither http nor https", "input": "webhook"},
)

# --- states of jobs and uploads -------------------------------------------------------------------------------------

CONFLICT = _conflict(members=("offset",))
CHANGED_MEANWHILE = _conflict(
    "Another request changed or deleted this at the same time. Get its current state, then try again."
)
NOT_CANCELABLE = _wrong_status("The job has {job_status} and cannot be canceled.", example={"job_status": "succeeded"})
NOT_RUNNING = _wrong_status(
    "The job has status {job_status}; only a running job can be finished early.", example={"job_status": "queued"}
)
NOT_RETRYABLE = _wrong_status(
    "The job has status {job_status}; only failed, canceled and stopped jobs can be retried.",
    example={"job_status": "running"},
)
NOT_ENDED = _wrong_status(
    "The job has status {job_status}. {advice}; delete it once it has ended.",
    example={"job_status": "running", "advice": "Cancel it first"},
)
NO_RESULT = _wrong_status(
    "The job has status {job_status}; only results can be shared.", example={"job_status": "running"}
)
TOO_MANY_SHARES = ProblemType(
    "too-many-shares",
    409,
    "The job has {limit} links already. Revoke some.",
    error=ConflictError,
    example={"limit": 20},
)
TOO_MANY_BLENDS = _conflict(
    "Job {job_id} already has {limit} blends, the maximum. Blend downloaded scenes with `sgsst blend`.",
    members=("limit",),
    example={"job_id": JOB_ID, "limit": 20},
)
WRONG_OFFSET = _conflict(
    "Upload-Offset is {given}, but the next byte is {offset}.",
    members=("offset",),
    example={"given": 0, "offset": 16_384},
)
TOO_MANY_UPLOADS = _conflict(
    "There are {limit} unfinished uploads of this key. Finish or delete some.", example={"limit": 1000}
)
UPLOAD_LOCKED = ProblemType(
    "upload-locked", 423, "Another request is writing to this upload. Get its offset and resume from there."
)
CHECKSUM_MISMATCH = ProblemType(
    "checksum-mismatch",
    460,
    "The digest of this part differs from Upload-Checksum. The part was discarded; send it again.",
)
TUS_VERSION = ProblemType(
    "unsupported-tus-version",
    412,
    "Tus-Resumable: {reason}. Send {version}.",
    headers={"Tus-Version": "{version}"},
    example={"reason": "'0.2.2' is not supported", "version": "1.0.0"},
)
TUS_EXTENSION = ProblemType(
    "unsupported-tus-extension",
    400,
    "{header}: the extension {extension!r} is not supported. Those supported are {supported}.",
    example={"header": "Upload-Concat", "extension": "concatenation", "supported": "creation,expiration"},
)
RANGE_NOT_SATISFIABLE = ProblemType(
    "range-not-satisfiable",
    416,
    "The file has {size} bytes.",
    headers={"Content-Range": "bytes */{size}"},
    example={"size": 42_301},
)
PRECONDITION_FAILED = ProblemType(
    "precondition-failed", 412, "The file is not the one that If-Match names. Get its current ETag with a HEAD request."
)

# --- limits ---------------------------------------------------------------------------------------------------------

QUEUE_FULL = ProblemType(
    "queue-full",
    429,
    "There are already {limit} unfinished jobs of this key. Wait for one to finish, or cancel one.",
    members=("limit",),
    retry_after=30,
    example={"limit": 100},
)
QUOTA_EXCEEDED = ProblemType(
    "quota-exceeded",
    429,
    members=("quota", "limit"),
    example={
        "message": "This key has submitted its 1,000 jobs of the day. Try again tomorrow (UTC).",
        "quota": "jobs-a-day",
        "limit": 1000,
        "retry_after": 30_000,
    },
)
STORED_BYTES_EXCEEDED = ProblemType(
    "quota-exceeded",
    429,
    "This would raise the stored bytes of this key to {used:,}. At most {limit:,} are allowed. Delete jobs or uploads "
    "first.",
    members=("quota", "limit"),
    retry_after=3600,
    example={"used": 120_000_000_000, "limit": 100_000_000_000, "quota": "stored-bytes"},
)
BUSY = ProblemType("busy", 503, "Too many files are being checked. Try again later.", retry_after=10)
STOPPING = ProblemType("busy", 503, "The service is stopping. Try again later.", retry_after=5)

# --- faults of the service ------------------------------------------------------------------------------------------

INTERNAL = ProblemType(
    "internal", 500, "Something went wrong on the service's side; its log says what.", members=("request_id",)
)
NO_SPACE = ProblemType(
    "insufficient-storage",
    507,
    "The service's disk is too full to store this. Try again later.",
    retry_after=30,
    error=NoSpaceError,
)
STORE_UNAVAILABLE = ProblemType(
    "store-unavailable",
    503,
    "The service's store of files does not answer. Try again later.",
    retry_after=10,
    error=StoreError,
)
DEADLINE_EXCEEDED = ProblemType(
    "deadline-exceeded",
    503,
    "The service got no answer for {seconds:g} s from its database, its store of files or its disk. Try again later.",
    retry_after=10,
    example={"seconds": 30.0},
)
WEIGHTS_DAMAGED = ProblemType(
    "weights-damaged",
    503,
    "The service's feature networks are damaged. Retry after its operator has reinstalled them; the log and "
    "`sgsst weights list` name them.",
    retry_after=60,
    error=DamagedWeightsError,
)
FILE_LOST = ProblemType(
    "file-lost",
    500,
    f"The service has lost the file with SHA-256 {{sha256}}. {_RECOVERY}",
    error=LostFileError,
    example={"sha256": SHA256},
)
FILE_DAMAGED = ProblemType(
    "file-damaged",
    500,
    f"The service's copy of the file with SHA-256 {{sha256}} is damaged. {_RECOVERY}",
    error=DamagedFileError,
    example={"sha256": SHA256},
)
DATABASE_UNAVAILABLE = ProblemType(
    "database-unavailable",
    503,
    "The service's database is not available. Try again later.",
    retry_after=5,
    error=DatabaseUnavailableError,
)
DATABASE_BUSY = ProblemType(
    "database-busy",
    503,
    "The service's database is busy. Try again later.",
    retry_after=5,
    error=DatabaseUnavailableError,
)
LEASE_LOST = ProblemType(
    "lease-lost",
    409,
    "{job_id}: lease {epoch} of {dispatcher} is no longer held.",
    error=LeaseLostError,
    example={"job_id": JOB_ID, "epoch": 1, "dispatcher": "local"},
)
