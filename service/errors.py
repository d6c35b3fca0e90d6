"""Exceptions of the service. Each class defines its whole response, from which the API's documentation derives."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Self

from service.examples import JOB_ID, SHA256, UPLOAD_ID
from sgsst_core.errors import InfrastructureError, SgsstError

_RECOVERY = "If you uploaded it, upload it again; if it is a result, run the job again."


class ServiceError(SgsstError):
    """Base class of all errors that the service raises on purpose.

    Attributes:
        status: HTTP status of the response.
        message: Default message.
        retry_after: Seconds after which the request may succeed (`Retry-After`); None if waiting does not help.
        headers: Further headers of the response.
        extra: Additional members of the problem document.
        example: Positional arguments of the constructor for the example in the API's documentation.
    """

    code = "service-error"
    status = 500
    message = ""
    retry_after: int | None = None
    headers: Mapping[str, str] = MappingProxyType({})
    example: tuple[Any, ...] = ()

    def __init__(self, message: str = "", *, retry_after: int | None = None, **extra: object) -> None:
        super().__init__(message or self.message)
        self.extra = extra
        if retry_after is not None:
            self.retry_after = retry_after

    @classmethod
    def of_example(cls) -> Self:
        """Return the example in the API's documentation."""
        return cls(*cls.example)


class NotFoundError(ServiceError):
    """Object that does not exist or belongs to another owner."""

    code, status = "not-found", 404


class NoJobError(NotFoundError):
    """Job that does not exist or belongs to another owner."""

    example = (JOB_ID,)

    def __init__(self, job_id: str) -> None:
        super().__init__(f"There is no job {job_id}.")


class NoArtifactError(NotFoundError):
    """File that a job has not made, or has not made yet."""

    example = (JOB_ID, "stylized.ply")

    def __init__(self, job_id: str, name: str) -> None:
        super().__init__(f"Job {job_id} has no file {name!r} (yet). Its artifacts list has all there are.")


class NoUploadError(NotFoundError):
    """Upload that does not exist, belongs to another owner, or has expired."""

    example = (UPLOAD_ID,)

    def __init__(self, upload_id: str) -> None:
        super().__init__(f"There is no upload {upload_id}, or it has expired.")


class LostUploadError(NotFoundError):
    """Upload whose bytes are missing from the disk."""

    example = (UPLOAD_ID,)

    def __init__(self, upload_id: str) -> None:
        super().__init__(f"The bytes of upload {upload_id} are gone. Begin a new one.")


class NoShareError(NotFoundError):
    """Share that does not exist, has expired or was revoked."""

    message = "This link does not work: it has expired or was revoked."


class NoSharedFileError(NotFoundError):
    """File that a shared result does not have."""

    code = "no-shared-file"
    example = ("colors.f16",)

    def __init__(self, name: str) -> None:
        super().__init__(f"This result has no file {name!r}.")


class RefusedInputError(ServiceError):
    """Unusable input; `code` is that of the core's error, and `extra["input"]` names the part of the request."""

    code, status = "invalid-input", 422
    example: tuple[Any, ...] = ("The files cannot be read.", "invalid-input", "scene")

    def __init__(self, message: str, code: str | None = None, input: str | None = None, **extra: Any) -> None:
        super().__init__(message, **extra)
        self.code = code or self.code
        if input is not None:
            self.extra = {"input": input, **extra}


class TooManyGaussiansError(RefusedInputError):
    """Scene with more Gaussians than the settings allow.

    Args:
        note: End of the first sentence, about a setting that multiplies the Gaussians.
    """

    code = "too-many-gaussians"
    example = (30_000_000, 20_000_000)

    def __init__(self, count: int, limit: int, note: str = "") -> None:
        message = f"The scene has {count:,} Gaussians{note}. At most {limit:,} are allowed."
        super().__init__(message, input="scene", limit=limit)


class TooManyViewsError(RefusedInputError):
    """Job with more views than the settings allow."""

    code = "too-many-views"
    example = (3000, 2000)

    def __init__(self, count: int, limit: int) -> None:
        super().__init__(f"There are {count:,} views. At most {limit:,} are allowed.", input="cameras")


class TooManyPixelsError(RefusedInputError):
    """Job whose views have more pixels than the settings allow."""

    code = "too-many-pixels"
    example = (30_000_000_000, 20_000_000_000)

    def __init__(self, count: int, limit: int) -> None:
        super().__init__(f"All views have {count:,} pixels. At most {limit:,} are allowed.", input="cameras")


class ImageTooLargeError(RefusedInputError):
    """Image with more pixels than the settings allow."""

    code = "image-too-large"
    example = ("style.jpg", 20_000, 20_000, 100_000_000, "style")

    def __init__(self, name: str, width: int, height: int, limit: int, role: str | None = None) -> None:
        super().__init__(f"{name}: has {width} x {height} pixels. At most {limit:,} are allowed.", input=role)


class TooManyFilesError(RefusedInputError):
    """Request with more files or fields than a job can have."""

    code = "too-many-files"
    example = (2041, "files")

    def __init__(self, limit: int, what: str) -> None:
        super().__init__(f"There are more than {limit} {what}.")


class InspectionLimitError(RefusedInputError):
    """Input whose inspection exceeds the limits of time and memory, or crashes."""

    code = "inspection-limit"
    example = ("Reading the files takes more time or memory than allowed, or breaks their reader.",)


class UnknownUploadError(RefusedInputError):
    """Field of a job that is neither a file nor the id of an upload."""

    code = "unknown-upload"
    example = (UPLOAD_ID, "scene")

    def __init__(self, upload_id: str, role: str) -> None:
        super().__init__(
            f"{upload_id[:60]!r} is not the ID of a usable upload, and {role!r} has no file name. Send an upload's "
            "ID, or a file with its name.",
            input=role,
        )


class UnknownInputError(RefusedInputError):
    """Reference to an input that no job of the caller has, or that its job has released when it expired."""

    code, status = "unknown-input", 422
    example = (JOB_ID, "style:1", "style")

    def __init__(self, job_id: str, name: str, role: str) -> None:
        super().__init__(f"Job {job_id} has no input {name!r} (any more). Upload the file again.", input=role)


class UnfinishedUploadError(RefusedInputError):
    """Upload that is not complete yet."""

    code = "unfinished-upload"
    example = (UPLOAD_ID, 16_384, 42_301, "scene")

    def __init__(self, upload_id: str, offset: int, length: int, role: str) -> None:
        super().__init__(f"Upload {upload_id} has {offset:,} of {length:,} bytes. Finish it first.", input=role)


class WebhooksOffError(RefusedInputError):
    """Webhook of a job on a service that sends none."""

    code = "webhooks-off"
    example = ()

    def __init__(self) -> None:
        super().__init__("Webhooks are switched off on this service.", input="webhook")


class InvalidWebhookError(RefusedInputError):
    """URL that cannot be called."""

    code = "invalid-webhook"
    example = ("ftp://example.com", "its scheme is neither http nor https")

    def __init__(self, url: str, reason: object) -> None:
        super().__init__(
            f"{url[:100]!r} cannot be called: {reason}. Give a URL such as 'https://example.com/hook'.",
            input="webhook",
        )


class UrlsOffError(RefusedInputError):
    """Input by URL on a service that fetches none."""

    code = "urls-off"
    example = ("scene",)

    def __init__(self, role: str) -> None:
        super().__init__("Inputs by URL are switched off on this service. Upload the file instead.", input=role)


class InvalidUrlError(RefusedInputError):
    """URL, or redirect to one, that inputs may not be fetched from."""

    code = "invalid-url"
    example = (
        "https://example.com/scene.ply",
        "'example.com' is not among the hosts that its operator allows",
        "scene",
    )

    def __init__(self, url: str, reason: object, role: str) -> None:
        super().__init__(
            f"{url[:100]!r} cannot be fetched: {reason}. Name a file of an allowed host, or upload the file.",
            input=role,
        )


class FetchError(RefusedInputError):
    """URL of an input that has not delivered the file."""

    code = "url-not-fetched"
    example = ("https://example.com/scene.ply", "the server answered 404", "scene")

    def __init__(self, url: str, reason: object, role: str) -> None:
        super().__init__(
            f"{url[:100]!r} was not fetched: {reason}. Check the URL and try again, or upload the file.", input=role
        )


class ConflictError(ServiceError):
    """Operation that the state of the job or upload does not allow."""

    code, status = "conflict", 409


class ChangedMeanwhileError(ConflictError):
    """Operation on rows that another request has deleted or created at the same time."""

    message = "Another request has changed or deleted this meanwhile. Look at its state, and try again."


class CancelError(ConflictError):
    """Job that has already ended in another way."""

    example = ("succeeded",)

    def __init__(self, status: str) -> None:
        super().__init__(f"The job has {status} and cannot be canceled.", job_status=status)


class FinishError(ConflictError):
    """Job that is not running, so that it has no colors to keep, or has already ended."""

    example = ("queued",)

    def __init__(self, status: str) -> None:
        super().__init__(f"The job has status {status}; only a running job can be finished early.", job_status=status)


class RetryError(ConflictError):
    """Job that has not failed and was not canceled."""

    example = ("running",)

    def __init__(self, status: str) -> None:
        super().__init__(
            f"The job has status {status}; only failed or canceled jobs can be retried.", job_status=status
        )


class DeleteError(ConflictError):
    """Job that has not ended."""

    example = ("running",)

    def __init__(self, status: str) -> None:
        advice = "It ends in some seconds" if status == "canceling" else "Cancel it first"
        super().__init__(f"The job has status {status}. {advice}; delete it once it has ended.", job_status=status)


class ShareError(ConflictError):
    """Job without a result, which cannot be shared."""

    example = ("running",)

    def __init__(self, status: str) -> None:
        super().__init__(f"The job has status {status}; only results can be shared.", job_status=status)


class TooManySharesError(ConflictError):
    """Share that would exceed the limit of a job."""

    code = "too-many-shares"
    example = (20,)

    def __init__(self, limit: int) -> None:
        super().__init__(f"The job has {limit} links already. Revoke some.")


class OffsetError(ConflictError):
    """Part of an upload that does not start at the next missing byte."""

    example = (0, 16_384)

    def __init__(self, offset: int, expected: int) -> None:
        super().__init__(f"Upload-Offset is {offset}, but the next byte is {expected}.", offset=expected)


class TooManyUploadsError(ConflictError):
    """Upload that would exceed the key's limit of unfinished uploads."""

    example = (1000,)

    def __init__(self, limit: int) -> None:
        super().__init__(f"There are {limit} unfinished uploads of this key. Finish or delete some.")


class TooManyBlendsError(ConflictError):
    """Blend that would exceed the limit of blends of a job."""

    example = (JOB_ID, 20)

    def __init__(self, job_id: str, limit: int) -> None:
        super().__init__(
            f"Job {job_id} has {limit} blends already, and no more are stored. Blend downloaded scenes with "
            "`sgsst blend`.",
            limit=limit,
        )


class IdempotencyError(ServiceError):
    """Idempotency-Key that was already used for a different request."""

    code, status = "idempotency-key-reused", 422
    message = "This Idempotency-Key was used for another request. Give each request its own key."


class TooLargeError(ServiceError):
    """Request with more bytes than the settings allow."""

    code, status = "too-large", 413
    example: tuple[Any, ...] = (
        "The request has 5,000,000,000 bytes. At most 4,000,000,000 are allowed. Use uploads.",
        4_000_000_000,
    )

    def __init__(self, message: str, limit: int) -> None:
        super().__init__(message, limit=limit)


class FileTooLargeError(TooLargeError):
    """Upload with more bytes than the settings allow."""

    example = (20_000_000_000, 16_000_000_000)

    def __init__(self, size: int, limit: int) -> None:
        super().__init__(f"The file has {size:,} bytes. At most {limit:,} are allowed.", limit)


class QueueFullError(ServiceError):
    """Job that would exceed the key's limit of unfinished jobs."""

    code, status = "queue-full", 429
    retry_after = 30
    example = (100,)

    def __init__(self, limit: int) -> None:
        super().__init__(
            f"There are already {limit} unfinished jobs of this key. Wait for one to finish, or cancel one.",
            limit=limit,
        )


class QuotaError(ServiceError):
    """Exhausted quota of a key, which recovers after `retry_after` seconds; `extra["quota"]` names it."""

    code, status = "quota-exceeded", 429
    example: tuple[Any, ...] = (
        "This key may submit 1,000 jobs a day, and has done so. Try again tomorrow (UTC).",
        "jobs-a-day",
        1000,
        30_000,
    )

    def __init__(self, message: str, quota: str, limit: float, retry_after: int) -> None:
        super().__init__(message, quota=quota, limit=limit, retry_after=retry_after)


class BytesQuotaError(QuotaError):
    """Exhausted quota of stored bytes."""

    example = (120_000_000_000, 100_000_000_000)

    def __init__(self, used: int, limit: int) -> None:
        super().__init__(
            f"With this, {used:,} bytes would be kept for this key. At most {limit:,} are allowed. "
            "Delete jobs or uploads first.",
            "stored-bytes",
            limit,
            retry_after=3600,
        )


class RateLimitError(ServiceError):
    """Request that exceeds the key's rate limit, in requests per second."""

    code, status = "rate-limited", 429
    example = (20, 1)

    def __init__(self, limit: float, retry_after: int) -> None:
        super().__init__(
            f"This key may send {limit:g} requests a second on average. Wait, and ask less often: jobs tell of "
            "themselves by events.",
            limit=limit,
            retry_after=retry_after,
        )


class NoSpaceError(ServiceError, InfrastructureError):
    """Request that is rejected because the service's disk is too full."""

    code, status = "insufficient-storage", 507
    message = "The service's disk is too full to take this in. Try again later."
    retry_after = 30


class BusyError(ServiceError):
    """Request that needs a resource that is in use; retrying it later will succeed."""

    code, status = "busy", 503
    retry_after = 10
    message = "Too many files are being checked. Try again later."


class StoreError(ServiceError, InfrastructureError):
    """File store that cannot be reached; the exception's cause has the details."""

    code, status = "store-unavailable", 503
    message = "The service's store of files does not answer. Try again later."
    retry_after = 10


class DeadlineError(ServiceError):
    """Request that made no progress for too long, because something that it needs hangs."""

    code, status = "deadline-exceeded", 503
    retry_after = 10
    example = (30.0,)

    def __init__(self, seconds: float) -> None:
        super().__init__(
            f"The service got no answer for {seconds:g} s from its database, its store of files or its disk. "
            "Try again later."
        )


class DamagedWeightsError(ServiceError, InfrastructureError):
    """Damaged feature network weights on this machine: no job is accepted until they are reinstalled."""

    code, status = "weights-damaged", 503
    message = (
        "The service's feature networks are damaged. Retry after its operator has reinstalled them; the log and "
        "`sgsst weights list` name them."
    )
    retry_after = 60


class LostFileError(ServiceError):
    """File that a database row refers to but that is missing from the file store, although the store is reachable."""

    code, status = "file-lost", 500
    example = (SHA256,)

    def __init__(self, sha256: str) -> None:
        super().__init__(f"The service has lost the file with SHA-256 {sha256}. {_RECOVERY}")


class DamagedFileError(ServiceError):
    """Stored file whose SHA-256 differs from the recorded one; it is neither sent nor used."""

    code, status = "file-damaged", 500
    example = (SHA256,)

    def __init__(self, sha256: str) -> None:
        super().__init__(f"The service's copy of the file with SHA-256 {sha256} is damaged. {_RECOVERY}")


class LockedError(ServiceError):
    """Upload that another request is writing to."""

    code, status = "upload-locked", 423
    message = "Another request is writing to this upload. Get its offset and resume from there."


class DatabaseUnavailableError(ServiceError, InfrastructureError):
    """Database that does not respond."""

    code, status = "database-unavailable", 503
    message = "The service's database does not answer. Try again later."
    retry_after = 5


class DatabaseBusyError(DatabaseUnavailableError):
    """Database that stays locked for too long, or whose connections are all in use."""

    code, status = "database-busy", 503
    message = "The service's database is busy. Try again later."


class LeaseLostError(ServiceError):
    """Lost lease: another dispatcher has taken over the job, and writes of the previous holder are rejected."""

    code, status = "lease-lost", 409
