"""The exceptions of the service, in one tree; `code` is what programs read, the message is for people."""

from __future__ import annotations

from sgsst_core.errors import InfrastructureError, SgsstError


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
    """The store of files cannot be reached, or has lost or damaged a file; the cause says what has happened."""

    code, status = "store-unavailable", 503


class DatabaseUnavailableError(ServiceError, InfrastructureError):
    """Database that does not answer."""

    code, status = "database-unavailable", 503


class DatabaseBusyError(DatabaseUnavailableError):
    """Database that others have locked for too long, or whose connections are all in use."""

    code, status = "database-busy", 503


class LeaseLostError(ServiceError):
    """Another dispatcher has taken the job over: whatever this one still has to say about it is void."""

    code, status = "lease-lost", 409
