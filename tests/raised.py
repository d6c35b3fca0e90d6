"""Expectation of errors of the service, by their problem."""

import pytest

from service.problems import ProblemType, ServiceError


def raises_problem(problem: ProblemType, match: str | None = None) -> pytest.RaisesExc[ServiceError]:
    """Expect an error with the code of a problem, whose message matches a pattern."""
    return pytest.raises(ServiceError, match=match, check=lambda error: error.problem.code == problem.code)
