"""Exceptions of the service. Each is an occurrence of a problem, which `service.problems` defines.

Code raises an error by calling its problem: `raise problems.QUEUE_FULL(limit=10)`. Subclasses exist for errors that
some code catches.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sgsst_core.errors import InfrastructureError, SgsstError


class ServiceError(SgsstError):
    """Error that the service raises on purpose, and answers with a problem document.

    Attributes:
        retry_after: Seconds after which the request may succeed (`Retry-After`); None if waiting does not help.
        extra: Additional members of the problem document.
    """

    def __init__(self, problem: ProblemType, message: str, code: str, retry_after: int | None) -> None:
        super().__init__(message)
        self.problem, self.code, self.status, self.retry_after = problem, code, problem.status, retry_after
        self.headers: dict[str, str] = {}
        self.extra: dict[str, object] = {}

    def __reduce__(self) -> tuple[Any, ...]:  # ranks send errors to the dispatcher by pickle
        return type(self), (self.problem, str(self), self.code, self.retry_after), self.__dict__


class NotFoundError(ServiceError):
    """Object that does not exist or belongs to another owner."""


class NoJobError(NotFoundError):
    """Job that does not exist or belongs to another owner."""


class NoShareError(NotFoundError):
    """Share that does not exist, has expired or was revoked."""


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
    """Database that does not respond."""


class DatabaseBusyError(DatabaseUnavailableError):
    """Database that stays locked for too long, or whose connections are all in use."""


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
