"""The exceptions of the service, in one tree; `code` is what programs read, the message is for people."""

from __future__ import annotations

from typing import Self

from sgsst_core.errors import InfrastructureError, SgsstError

_AGAIN = "If you uploaded it, upload it again; if it is a result, run the job again."


class ServiceError(SgsstError):
    """Root of what the service refuses on purpose.

    Attributes:
        status: HTTP status that a front end answers with.
        extra: members that a problem document carries beside the message.
    """

    code = "service-error"
    status = 500

    def __init__(self, message: str, **extra: object) -> None:
        super().__init__(message)
        self.extra = extra


class NotFoundError(ServiceError):
    """There is nothing of that name, or it is somebody else's."""

    code, status = "not-found", 404


class RefusedInputError(ServiceError):
    """An input that cannot be used; `code` is the core's, `extra["input"]` names the part of the request."""

    code, status = "invalid-input", 422

    def __init__(self, message: str, code: str = "invalid-input", **extra: object) -> None:
        super().__init__(message, **extra)
        self.code = code


class ConflictError(ServiceError):
    """The job or upload is in a state in which this cannot be done."""

    code, status = "conflict", 409


class IdempotencyError(ServiceError):
    """An Idempotency-Key that was used before, for another request."""

    code, status = "idempotency-key-reused", 422


class TooLargeError(ServiceError):
    """More bytes, Gaussians or pixels than the settings allow."""

    code, status = "too-large", 413


class QueueFullError(ServiceError):
    """This key has as many unfinished jobs as it may have."""

    code, status = "queue-full", 429


class QuotaError(ServiceError):
    """This key has used up what it may use: `extra["quota"]`; there is more after `extra["retry_after"]` seconds."""

    code, status = "quota-exceeded", 429


class RateLimitError(ServiceError):
    """This key sends requests faster than it may."""

    code, status = "rate-limited", 429


class NoSpaceError(ServiceError, InfrastructureError):
    """The disk is too full to take more in."""

    code, status = "insufficient-storage", 507


class BusyError(ServiceError):
    """What is needed is in use; the same request will succeed later."""

    code, status = "busy", 503


class StoreError(ServiceError, InfrastructureError):
    """The store of files cannot be reached; the cause says what has happened."""

    code, status = "store-unavailable", 503


class DamagedWeightsError(ServiceError, InfrastructureError):
    """Weights of a feature network on this machine are damaged: no job is accepted until they are installed again."""

    code, status = "weights-damaged", 503

    def __init__(self) -> None:
        super().__init__(
            "The service's feature networks are damaged. Retry after its operator has reinstalled them; the log and "
            "`sgsst weights list` name them.",
            retry_after=60,
        )


class LostFileError(ServiceError):
    """A file that a row refers to is not in the store of files, which itself answers."""

    code, status = "file-lost", 500

    @classmethod
    def of(cls, sha256: str) -> Self:
        """Return the error of a file of this SHA-256."""
        return cls(f"The service has lost the file with SHA-256 {sha256}. {_AGAIN}")


class DamagedFileError(ServiceError):
    """A file of the store does not have the SHA-256 that was recorded for it; it is neither sent nor used."""

    code, status = "file-damaged", 500

    @classmethod
    def of(cls, sha256: str) -> Self:
        """Return the error of a file whose SHA-256 should be this."""
        return cls(f"The service's copy of the file with SHA-256 {sha256} is damaged. {_AGAIN}")


class LockedError(ServiceError):
    """Another request is writing to this upload."""

    code, status = "upload-locked", 423

    def __init__(
        self, message: str = "Another request is writing to this upload. Get its offset and resume from there."
    ) -> None:
        super().__init__(message)


class DatabaseUnavailableError(ServiceError, InfrastructureError):
    """Database that does not answer."""

    code, status = "database-unavailable", 503


class DatabaseBusyError(DatabaseUnavailableError):
    """Database that others have locked for too long, or whose connections are all in use."""

    code, status = "database-busy", 503


class LeaseLostError(ServiceError):
    """Another dispatcher has taken the job over: whatever this one still has to say about it is void."""

    code, status = "lease-lost", 409
