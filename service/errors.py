"""Exceptions of the service; each has a machine-readable `code` and a message for people."""

from __future__ import annotations

from typing import Self

from sgsst_core.errors import InfrastructureError, SgsstError

_AGAIN = "If you uploaded it, upload it again; if it is a result, run the job again."


class ServiceError(SgsstError):
    """Base class of all errors that the service raises on purpose.

    Attributes:
        status: HTTP status of the response.
        extra: Additional members of the problem document.
    """

    code = "service-error"
    status = 500

    def __init__(self, message: str, **extra: object) -> None:
        super().__init__(message)
        self.extra = extra


class NotFoundError(ServiceError):
    """Object that does not exist or belongs to another owner."""

    code, status = "not-found", 404


class RefusedInputError(ServiceError):
    """Unusable input; `code` is that of the core's error, and `extra["input"]` names the part of the request."""

    code, status = "invalid-input", 422

    def __init__(self, message: str, code: str = "invalid-input", **extra: object) -> None:
        super().__init__(message, **extra)
        self.code = code


class ConflictError(ServiceError):
    """Operation that the state of the job or upload does not allow."""

    code, status = "conflict", 409


class IdempotencyError(ServiceError):
    """Idempotency-Key that was already used for a different request."""

    code, status = "idempotency-key-reused", 422


class TooLargeError(ServiceError):
    """Request with more bytes, Gaussians or pixels than the settings allow."""

    code, status = "too-large", 413


class QueueFullError(ServiceError):
    """Job that would exceed the key's limit of unfinished jobs."""

    code, status = "queue-full", 429


class QuotaError(ServiceError):
    """Exhausted quota of a key; `extra["quota"]` names it.

    The quota recovers after `extra["retry_after"]` seconds.
    """

    code, status = "quota-exceeded", 429


class RateLimitError(ServiceError):
    """Request that exceeds the key's rate limit."""

    code, status = "rate-limited", 429


class NoSpaceError(ServiceError, InfrastructureError):
    """Request that is rejected because the service's disk is too full."""

    code, status = "insufficient-storage", 507


class BusyError(ServiceError):
    """Request that needs a resource that is in use; retrying it later will succeed."""

    code, status = "busy", 503


class StoreError(ServiceError, InfrastructureError):
    """File store that cannot be reached; the exception's cause has the details."""

    code, status = "store-unavailable", 503


class DamagedWeightsError(ServiceError, InfrastructureError):
    """Damaged feature network weights on this machine: no job is accepted until they are reinstalled."""

    code, status = "weights-damaged", 503

    def __init__(self) -> None:
        super().__init__(
            "The service's feature networks are damaged. Retry after its operator has reinstalled them; the log and "
            "`sgsst weights list` name them.",
            retry_after=60,
        )


class LostFileError(ServiceError):
    """File that a database row refers to but that is missing from the file store, although the store is reachable."""

    code, status = "file-lost", 500

    @classmethod
    def of(cls, sha256: str) -> Self:
        """Return the error for the file with this SHA-256."""
        return cls(f"The service has lost the file with SHA-256 {sha256}. {_AGAIN}")


class DamagedFileError(ServiceError):
    """Stored file whose SHA-256 differs from the recorded one; it is neither sent nor used."""

    code, status = "file-damaged", 500

    @classmethod
    def of(cls, sha256: str) -> Self:
        """Return the error for the file that should have this SHA-256."""
        return cls(f"The service's copy of the file with SHA-256 {sha256} is damaged. {_AGAIN}")


class LockedError(ServiceError):
    """Upload that another request is writing to."""

    code, status = "upload-locked", 423

    def __init__(
        self, message: str = "Another request is writing to this upload. Get its offset and resume from there."
    ) -> None:
        super().__init__(message)


class DatabaseUnavailableError(ServiceError, InfrastructureError):
    """Database that does not respond."""

    code, status = "database-unavailable", 503


class DatabaseBusyError(DatabaseUnavailableError):
    """Database that stays locked for too long, or whose connections are all in use."""

    code, status = "database-busy", 503


class LeaseLostError(ServiceError):
    """Lost lease: another dispatcher has taken over the job, and writes of the previous holder are rejected."""

    code, status = "lease-lost", 409
